"""The source picture on the GPU: one texture per mip level, each uploaded a few rows at a time."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import moderngl
import numpy as np

from gsasr.errors import BackendError
from gsasr.rasterize.opengl import with_room

from .mipmaps import Mipmaps

BAND = 1 << 20  # bytes uploaded at once


@dataclass(frozen=True)
class Level:
    """texture: of a mip level; span: source pixels that it covers, (x, y)."""

    texture: moderngl.Texture
    span: tuple[int, int]


class Source:
    """A picture that is there at once, coarsely, and in full after some calls of `load`.

    Levels have a texture each, so that those that have arrived can be shown while the next one
    is on its way. A level too large for a texture is left out. Raises BackendError if the GPU has
    no room.
    """

    def __init__(self, ctx: moderngl.Context, mipmaps: Mipmaps) -> None:
        self.size = mipmaps.levels[0].shape[:2]  # (height, width), source pixels
        self.has_alpha = mipmaps.has_alpha
        self._ctx = ctx
        limit = ctx.info["GL_MAX_TEXTURE_SIZE"]
        # The next one to upload is the last: the coarsest
        self._waiting = [
            (number, level)
            for number, level in enumerate(mipmaps.levels)
            if max(level.shape[:2]) <= limit
        ]
        self._arrived: dict[int, Level] = {}
        self._arriving: moderngl.Texture | None = None
        self._rows = 0  # of it that are there
        try:
            while self._waiting and self._waiting[-1][1].nbytes <= BAND:
                self.load(0.0)
        except BackendError:
            self.release()
            raise

    @property
    def loading(self) -> bool:
        """Is there something left to upload?"""
        return bool(self._waiting)

    @property
    def finest(self) -> int:
        """The finest level that has arrived; 0 is the picture itself."""
        return min(self._arrived)

    def load(self, seconds: float) -> bool:
        """Upload for about so long, at least one band; True if there is a finer level now.

        Raises BackendError if the GPU has no room for more: then the levels that have arrived stay,
        and no others are waited for.
        """
        deadline, finer, first = time.perf_counter() + seconds, False, True
        while self._waiting and (first or time.perf_counter() < deadline):
            try:
                finer = self._upload_band() or finer
            except BackendError:
                self._give_up()
                raise
            first = False
        return finer

    def levels(self, scale: float) -> tuple[Level, Level, float]:
        """The two levels to mix at a scale (output per source pixels), and the coarser's share."""
        detail = max(-math.log2(scale), 0.0)
        number = math.floor(detail)
        finer = min(max(number, self.finest), max(self._arrived))
        coarser = min(finer + 1, max(self._arrived))
        share = detail - number if finer == number else 0.0
        return self._arrived[finer], self._arrived[coarser], share

    def release(self) -> None:
        """Free the textures."""
        for level in self._arrived.values():
            level.texture.release()
        self._give_up()

    def _give_up(self) -> None:
        """Wait for no more levels."""
        self._waiting.clear()
        if self._arriving is not None:
            self._arriving.release()
            self._arriving = None

    def _upload_band(self) -> bool:
        """Some more rows; True if a level is complete now."""
        number, pixels = self._waiting[-1]
        height, width = pixels.shape[:2]
        if self._arriving is None:
            self._arriving = with_room(self._ctx, self._ctx.texture, (width, height), 4)
            self._arriving.filter = (moderngl.LINEAR, moderngl.LINEAR)
            self._arriving.repeat_x = self._arriving.repeat_y = False
            self._rows = 0
        start = self._rows
        stop = min(height, start + max(1, BAND // (4 * width)))
        rows = np.ascontiguousarray(pixels[start:stop])
        place = (0, start, width, stop - start)
        with_room(self._ctx, self._arriving.write, rows, viewport=place, alignment=4)
        self._rows = stop
        if stop < height:
            return False
        self._arrived[number] = Level(self._arriving, (width << number, height << number))
        self._arriving = None
        self._waiting.pop()
        return True
