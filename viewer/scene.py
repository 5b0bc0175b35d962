"""The picture and its Gaussians on the GPU, and how a view of them is drawn.

Used by the window and by --snapshot, so that both show the same. Below 1:1 one sees the source
picture, mip-mapped; from FULL on the Gaussians; between, a blend; and the source, magnified,
where Gaussians have not arrived yet.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import moderngl
import numpy as np

from gsasr.files import shipped
from gsasr.view import View

from .state import Rectangle

FULL = 2.0  # scale from which only Gaussians are shown
BLOCK = 4  # source pixels per texel of the coverage
EDGE = 2  # blocks by which coverage keeps off tiles that have not arrived: further than they reach
REACH = (EDGE + 2) * BLOCK  # source pixels beyond a tile that its arrival can change
BACKGROUND = (0.085, 0.09, 0.1)  # beyond the picture, sRGB


@dataclass(frozen=True)
class Overlay:
    """What is drawn over the picture: "none", "centers" or "ellipses" at `sigma` deviations."""

    kind: str = "none"
    sigma: float = 2.0


class Target:
    """A framebuffer of RGBA8 pixels; row 0 is the top one."""

    def __init__(self, ctx: moderngl.Context, size: tuple[int, int]) -> None:
        self.size = size
        self.texture = ctx.texture((size[1], size[0]), 4)
        self.texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
        self.framebuffer = ctx.framebuffer([self.texture])

    def read(self) -> np.ndarray:
        """(h, w, 3) uint8."""
        data = self.framebuffer.read(components=3, alignment=1)
        return np.frombuffer(data, np.uint8).reshape(*self.size, 3)

    def release(self) -> None:
        """Free its memory on the GPU."""
        self.framebuffer.release()
        self.texture.release()


class Scene:
    """One picture and its tiles of Gaussians, in one OpenGL context."""

    def __init__(self, ctx: moderngl.Context) -> None:
        self.ctx = ctx
        self.size = (0, 0)  # (height, width) of the picture, source pixels
        self.tiles: list = []
        self.has_alpha = False
        self._rasterizer = None  # both need torch, which is not imported before the first tile
        self._overlays = None
        self._source: moderngl.Texture | None = None
        self._coverage: moderngl.Texture | None = None
        self._arrived = np.zeros((0, 0), bool)
        self._field: moderngl.Texture | None = None
        self._program = ctx.program(
            vertex_shader=shipped("shaders/picture.vert").read_text(),
            fragment_shader=shipped("shaders/picture.frag").read_text(),
        )
        self._triangle = ctx.vertex_array(self._program, [])
        self._pixel = Target(ctx, (1, 1))

    def set_picture(self, pixels: np.ndarray) -> None:
        """Show another picture, (H, W, 4) uint8 RGBA; drops all tiles."""
        self.clear()
        self.size = (pixels.shape[0], pixels.shape[1])
        self.has_alpha = bool((pixels[..., 3] < 255).any())
        limit = self.ctx.info["GL_MAX_TEXTURE_SIZE"]
        step = -(-max(self.size) // limit)  # beyond what the GPU can hold, every n-th pixel
        pixels = np.ascontiguousarray(pixels[::step, ::step])
        self._source = self.ctx.texture((pixels.shape[1], pixels.shape[0]), 4, pixels, alignment=4)
        self._source.build_mipmaps()
        self._source.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
        self._source.repeat_x = self._source.repeat_y = False
        blocks = tuple(-(-side // BLOCK) for side in self.size)
        self._arrived = np.zeros(blocks, bool)
        self._coverage = self.ctx.texture(
            (blocks[1], blocks[0]), 1, bytes(blocks[0] * blocks[1]), alignment=1
        )
        self._coverage.repeat_x = self._coverage.repeat_y = False

    def clear(self) -> None:
        """Forget picture and tiles."""
        self.clear_tiles()
        for texture in (self._source, self._coverage):
            if texture is not None:
                texture.release()
        self._source = self._coverage = None
        self.size = (0, 0)

    def release(self) -> None:
        """Free everything on the GPU; the scene cannot be used any more."""
        self.clear()
        self._pixel.release()
        for held in (self._field, self._rasterizer, self._overlays, self._triangle, self._program):
            if held is not None:
                held.release()

    def clear_tiles(self) -> None:
        """Forget the Gaussians, keep the picture."""
        for tile in self.tiles:
            tile.release()
        self.tiles = []
        if self._coverage is not None:
            self._arrived[:] = False
            self._coverage.write(bytes(self._arrived.size), alignment=1)

    def add_tile(self, packed) -> None:
        """Add a PackedTile of Gaussians; nothing of it shows before `cover`."""
        if self._rasterizer is None:
            from gsasr.rasterize.gl import GlRasterizer

            self._rasterizer = GlRasterizer(self.ctx)
            self._rasterizer.warm_up()
        self.tiles.append(self._rasterizer.upload(packed))

    def cover(self, core: Rectangle) -> None:
        """All Gaussians of a rectangle have arrived: show them where its neighbours' have, too."""
        rows, columns = self._arrived.shape
        x0, y0, x1, y1 = (round(side / BLOCK) for side in core)
        self._arrived[y0 : min(y1, rows), x0 : min(x1, columns)] = True
        # Only blocks near the rectangle can have become complete.
        left, top = max(0, x0 - EDGE), max(0, y0 - EDGE)
        right, bottom = min(columns, x1 + EDGE), min(rows, y1 + EDGE)
        if left >= right or top >= bottom:
            return
        around = np.pad(self._arrived, EDGE, constant_values=True)[
            top : bottom + 2 * EDGE, left : right + 2 * EDGE
        ]
        complete = np.lib.stride_tricks.sliding_window_view(around, (2 * EDGE + 1,) * 2).all((2, 3))
        self._coverage.write(
            np.where(complete, 255, 0).astype(np.uint8).tobytes(),
            viewport=(left, top, right - left, bottom - top),
            alignment=1,
        )

    def share(self, scale: float) -> float:
        """How much of what is seen at a scale is Gaussians, in [0, 1]."""
        if not self.tiles:
            return 0.0
        t = min(max(math.log2(max(scale, 1e-9)) / math.log2(FULL), 0.0), 1.0)
        return t * t * (3 - 2 * t)

    def draw(
        self,
        target: Target,
        view: View,
        overlay: Overlay,
        rows: tuple[int, int] | None = None,
        coarseness: int = 1,
    ) -> bool:
        """Draw output rows [start, stop) of a view (default: all) into the target.

        Returns whether there was an overlay to draw: close-lying Gaussians have none.

        coarseness: output pixels per computed sample of the Gaussians along each axis; the
            source, the overlay and the picture's edge are always drawn exactly.
        """
        start, stop = rows or (0, view.size[0])
        framebuffer = target.framebuffer
        framebuffer.scissor = (0, start, view.size[1], stop - start)
        drawn = False
        if self._source is None:
            framebuffer.use()
            framebuffer.clear(*BACKGROUND, 1.0)
        else:
            self._draw_picture(framebuffer, view, start, stop, coarseness, self.has_alpha)
            if overlay.kind != "none" and self.tiles:
                drawn = self._draw_overlay(framebuffer, view, overlay)
        framebuffer.scissor = None
        return drawn

    def color_at(self, view: View, x: int, y: int) -> tuple[int, int, int] | None:
        """8-bit RGB that the picture (no overlay, no checkerboard) has at an output pixel."""
        source_x, source_y = view.to_source(x + 0.5, y + 0.5)
        if self._source is None or not (
            0 <= source_x < self.size[1] and 0 <= source_y < self.size[0]
        ):
            return None
        spot = View(view.to_source(x, y), view.scale, (1, 1))
        self._draw_picture(self._pixel.framebuffer, spot, 0, 1, 1, False)
        red, green, blue = self._pixel.read()[0, 0]
        return int(red), int(green), int(blue)

    def _draw_picture(
        self,
        framebuffer: moderngl.Framebuffer,
        view: View,
        start: int,
        stop: int,
        coarseness: int,
        has_alpha: bool,
    ) -> None:
        share = self.share(min(view.scale))
        if share > 0:
            size = tuple(-(-side // coarseness) for side in view.size)
            scale = tuple(side / coarseness for side in view.scale)
            band = (start // coarseness, -(-stop // coarseness))
            field = self._field_texture(size)
            self._rasterizer.draw(self.tiles, View(view.origin, scale, size), field, rows=band)
            field.use(1)
        base = [math.floor(value) for value in view.origin]
        program = self._program
        program["base"] = base
        program["fraction"] = [
            value - whole for value, whole in zip(view.origin, base, strict=True)
        ]
        program["pixel"] = [1 / scale for scale in view.scale]
        program["size"] = self.size[::-1]
        program["per_texel"] = coarseness
        program["share"] = share
        program["covered_size"] = [side * BLOCK for side in self._arrived.shape[::-1]]
        program["has_alpha"] = has_alpha
        program["background"] = BACKGROUND
        self._source.use(0)
        self._coverage.use(2)
        framebuffer.use()
        self.ctx.disable(moderngl.BLEND)
        self._triangle.render(vertices=3)

    def _draw_overlay(
        self, framebuffer: moderngl.Framebuffer, view: View, overlay: Overlay
    ) -> bool:
        if self._overlays is None:
            from .overlays import Overlays

            self._overlays = Overlays(self.ctx)
        return self._overlays.draw(self.tiles, view, framebuffer, overlay.kind, overlay.sigma)

    def _field_texture(self, size: tuple[int, int]) -> moderngl.Texture:
        """A texture (h, w) for sums of Gaussians; kept while the size stays."""
        if self._field is None or self._field.size != (size[1], size[0]):
            if self._field is not None:
                self._field.release()
            self._field = self.ctx.texture((size[1], size[0]), 4, dtype="f2")
            self._field.filter = (moderngl.LINEAR, moderngl.LINEAR)
            self._field.repeat_x = self._field.repeat_y = False
        return self._field
