"""The picture and its Gaussians on the GPU, and how a view of them is drawn.

Used by the window and by --snapshot, so that both show the same. Below 1:1 one sees the source
picture, mip-mapped; from FULL on the Gaussians; between, a blend; and the source, magnified,
where Gaussians have not arrived yet.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import moderngl
import numpy as np

from gsasr.files import shipped
from gsasr.view import View

from .coverage import Coverage
from .state import Rectangle

if TYPE_CHECKING:
    from gsasr.rasterize.gl import GlTile
    from gsasr.rasterize.tiles import PackedTile

FULL = 2.0  # scale from which only Gaussians are shown
BACKGROUND = (0.085, 0.09, 0.1)  # beyond the picture, sRGB


@dataclass(frozen=True)
class Overlay:
    """What is drawn over the picture: "none", "centers" or "ellipses" at `sigma` deviations."""

    kind: str = "none"
    sigma: float = 2.0


class Target:
    """A framebuffer of RGBA8 pixels; row 0 is the top one."""

    def __init__(self, ctx: moderngl.Context, size: tuple[int, int]) -> None:
        """size: (height, width), pixels."""
        self.size = size
        self.texture = ctx.texture((size[1], size[0]), 4)
        self.texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
        self.texture.repeat_x = self.texture.repeat_y = False
        self.framebuffer = ctx.framebuffer([self.texture])

    def read(self) -> np.ndarray:
        """(h, w, 3) uint8."""
        data = self.framebuffer.read(components=3, alignment=1)
        return np.frombuffer(data, np.uint8).reshape(*self.size, 3)

    def release(self) -> None:
        """Free its memory on the GPU."""
        self.framebuffer.release()
        self.texture.release()


@dataclass
class Seconds:
    """What a drawing took."""

    picture: float = 0.0
    overlay: float = 0.0


class Scene:
    """One picture and its tiles of Gaussians, in one OpenGL context."""

    def __init__(self, ctx: moderngl.Context) -> None:
        self.ctx = ctx
        self.size = (0, 0)  # (height, width) of the picture, source pixels
        self._tiles: dict[Rectangle, list[GlTile]] = {}
        self._arriving: list[GlTile] = []
        self._changes = 0  # of the tiles so far
        self.overlay_drawn = True  # False where Gaussians lie too close together on the screen
        self._has_alpha = False
        self._rasterizer = None  # both need torch, which is not imported before the first tile
        self._overlays = None
        self._source: moderngl.Texture | None = None
        self._coverage: Coverage | None = None
        self._field: moderngl.Texture | None = None
        self._marks: Target | None = None
        self._marks_of: tuple | None = None  # the view, overlay and tiles that they show
        self._arrays: dict[tuple[bool, ...], moderngl.VertexArray] = {}
        self._pixel = Target(ctx, (1, 1))

    def set_picture(self, pixels: np.ndarray) -> None:
        """Show another picture, (H, W, 4) uint8 RGBA; drops all tiles."""
        self.clear()
        self.size = (pixels.shape[0], pixels.shape[1])
        self._has_alpha = bool((pixels[..., 3] < 255).any())
        limit = self.ctx.info["GL_MAX_TEXTURE_SIZE"]
        step = -(-max(self.size) // limit)  # beyond what the GPU can hold, every n-th pixel
        pixels = np.ascontiguousarray(pixels[::step, ::step])
        self._source = self.ctx.texture((pixels.shape[1], pixels.shape[0]), 4, pixels, alignment=4)
        self._source.build_mipmaps()
        self._source.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
        self._source.repeat_x = self._source.repeat_y = False
        self._coverage = Coverage(self.ctx, self.size)

    def clear(self) -> None:
        """Forget picture and tiles."""
        self.clear_tiles()
        for held in (self._source, self._coverage):
            if held is not None:
                held.release()
        self._source = self._coverage = None
        self.size = (0, 0)

    def clear_tiles(self) -> None:
        """Forget the Gaussians, keep the picture."""
        self.drop_arriving()
        for piece in self.tiles:
            piece.release()
        self._tiles = {}
        self._changes += 1
        if self._coverage is not None:
            self._coverage.clear()

    @property
    def tiles(self) -> list[GlTile]:
        """All that is drawn."""
        return [piece for pieces in self._tiles.values() for piece in pieces]

    def add_tile(self, packed: PackedTile) -> None:
        """Add Gaussians of a tile; none is drawn before `cover`. Raises BackendError: no memory."""
        if self._rasterizer is None:
            from gsasr.rasterize.gl import GlRasterizer

            self._rasterizer = GlRasterizer(self.ctx)
            self._rasterizer.warm_up()
        self._arriving.append(self._rasterizer.upload(packed))

    def cover(self, core: Rectangle) -> int:
        """What was added is all of a rectangle: show it where its neighbours' are there, too.

        Returns the video memory that it takes, bytes.
        """
        arrived, self._arriving = self._arriving, []
        self.uncover(core)
        self._tiles[core] = arrived
        self._changes += 1
        self._coverage.add(core)
        return sum(piece.nbytes for piece in arrived)

    def uncover(self, core: Rectangle) -> None:
        """Forget the Gaussians of a rectangle, if they are there: the source is shown again."""
        if core in self._tiles:
            for piece in self._tiles.pop(core):
                piece.release()
            self._coverage.remove(core)
            self._changes += 1

    def drop_arriving(self) -> None:
        """Forget what was added and not covered yet."""
        while self._arriving:
            self._arriving.pop().release()

    def covers(self, view: View) -> bool:
        """Are all Gaussians there of what a view shows of the picture?"""
        return self._coverage is not None and self._coverage.fills(view)

    def release(self) -> None:
        """Free everything on the GPU; the scene cannot be used any more."""
        self.clear()
        programs = [array.program for array in self._arrays.values()]
        held = (self._pixel, self._field, self._marks, self._rasterizer, self._overlays)
        for each in (*held, *self._arrays.values(), *programs):
            if each is not None:
                each.release()

    def share(self, scale: float) -> float:
        """How much of what is seen at a scale is Gaussians, in [0, 1]."""
        if not self._tiles:
            return 0.0
        t = min(max(math.log2(max(scale, 1e-9)) / math.log2(FULL), 0.0), 1.0)
        return t * t * (3 - 2 * t)

    def draw(
        self,
        target: Target,
        view: View,
        overlay: Overlay,
        rows: tuple[int, int] | None = None,
        zoom: float | None = None,
    ) -> Seconds:
        """Draw output rows [start, stop) of a view (default: all) into the target.

        zoom: the scale that decides how much of the source is shown and how much of the
            Gaussians, if it is another than the view's.

        An overlay is drawn whole, once, however many bands of rows then show it.
        """
        seconds = Seconds()
        if self._source is None:
            target.framebuffer.clear(*BACKGROUND, 1.0)
            return seconds
        start, stop = rows or (0, view.size[0])
        share = self.share(zoom or min(view.scale))
        marks = None
        if overlay.kind != "none" and self._tiles:
            start_time = time.perf_counter()
            marks = self._overlay_texture(view, overlay)
            self.ctx.finish()
            seconds.overlay = time.perf_counter() - start_time
        target.framebuffer.scissor = (0, start, view.size[1], stop - start)
        self._draw(target.framebuffer, view, (start, stop), share, marks, seconds)
        target.framebuffer.scissor = None
        return seconds

    def color_at(self, view: View, x: int, y: int) -> tuple[int, int, int] | None:
        """8-bit RGB that the picture (no overlay, no checkerboard) has at an output pixel."""
        source_x, source_y = view.to_source(x + 0.5, y + 0.5)
        if self._source is None or not (
            0 <= source_x < self.size[1] and 0 <= source_y < self.size[0]
        ):
            return None
        spot = View(view.to_source(x, y), view.scale, (1, 1))
        # A field texture of its own: the canvas' one would be made anew for every pixel asked.
        field, self._field = self._field, None
        share = self.share(min(view.scale))
        self._draw(self._pixel.framebuffer, spot, (0, 1), share, None, Seconds(), checkers=False)
        if self._field is not None:
            self._field.release()
        self._field = field
        red, green, blue = self._pixel.read()[0, 0]
        return int(red), int(green), int(blue)

    def _draw(
        self,
        framebuffer: moderngl.Framebuffer,
        view: View,
        rows: tuple[int, int],
        share: float,
        marks: moderngl.Texture | None,
        seconds: Seconds,
        checkers: bool = True,
    ) -> None:
        """The sum of the Gaussians, then the pass that puts all together."""
        start = time.perf_counter()
        if share > 0:
            field = self._field_texture(view.size)
            self._rasterizer.draw(self.tiles, view, field, rows=rows)
            field.use(1)
        has_alpha = self._has_alpha and checkers
        with_source = share < 1 or has_alpha or not self._coverage.fills(view)
        array = self._array(with_source, share > 0, min(view.scale) > 1, marks is not None)
        base = [math.floor(value) for value in view.origin]
        values = {
            "base": base,
            "fraction": [at - whole for at, whole in zip(view.origin, base, strict=True)],
            "pixel": [1 / scale for scale in view.scale],
            "size": self.size[::-1],
            "share": share,
            "covered": self._coverage.span,
            "has_alpha": has_alpha,
            "background": BACKGROUND,
        }
        for name, value in values.items():
            if name in array.program:  # a program has only the uniforms that it needs
                array.program[name] = value
        self._source.use(0)
        self._coverage.texture.use(2)
        if marks is not None:
            marks.use(3)
        framebuffer.use()
        self.ctx.disable(moderngl.BLEND)
        array.render(vertices=3)
        self.ctx.finish()
        seconds.picture += time.perf_counter() - start

    def _overlay_texture(self, view: View, overlay: Overlay) -> moderngl.Texture:
        """The overlay on nothing, alpha premultiplied; drawn only if it has changed."""
        if self._overlays is None:
            from .overlays import Overlays

            self._overlays = Overlays(self.ctx)
        if self._marks is None or self._marks.size != view.size:
            if self._marks is not None:
                self._marks.release()
            self._marks, self._marks_of = Target(self.ctx, view.size), None
        wanted = (view, overlay, self._changes)
        if wanted != self._marks_of:
            target = self._marks.framebuffer
            target.clear(0.0, 0.0, 0.0, 0.0)
            self.overlay_drawn = self._overlays.draw(
                self.tiles, view, target, overlay.kind, overlay.sigma
            )
            self._marks_of = wanted
        return self._marks.texture

    def _field_texture(self, size: tuple[int, int]) -> moderngl.Texture:
        """A texture (h, w) for sums of Gaussians; kept while the size stays."""
        if self._field is None or self._field.size != (size[1], size[0]):
            if self._field is not None:
                self._field.release()
            self._field = self.ctx.texture((size[1], size[0]), 4, dtype="f2")
        return self._field

    def _array(self, *needs: bool) -> moderngl.VertexArray:
        """The program for what a view needs, compiled at its first use."""
        if needs not in self._arrays:
            names = ("WITH_SOURCE", "WITH_FIELD", "MAGNIFIED", "WITH_OVERLAY")
            defines = [f"#define {name}" for name, need in zip(names, needs, strict=True) if need]
            version, rest = shipped("shaders/picture.frag").read_text().split("\n", 1)
            program = self.ctx.program(
                vertex_shader=shipped("shaders/picture.vert").read_text(),
                fragment_shader="\n".join([version, *defines, rest]),
            )
            self._arrays[needs] = self.ctx.vertex_array(program, [])
        return self._arrays[needs]
