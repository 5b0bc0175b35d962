"""Rasterizer in OpenGL 4.3 compute shaders: for the screen, and for export on any GPU.

What a view shows is the sum of its visible tiles of Gaussians. Each tile is indexed once, in
cells of the source image (tiles.py, cells.py), and a frame of any zoom only reads those lists.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING

import moderngl
import numpy as np

from ..errors import BackendError, RequestError
from ..files import shipped
from ..view import View
from .tiles import CELL_SIDES, PackedTile, pack, split_tiles, visible

if TYPE_CHECKING:
    from ..gaussians import Gaussians

__all__ = [
    "GlRasterizer",
    "GlTile",
    "create_context",
    "hardware",
    "load_shader",
    "pack",
    "render",
    "split_tiles",
]

SOFTWARE = ("llvmpipe", "softpipe", "swrast", "software rasterizer", "swiftshader")
TARGETS = {"f2": "rgba16f", "f4": "rgba32f"}
BLOCK = 4096  # widest piece that `render` draws at once, pixels
PIXELS = 1 << 22  # most pixels in such a piece: 64 MiB
HELD = 1 << 29  # bytes of tiles that `render` holds on the GPU at once, about

RUN = np.dtype([("pixel", "i4"), ("count", "i4"), ("cell", "i4"), ("offset", "f4")])


@dataclass(frozen=True)
class Shape:
    """How a workgroup covers a cell (see rasterize.comp); for cells of `reach` pixels or more."""

    rows: int
    runs: int
    pixels: int
    lines: int
    reach: float


# Software runs 8 threads in step and pays most for loading a Gaussian, so a thread covers as much
# as it can, and all threads read the same list. A GPU wants many threads. Found by measuring
# (benchmarks/gl_frame.py), for GPUs a guess.
SOFTWARE_SHAPES = (Shape(8, 1, 16, 2, 9.0), Shape(8, 1, 8, 1, 6.0), Shape(2, 4, 2, 1, 2.0))
HARDWARE_SHAPES = (Shape(8, 8, 8, 1, 6.0), Shape(2, 32, 2, 1, 2.0))


@dataclass(frozen=True)
class GlLevel:
    """One index of a tile on the GPU (see cells.Cells)."""

    side: float
    first: tuple[int, int]
    shape: tuple[int, int]
    offsets: moderngl.Buffer
    entries: moderngl.Buffer


@dataclass(frozen=True)
class GlTile:
    """A PackedTile on the GPU. `count` Gaussians; the rest as in PackedTile."""

    count: int
    origin: tuple[int, int]
    bounds: tuple[float, float, float, float]
    extent: tuple[float, float, float, float]
    largest: float
    records: moderngl.Buffer
    levels: tuple[GlLevel, ...]

    @property
    def nbytes(self) -> int:
        """Video memory it holds."""
        lists = sum(level.offsets.size + level.entries.size for level in self.levels)
        return self.records.size + lists

    def meets(self, view: View) -> bool:
        """Whether any of it can be seen."""
        x0, y0 = view.origin
        x1, y1 = view.to_source(view.size[1], view.size[0])
        return (
            self.bounds[0] < x1
            and x0 < self.bounds[2]
            and self.bounds[1] < y1
            and y0 < self.bounds[3]
        )

    def release(self) -> None:
        """Free the video memory; on the thread of the context."""
        self.records.release()
        for level in self.levels:
            level.offsets.release()
            level.entries.release()


class GlRasterizer:
    """Draws tiles of Gaussians with a given context, on that context's thread."""

    def __init__(self, ctx: moderngl.Context) -> None:
        self.ctx = ctx
        self._shapes = SOFTWARE_SHAPES if software(ctx.info) else HARDWARE_SHAPES
        self._programs: dict[tuple[Shape, str], moderngl.ComputeShader] = {}
        self._runs: dict[tuple[float, Shape], moderngl.Buffer] = {}

    def warm_up(self, dtype: str = "f2") -> None:
        """Compile all that `draw` will need for such a target, lest a first frame stutter.

        Some drivers, software among them, compile when a program first runs: so it runs.
        """
        target = self.ctx.texture((1, 1), 4, dtype=dtype)
        target.bind_to_image(0, read=True, write=True)
        for shape in self._shapes:
            program = self._program(shape, TARGETS[dtype])
            program["window"] = 0, 0, 0  # no runs: every thread ends at once
            program.run(1, 1)
        self.ctx.finish()
        target.release()

    def upload(self, tile: PackedTile | Gaussians, quality: str = "screen") -> GlTile:
        """The tile on the GPU. Gaussians are packed first, which is better done on a worker.

        Raises BackendError when the GPU has no room for it.
        """
        if not isinstance(tile, PackedTile):
            tile = pack(tile, quality)
        arrays = [tile.records, *(a for c in tile.levels for a in (c.offsets, c.entries))]
        # A buffer cannot be empty.
        buffers = [self.ctx.buffer(a) if a.size else self.ctx.buffer(reserve=32) for a in arrays]
        if self.ctx.error == "GL_OUT_OF_MEMORY":
            for buffer in buffers:
                buffer.release()
            raise BackendError(
                "The GPU is out of memory; close other programs or use --backend cpu."
            )
        levels = tuple(
            GlLevel(c.side, c.first, c.shape, *buffers[1 + 2 * i : 3 + 2 * i])
            for i, c in enumerate(tile.levels)
        )
        return GlTile(
            len(tile), tile.origin, tile.bounds, tile.extent, tile.largest, buffers[0], levels
        )

    def draw(
        self,
        tiles: list[GlTile],
        view: View,
        target: moderngl.Texture,
        clear: bool = True,
        rows: tuple[int, int] | None = None,
    ) -> None:
        """Add every visible tile to `target`, as view.size pixels of RGB, alpha 1, not clamped.

        target: 4 components of "f2" (for the screen) or "f4"; its row 0 is the top row.
        clear: begin from black, else add to what is there.
        rows: only these rows [start, stop) of the target; the view stays that of the whole.

        Leaves bound: storage buffers 0 to 3 and image unit 0. All else is as it was. What it
        wrote can be read by any later command.
        """
        height, width = view.size
        if target.size != (width, height) or target.components != 4 or target.dtype not in TARGETS:
            raise RequestError(f"The target must be {width}x{height} with four float components.")
        start, stop = rows or (0, height)
        if clear:
            self._clear(target, start, stop)
        target.bind_to_image(0, read=True, write=True)
        axes: dict[tuple[float, Shape], tuple[np.ndarray, np.ndarray]] = {}
        for tile in tiles:
            if not tile.meets(view):
                continue
            index, shape = choose([level.side for level in tile.levels], view, self._shapes)
            level = tile.levels[index]
            if (level.side, shape) not in axes:
                columns = runs(view.origin[0], view.scale[0], 0, width, level.side, shape.pixels)
                lines = shape.rows * shape.lines
                bands = runs(view.origin[1], view.scale[1], start, stop, level.side, lines)
                axes[level.side, shape] = columns["cell"], bands["cell"]
                self._upload_runs((level.side, shape), np.concatenate([columns, bands]))
            self._draw_tile(tile, level, shape, view, target, *axes[level.side, shape])
        self.ctx.memory_barrier()

    def side(self, view: View) -> float:
        """The side of the cells that `draw` reads at this scale, source pixels: see pack."""
        return CELL_SIDES[choose(CELL_SIDES, view, self._shapes)[0]]

    def release(self) -> None:
        """Free the programs and buffers (not the tiles, nor the context)."""
        for held in (*self._programs.values(), *self._runs.values()):
            held.release()
        self._programs.clear()
        self._runs.clear()

    def _clear(self, target: moderngl.Texture, start: int, stop: int) -> None:
        framebuffer = self.ctx.framebuffer([target])
        framebuffer.clear(alpha=1.0, viewport=(0, start, target.width, stop - start))
        framebuffer.release()

    def _upload_runs(self, key: tuple[float, Shape], data: np.ndarray) -> None:
        buffer = self._runs.get(key)
        if buffer is None or buffer.size < data.nbytes:
            if buffer is not None:
                buffer.release()
            buffer = self._runs[key] = self.ctx.buffer(reserve=2 * max(data.nbytes, RUN.itemsize))
        buffer.orphan()
        buffer.write(data)

    def _draw_tile(
        self,
        tile: GlTile,
        level: GlLevel,
        shape: Shape,
        view: View,
        target: moderngl.Texture,
        columns: np.ndarray,  # the cell of every run, ascending
        bands: np.ndarray,
    ) -> None:
        x0, x1 = np.searchsorted(columns, (level.first[0], level.first[0] + level.shape[1]))
        y0, y1 = np.searchsorted(bands, (level.first[1], level.first[1] + level.shape[0]))
        if x0 == x1 or y0 == y1:
            return
        program = self._program(shape, TARGETS[target.dtype])
        program["window"] = int(x0), int(x1), len(columns) + int(y0)
        program["grid_first"] = level.first
        program["grid_corner"] = tuple(
            first * level.side - origin
            for first, origin in zip(level.first, tile.origin, strict=True)
        )
        program["grid_columns"] = level.shape[1]
        program["cell_side"] = level.side
        program["pixel_size"] = 1.0 / view.scale[0], 1.0 / view.scale[1]
        buffers = (tile.records, level.offsets, level.entries, self._runs[level.side, shape])
        for binding, buffer in enumerate(buffers):
            buffer.bind_to_storage_buffer(binding)
        program.run(-(-int(x1 - x0) // shape.runs), int(y1 - y0))
        self.ctx.memory_barrier(moderngl.SHADER_IMAGE_ACCESS_BARRIER_BIT)

    def _program(self, shape: Shape, target: str) -> moderngl.ComputeShader:
        if (shape, target) not in self._programs:
            defines = {
                "ROWS": shape.rows,
                "RUNS": shape.runs,
                "PIXELS": shape.pixels,
                "LINES": shape.lines,
                "TARGET": target,
            }
            source = load_shader(self.ctx, "rasterize.comp", defines)
            self._programs[shape, target] = self.ctx.compute_shader(source)
        return self._programs[shape, target]


def choose(sides: Sequence[float], view: View, shapes: tuple[Shape, ...]) -> tuple[int, Shape]:
    """The first shape that the cells of some level fill, and the index of the finest such level.

    sides: of the cells of each level, source pixels, ascending. Where none fills any shape, the
    coarsest level and the last shape.
    """
    scale = math.sqrt(view.scale[0] * view.scale[1])
    for shape in shapes:
        for index, side in enumerate(sides):
            if side * scale >= shape.reach:
                return index, shape
    return len(sides) - 1, shapes[-1]


def runs(
    origin: float, scale: float, start: int, stop: int, side: float, longest: int
) -> np.ndarray:
    """The output pixels [start, stop) of one axis, cut where cells begin; (R,) of RUN.

    In float64, from the cell's edge: a sample's position is exact at any zoom. A run has at most
    `longest` pixels, and those of one cell are equally long to within one.
    """
    pixel = np.arange(start, stop)
    centre = origin + (pixel + 0.5) / scale
    cell = np.floor(centre / side)
    edges = np.flatnonzero(np.diff(cell)) + 1
    first = np.concatenate([[0], edges]).astype(np.int64)[: max(1, len(pixel))]
    total = np.diff(np.concatenate([first, [len(pixel)]]))
    pieces = -(-total // longest)
    group = np.repeat(np.arange(len(first)), pieces)
    part = np.arange(len(group)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    begin = first[group] + total[group] * part // pieces[group]
    end = first[group] + total[group] * (part + 1) // pieces[group]
    made = np.empty(len(group), RUN)
    made["pixel"] = start + begin
    made["count"] = end - begin
    made["cell"] = np.clip(cell[begin], -(2**30), 2**30)
    made["offset"] = centre[begin] - cell[begin] * side
    return made


def load_shader(ctx: moderngl.Context, name: str, defines: dict[str, object] | None = None) -> str:
    """Source of shaders/`name` with `defines` after its version line; its includes are resolved."""
    for path in shipped("shaders").glob("*.glsl"):
        ctx.includes.setdefault(path.name, path.read_text())
    version, rest = shipped(f"shaders/{name}").read_text().split("\n", 1)
    lines = [version, *(f"#define {key} {value}" for key, value in (defines or {}).items()), rest]
    return "\n".join(lines)


def create_context() -> moderngl.Context:
    """A headless context of OpenGL 4.3 or later, current on the calling thread.

    Raises BackendError if there is none.
    """
    try:
        return moderngl.create_context(require=430, standalone=True, backend="egl")
    except Exception as failure:  # moderngl and glcontext raise bare Exception and ValueError
        raise BackendError(
            "No headless OpenGL 4.3 here; install a GPU driver or Mesa (libegl1 and "
            "libgl1-mesa-dri), or use --backend cpu."
        ) from failure


@functools.cache
def driver() -> dict:
    """What a headless context says of itself, by OpenGL's names. Raises BackendError if none."""
    # On a thread of its own, as a new context would displace the caller's.
    with ThreadPoolExecutor(1, thread_name_prefix="gl-probe") as thread:
        return thread.submit(_ask_driver).result()


def _ask_driver() -> dict:
    ctx = create_context()
    try:
        return dict(ctx.info)
    finally:
        ctx.release()


def software(info: dict) -> bool:
    """Whether a context with this `info` draws on the CPU."""
    return any(name in info["GL_RENDERER"].lower() for name in SOFTWARE)


@functools.cache
def hardware() -> bool:
    """Whether a headless OpenGL 4.3 device is here that is no software renderer. Never raises."""
    try:
        return not software(driver())
    except BackendError:
        return False


def render(gaussians: Gaussians, view: View, quality: str = "export") -> np.ndarray:
    """(h, w, 3) float32 image of the Gaussians through the view, not clamped; any size.

    Needs no window, and can be called from any thread: one thread of the process owns the
    context and draws. Raises BackendError where there is no OpenGL 4.3 or not enough memory.
    """
    return _drawing_thread().submit(_render, gaussians, view, quality).result()


@functools.cache
def _drawing_thread() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(1, thread_name_prefix="gl-render")


@functools.cache
def _headless() -> GlRasterizer:
    """Of the drawing thread, and only to be called there."""
    return GlRasterizer(create_context())


def _render(gaussians: Gaussians, view: View, quality: str) -> np.ndarray:
    rasterizer = _headless()
    image = np.zeros((*view.size, 3), np.float32)
    if image.size == 0 or len(gaussians) == 0:
        return image
    sides = (rasterizer.side(view),)
    held: list[GlTile] = []
    try:
        for part in split_tiles(visible(gaussians, view, quality)):
            held.append(rasterizer.upload(pack(part, quality, sides)))
            if sum(tile.nbytes for tile in held) > HELD:
                _add(rasterizer, held, view, image)
        _add(rasterizer, held, view, image)
    finally:
        for tile in held:
            tile.release()
    return image


def _add(rasterizer: GlRasterizer, tiles: list[GlTile], view: View, image: np.ndarray) -> None:
    """Add the tiles to the image, piece by piece of what a texture holds, and free them."""
    height, width = view.size
    most = min(BLOCK, rasterizer.ctx.info["GL_MAX_TEXTURE_SIZE"])
    for x in range(0, width, most):
        columns = min(most, width - x)
        rows = max(1, min(most, PIXELS // columns))
        for y in range(0, height, rows):
            piece = _piece(view, x, y, columns, min(rows, height - y))
            if any(tile.meets(piece) for tile in tiles):
                drawn = _draw(rasterizer, tiles, piece)
                image[y : y + piece.size[0], x : x + columns] += drawn
    while tiles:
        tiles.pop().release()


def _piece(view: View, x: int, y: int, width: int, height: int) -> View:
    return View(view.to_source(x, y), view.scale, (height, width))


def _draw(rasterizer: GlRasterizer, tiles: list[GlTile], view: View) -> np.ndarray:
    height, width = view.size
    try:
        target = rasterizer.ctx.texture((width, height), 4, dtype="f4")
    except moderngl.Error as failure:
        raise BackendError("The GPU is out of memory; use --backend cpu.") from failure
    try:
        rasterizer.draw(tiles, view, target)
        return np.frombuffer(target.read(), np.float32).reshape(height, width, 4)[..., :3]
    finally:
        target.release()
