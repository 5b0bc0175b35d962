"""The picture and its Gaussians on the GPU, and how a view of them is drawn.

Used by the window and by --snapshot, so that both show the same. Below 1:1 one sees the source
picture, mip-mapped; from FULL on the Gaussians; between, a blend; and the source, magnified,
where Gaussians have not arrived yet.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import moderngl
import numpy as np

from gsasr.files import shipped
from gsasr.rasterize.opengl import with_room
from gsasr.view import View

from .coverage import Coverage, Rectangle
from .mipmaps import Mipmaps, mipmaps
from .source import Source

if TYPE_CHECKING:
    from gsasr.gaussians import Gaussians
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
        self.texture = with_room(ctx, ctx.texture, (size[1], size[0]), 4)
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


class Scene:
    """One picture and its tiles of Gaussians, in one OpenGL context."""

    def __init__(self, ctx: moderngl.Context) -> None:
        self.ctx = ctx
        self.size = (0, 0)  # (height, width) of the picture, source pixels
        self._tiles: dict[Rectangle, list[GlTile]] = {}
        self._arriving: list[GlTile] = []
        self._changes = 0  # of the tiles so far
        self.overlay_drawn = True  # False where Gaussians lie too close together on the screen
        self._rasterizer = None  # both need torch, which is not imported before the first tile
        self._warming: Iterator[None] | None = None  # programs still to be compiled
        self._overlays = None
        self._source: Source | None = None
        self._coverage: Coverage | None = None
        self._field: moderngl.Texture | None = None
        self._work = np.zeros(0)
        self._work_of: tuple | None = None  # the view and tiles that it is of
        self._marks: Target | None = None
        self._marks_of: tuple | None = None  # the view, overlay and tiles that they show
        self._arrays: dict[tuple[bool, ...], moderngl.VertexArray] = {}
        self._pixel = Target(ctx, (1, 1))

    def set_picture(self, pixels: np.ndarray) -> None:
        """Show another picture, (H, W, 4) uint8 RGBA, in full at once; drops all tiles."""
        self.show_picture(mipmaps(pixels))
        self.load(math.inf)

    def show_picture(self, levels: Mipmaps) -> None:
        """Show another picture, coarsely until `load` has uploaded it all; drops all tiles."""
        self.clear()
        self._source = Source(self.ctx, levels)
        self.size = self._source.size
        self._coverage = Coverage(self.ctx, self.size)

    @property
    def loading(self) -> bool:
        """Is there something left to upload or to compile?"""
        return (self._source is not None and self._source.loading) or self._warming is not None

    def load(self, seconds: float) -> bool:
        """Upload more of the picture for about so long; True if it can be shown finer now.

        Once all of it is there, compile a program of those that draw Gaussians (see prepare).
        """
        if self._source is not None and self._source.loading:
            return self._source.load(seconds)
        if self._warming is not None:
            steps, self._warming = self._warming, None  # one that fails is not asked again
            if next(steps, "done") != "done":
                self._warming = steps
        return False

    def prepare(self) -> None:
        """Tiles of Gaussians will come: be ready to draw them, by and by, as `load` is called."""
        if self._rasterizer is None:
            from gsasr.rasterize.gl import GlRasterizer

            self._rasterizer = GlRasterizer(self.ctx)
            self._warming = self._rasterizer.warming()

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

    @property
    def packs(self) -> bool:
        """Once prepared: should tiles come packed, since `add_tile` would do it on the CPU?"""
        return self._rasterizer.packs

    @property
    def most(self) -> int:
        """Once prepared: Gaussians that fit into one tile here."""
        return self._rasterizer.most

    def add_tile(self, tile: PackedTile | Gaussians) -> None:
        """Add Gaussians of a tile; none is drawn before `cover`. Raises BackendError: no memory."""
        for _ in self.adding(tile):
            pass

    def adding(self, tile: PackedTile | Gaussians) -> Iterator[None]:
        """The same in steps of a few milliseconds."""
        self.prepare()
        self._arriving.append((yield from self._rasterizer.uploading(tile)))

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
        share: float | None = None,
    ) -> None:
        """Draw output rows [start, stop) of a view (default: all) into the target.

        share: of the Gaussians, if it is another than that of the view's scale.
        """
        if self._source is None:
            target.framebuffer.clear(*BACKGROUND, 1.0)
            return
        start, stop = rows or (0, view.size[0])
        if share is None:
            share = self.share(min(view.scale))
        if not self.marked(view, overlay):
            self.mark(view, overlay)
        marks = self._marks.texture if overlay.kind != "none" and self._tiles else None
        target.framebuffer.scissor = (0, start, view.size[1], stop - start)
        self._draw(target.framebuffer, view, (start, stop), share, marks)
        target.framebuffer.scissor = None

    def work(self, view: View) -> np.ndarray:
        """(h,) of each output row, the pixels on which tiles of Gaussians lie."""
        if self._work_of == (view, self._changes):
            return self._work
        height, width = view.size
        rows = np.zeros(height)
        for tile in self.tiles:
            x0, y0 = view.to_output(*tile.bounds[:2])
            x1, y1 = view.to_output(*tile.bounds[2:])
            columns = min(x1, width) - max(x0, 0)
            start, stop = max(math.floor(y0), 0), min(math.ceil(y1), height)
            if columns > 0 and start < stop:
                rows[start:stop] += columns
        self._work, self._work_of = rows, (view, self._changes)
        return rows

    def marked(self, view: View, overlay: Overlay) -> bool:
        """Is the overlay of a view drawn already, or nothing to draw?"""
        if overlay.kind == "none" or not self._tiles:
            return True
        return self._marks_of == (view, overlay, self._changes)

    def mark(self, view: View, overlay: Overlay) -> None:
        """Draw an overlay on nothing, alpha premultiplied; `draw` shows it in any band of rows."""
        if self._overlays is None:
            from .overlays import Overlays

            self._overlays = Overlays(self.ctx)
        if self._marks is None or self._marks.size != view.size:
            if self._marks is not None:
                self._marks.release()
                self._marks = None
            self._marks = Target(self.ctx, view.size)
        target = self._marks.framebuffer
        target.clear(0.0, 0.0, 0.0, 0.0)
        self.overlay_drawn = self._overlays.draw(
            self.tiles, view, target, overlay.kind, overlay.sigma
        )
        self._marks_of = view, overlay, self._changes

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
        self._draw(self._pixel.framebuffer, spot, (0, 1), share, None, checkers=False)
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
        checkers: bool = True,
    ) -> None:
        """The sum of the Gaussians, then the pass that puts all together."""
        if share > 0:
            field = self._field_texture(view.size)
            self._rasterizer.draw(self.tiles, view, field, rows=rows)
            field.use(1)
        scale = min(view.scale)
        has_alpha = self._source.has_alpha and checkers
        with_source = share < 1 or has_alpha or not self._coverage.fills(view)
        magnified = scale > 1 and self._source.finest == 0
        array = self._array(with_source, share > 0, magnified, marks is not None)
        finer, coarser, blend = self._source.levels(scale)
        base = [math.floor(value) for value in view.origin]
        values = {
            "base": base,
            "fraction": [at - whole for at, whole in zip(view.origin, base, strict=True)],
            "pixel": [1 / scale for scale in view.scale],
            "size": self.size[::-1],
            "span": finer.span,
            "coarser_span": coarser.span,
            "blend": blend,
            "share": share,
            "covered": self._coverage.span,
            "has_alpha": has_alpha,
            "background": BACKGROUND,
        }
        for name, value in values.items():
            if name in array.program:  # a program has only the uniforms that it needs
                array.program[name] = value
        finer.texture.use(0)
        self._coverage.texture.use(2)
        if marks is not None:
            marks.use(3)
        coarser.texture.use(4)
        framebuffer.use()
        self.ctx.disable(moderngl.BLEND)
        array.render(vertices=3)

    def _field_texture(self, size: tuple[int, int]) -> moderngl.Texture:
        """A texture (h, w) for sums of Gaussians; kept while the size stays."""
        if self._field is None or self._field.size != (size[1], size[0]):
            if self._field is not None:
                self._field.release()
                self._field = None
            self._field = with_room(self.ctx, self.ctx.texture, (size[1], size[0]), 4, dtype="f2")
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
