"""Marks over the picture that show where the Gaussians are, drawn from the tiles' own buffers."""

from __future__ import annotations

import math
from typing import Literal

import moderngl
import numpy as np

from gsasr.errors import RequestError
from gsasr.rasterize.gl_tile import GlTile, allocate
from gsasr.rasterize.opengl import load_shader
from gsasr.rasterize.records import FOLD
from gsasr.view import View

Kind = Literal["centers", "ellipses"]

MARK_BYTES = 32
CLOSEST = 1.5  # mean distance of two Gaussians on the screen, pixels, below which none is drawn
CLEAR = 4.0  # ... and from which on they are drawn at full strength
DOT = (0.8, 2.2)  # smallest and largest radius of a centre, pixels
LINE = 0.7  # half the width of an outline, pixels
RIM = 1.4  # dark edge round both, pixels


class Overlays:
    """Draws centres and ellipses of Gaussians with a given context, on that context's thread."""

    def __init__(self, ctx: moderngl.Context) -> None:
        self.ctx = ctx
        self._select = {
            packed: ctx.compute_shader(load_shader(ctx, "overlay_select.comp", defines))
            for packed, defines in ((False, {}), (True, {"PACKED": 1}))
        }
        self._programs = {
            kind: ctx.program(
                vertex_shader=load_shader(ctx, f"overlay_{kind}.vert"),
                fragment_shader=load_shader(ctx, "overlay.frag"),
            )
            for kind in ("centers", "ellipses")
        }
        self._command = ctx.buffer(reserve=20)
        self._reserve(1 << 14)

    def draw(
        self,
        tiles: list[GlTile],
        view: View,
        framebuffer: moderngl.Framebuffer,
        kind: Kind,
        sigma: float = 1.0,
        color: tuple[float, float, float] | None = None,
    ) -> bool:
        """Blend the marks of all visible Gaussians over what `framebuffer` holds.

        framebuffer: of view.size pixels; its row 0 is the top row, as for GlRasterizer.draw.
        kind: "centers", a dot at each mean, or "ellipses", the outline at `sigma` standard
            deviations (> 0).
        color: RGB in [0, 1] for all; by default each Gaussian's own colour at full brightness.
            Either way, what adds little to the picture is drawn faint.

        Where the Gaussians of a tile lie closer together than CLEAR pixels the marks fade, and
        below CLOSEST there are none: they would hide the picture and show nothing, and so at most
        one mark per two or so pixels is ever drawn, however many Gaussians there are. Returns
        whether any tile was drawn, so that one can say "zoom in" where none was.

        Leaves bound: storage buffers 0 to 2 and a blend function for premultiplied alpha. The
        bound framebuffer and the enabled flags are as before.
        """
        height, width = view.size
        if framebuffer.size != (width, height):
            raise RequestError(f"The framebuffer must be {width}x{height}.")
        if not sigma > 0:
            raise RequestError(f"An ellipse needs a sigma above 0, but it is {sigma:g}.")
        program = self._programs[kind]
        program["size"] = width, height
        program["rim"] = RIM
        program["fixed_color"] = (*color, 1.0) if color else (0.0, 0.0, 0.0, 0.0)
        drawn = False
        for tile in tiles:
            spacing = _spacing(tile, view)
            if not tile.count or spacing <= CLOSEST or not _reaches(tile, view, sigma):
                continue
            core = min(max(0.3 * spacing, DOT[0]), DOT[1]) if kind == "centers" else LINE
            program["core"] = core
            program["reach"] = core + RIM
            program["fade"] = min(1.0, (spacing - CLOSEST) / (CLEAR - CLOSEST))
            self._select_visible(tile, view, 0.0 if kind == "centers" else sigma, core + RIM)
            self.ctx.blend_func = moderngl.ONE, moderngl.ONE_MINUS_SRC_ALPHA
            with self.ctx.scope(framebuffer, enable_only=moderngl.BLEND):
                self._arrays[kind].render_indirect(self._command, moderngl.TRIANGLE_STRIP, 1)
            drawn = True
        return drawn

    def release(self) -> None:
        """Free the programs and buffers (not the tiles, nor the context)."""
        held = (*self._arrays.values(), *self._programs.values(), self._marks, self._command)
        for each in (*held, *self._select.values()):
            each.release()

    def _reserve(self, count: int) -> None:
        """Room for the marks of a tile of `count` Gaussians."""
        (self._marks,) = allocate(self.ctx, [count * MARK_BYTES])
        self._arrays = {
            kind: self.ctx.vertex_array(program, [(self._marks, "4f 4f/i", "place", "look")])
            for kind, program in self._programs.items()
        }

    def _select_visible(self, tile: GlTile, view: View, sigma: float, margin: float) -> None:
        """Put the visible Gaussians into self._marks, and their number into self._command."""
        if tile.count * MARK_BYTES > self._marks.size:
            for array in self._arrays.values():
                array.release()
            self._marks.release()
            self._reserve(tile.count)
        self.ctx.memory_barrier()  # the draw call before may still read both
        self._command.write(np.array([4 if sigma == 0.0 else 0, 0, 0, 0, 0], np.uint32))
        base = tuple(math.floor(v) for v in view.origin)
        select = self._select[tile.unpacking is not None]
        if tile.unpacking is not None:
            select["unpacking"] = tile.unpacking
        select["count"] = tile.count
        select["base_origin"] = base[0] - tile.origin[0], base[1] - tile.origin[1]
        select["origin"] = view.origin[0] - base[0], view.origin[1] - base[1]
        select["scale"] = view.scale
        select["size"] = view.size[1], view.size[0]
        select["radius"] = FOLD * sigma
        select["margin"] = margin
        for binding, buffer in enumerate((tile.records, self._marks, self._command)):
            buffer.bind_to_storage_buffer(binding)
        select.run(-(-tile.count // 64))
        self.ctx.memory_barrier()


def _spacing(tile: GlTile, view: View) -> float:
    """Mean distance between neighbouring Gaussians of the tile on the screen, pixels."""
    x0, y0, x1, y1 = tile.extent
    area = max(x1 - x0, 1.0) * max(y1 - y0, 1.0) * view.scale[0] * view.scale[1]
    return math.sqrt(area / max(tile.count, 1))


def _reaches(tile: GlTile, view: View, sigma: float) -> bool:
    """Whether a mark of the tile may show; quick, for whole tiles."""
    x0, y0, x1, y1 = tile.extent
    left, top = view.to_source(-DOT[1] - RIM, -DOT[1] - RIM)
    right, bottom = view.to_source(view.size[1] + DOT[1] + RIM, view.size[0] + DOT[1] + RIM)
    far = sigma * tile.largest
    return x0 - far < right and left < x1 + far and y0 - far < bottom and top < y1 + far
