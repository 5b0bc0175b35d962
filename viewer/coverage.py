"""Where all Gaussians have arrived, as a texture that fades at the border of what is there."""

from __future__ import annotations

import math

import moderngl
import numpy as np

from gsasr.rasterize.opengl import with_room
from gsasr.view import View

Rectangle = tuple[int, int, int, int]  # x0, y0, x1, y1 in source pixels

BLOCK = 4  # source pixels per texel
EDGE = 2  # blocks kept off tiles that have not arrived: further than their Gaussians reach
REACH = (EDGE + 2) * BLOCK  # source pixels beyond a tile that its arrival can change


class Coverage:
    """One texel per block of the picture: 1 where it and all blocks around have arrived."""

    def __init__(self, ctx: moderngl.Context, size: tuple[int, int]) -> None:
        """size: (height, width) of the picture, source pixels."""
        rows, columns = (-(-side // BLOCK) for side in size)
        self.span = (columns * BLOCK, rows * BLOCK)  # source pixels, (x, y)
        self.texture = with_room(
            ctx, ctx.texture, (columns, rows), 1, bytes(rows * columns), alignment=1
        )
        self.texture.repeat_x = self.texture.repeat_y = False
        # Beyond the picture there is nothing to wait for.
        self._around = np.pad(np.zeros((rows, columns), bool), EDGE, constant_values=True)
        self._arrived = self._around[EDGE : EDGE + rows, EDGE : EDGE + columns]
        self._complete = np.zeros((rows, columns), bool)

    def add(self, core: Rectangle) -> None:
        """All Gaussians of a rectangle (source pixels) have arrived."""
        self._set(core, True)

    def remove(self, core: Rectangle) -> None:
        """Those of a rectangle are gone again."""
        self._set(core, False)

    def clear(self) -> None:
        """Nothing has arrived."""
        self._arrived[:] = self._complete[:] = False
        self.texture.write(bytes(self._arrived.size), alignment=1)

    def fills(self, view: View) -> bool:
        """Is everything complete that a view shows of the picture?"""
        rows, columns = self._complete.shape
        x0, y0 = view.origin
        x1, y1 = view.to_source(view.size[1], view.size[0])
        left, top = (max(0, math.floor(side / BLOCK) - 1) for side in (x0, y0))
        right = min(columns, math.floor(x1 / BLOCK) + 2)
        bottom = min(rows, math.floor(y1 / BLOCK) + 2)
        return bool(self._complete[top : max(top, bottom), left : max(left, right)].all())

    def release(self) -> None:
        """Free the texture."""
        self.texture.release()

    def _set(self, core: Rectangle, arrived: bool) -> None:
        rows, columns = self._arrived.shape
        x0, y0, x1, y1 = (round(side / BLOCK) for side in core)
        self._arrived[y0 : min(y1, rows), x0 : min(x1, columns)] = arrived
        # Only blocks near the rectangle can have become complete, or ceased to be.
        left, top = max(0, x0 - EDGE), max(0, y0 - EDGE)
        right, bottom = min(columns, x1 + EDGE), min(rows, y1 + EDGE)
        if left >= right or top >= bottom:
            return
        around = self._around[top : bottom + 2 * EDGE, left : right + 2 * EDGE]
        windows = np.lib.stride_tricks.sliding_window_view(around, (2 * EDGE + 1,) * 2)
        complete = self._complete[top:bottom, left:right] = windows.all((2, 3))
        self.texture.write(
            np.where(complete, 255, 0).astype(np.uint8).tobytes(),
            viewport=(left, top, right - left, bottom - top),
            alignment=1,
        )
