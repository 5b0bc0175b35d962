"""Rasterizer in OpenGL 4.3 compute shaders: for the screen, and for export on any GPU.

What a view shows is the sum of its visible tiles of Gaussians. Each tile is indexed once, in
cells of the source image (tiles.py, cells.py), and a frame of any zoom only reads those lists.
"""

from __future__ import annotations

import functools
from collections.abc import Generator, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from typing import TYPE_CHECKING

import moderngl
import numpy as np

from ..errors import RequestError
from ..view import View
from . import blocks
from .blocks import HARDWARE, RUN, SOFTWARE, Load, Shape
from .cells import CELL_SIDES, ENTRIES_PER_GAUSSIAN
from .gl_index import GlIndex
from .gl_tile import GlLevel, GlTile, allocate
from .opengl import create_context, load_shader, software, storage_limit, with_room
from .tiles import MOST, PackedTile, pack, split_tiles, visible

if TYPE_CHECKING:
    from ..gaussians import Gaussians

__all__ = ["GlRasterizer", "GlTile", "pack", "render", "split_tiles"]

TARGETS = {"f2": "rgba16f", "f4": "rgba32f"}
BLOCK = 4096  # widest piece that `render` draws at once, pixels
PIXELS = 1 << 22  # most pixels in such a piece: 64 MiB
PORTION = 1 << 15  # most pairs of a list that are read at once: llvmpipe ends loops at 2^16
STEP = 1 << 22  # bytes of a tile that are uploaded at once
PAUSE = 1e-3  # seconds of a step that waits for a tile to be packed
HELD = 1 << 29  # bytes of tiles that `render` holds on the GPU at once, about


@dataclass(frozen=True)
class _Variant:
    """Which of the programs made of rasterize.comp."""

    target: str
    block: int
    steep: bool = False
    packed: bool = True
    wide: bool = False


@dataclass(frozen=True)
class _Pass:
    """A dispatch for a tile: the side of blocks, whether to evaluate at every pixel, which lists of
    a cell (see rasterize.comp), and the most pairs that these can hold."""

    block: int
    steep: bool
    part: tuple[int, int]
    longest: int


@dataclass(frozen=True)
class _Runs:
    """How a view is cut for one size of cells and of blocks (see blocks.runs)."""

    buffer: moderngl.Buffer
    columns: np.ndarray  # the cell of every run, ascending
    lines: np.ndarray


class GlRasterizer:
    """Draws tiles of Gaussians with a given context, on that context's thread."""

    def __init__(
        self, ctx: moderngl.Context, shape: Shape | None = None, index: bool | None = None
    ) -> None:
        """shape: what suits the device (see blocks.Shape), if not what its kind suggests.
        index: whether shaders index Gaussians, if not as its kind suggests (a GPU does).
        """
        self.ctx = ctx
        emulated = software(ctx.info)
        self.shape = shape or (SOFTWARE if emulated else HARDWARE)
        self._index = GlIndex(ctx) if index or (index is None and not emulated) else None
        self._programs: dict[_Variant, moderngl.ComputeShader] = {}
        self._buffers: dict[tuple[float, int], moderngl.Buffer] = {}

    def warm_up(self, dtype: str = "f2") -> None:
        """Compile all that `draw` usually needs for such a target, lest a first frame stutter.

        Some drivers, software among them, compile when a program first runs: so it runs.
        """
        for _ in self.warming(dtype):
            pass

    def warming(self, dtype: str = "f2") -> Iterator[None]:
        """The same, one program per step."""
        usual = [_Variant(TARGETS[dtype], block) for block in self.shape.blocks]
        for variant in (*usual, _Variant(TARGETS[dtype], self.shape.steep, steep=True)):
            # No power of two: llvmpipe compiles anew for sides that are none.
            target = with_room(self.ctx, self.ctx.texture, (3, 3), 4, dtype=dtype)
            target.bind_to_image(0, read=True, write=True)
            program = self._program(variant)
            program["window"] = 0, 0, 0, 0  # no runs: every thread ends at once
            program.run(1, 1)
            self.ctx.finish()
            target.release()
            yield
        if self._index is not None:
            yield from self._index.warming()

    @property
    def packs(self) -> bool:
        """Should Gaussians be packed on a worker, since `upload` would do it on the CPU?"""
        return self._index is None

    @property
    def most(self) -> int:
        """Gaussians of a tile, at most (see split_tiles): the driver takes no larger buffers."""
        return min(MOST, storage_limit(self.ctx) // (4 * ENTRIES_PER_GAUSSIAN))

    def upload(
        self,
        tile: PackedTile | Gaussians,
        quality: str = "screen",
        sides: tuple[float, ...] = CELL_SIDES,
    ) -> GlTile:
        """The tile on the GPU; quality, sides: as in `pack`, of Gaussians that are not yet packed.

        Raises BackendError when the GPU has no room for it, or takes no buffers so large.
        """
        steps = self.uploading(tile, quality, sides)
        while True:
            try:
                next(steps)
            except StopIteration as end:
                return end.value

    def uploading(
        self,
        tile: PackedTile | Gaussians,
        quality: str = "screen",
        sides: tuple[float, ...] = CELL_SIDES,
    ) -> Generator[None, None, GlTile]:
        """The same in steps of a few milliseconds, between which frames can be drawn.

        If they are not gone through, nothing stays on the GPU.
        """
        if not isinstance(tile, PackedTile):
            made = self._index.build(tile, quality, sides) if self._index else None
            if made is not None:
                return made
            tile = yield from _packing(tile, quality, sides)
        arrays = [tile.records.data, *(a for c in tile.levels for a in (c.lists, c.entries))]
        buffers = allocate(self.ctx, [array.nbytes for array in arrays])
        try:
            for array, buffer in zip(arrays, buffers, strict=True):
                data = array.reshape(-1).view(np.uint8)
                for start in range(0, len(data), STEP):
                    with_room(self.ctx, buffer.write, data[start : start + STEP], offset=start)
                    yield
        except BaseException:
            for buffer in buffers:
                buffer.release()
            raise
        levels = tuple(
            GlLevel(
                cells.side,
                cells.first,
                cells.shape,
                *buffers[1 + 2 * i : 3 + 2 * i],
                cells.wide,
                cells.count - cells.steep,
                cells.steep,
                cells.longest,
            )
            for i, cells in enumerate(tile.levels)
        )
        return GlTile(
            len(tile),
            tile.origin,
            tile.bounds,
            tile.extent,
            tile.largest,
            buffers[0],
            tile.records.unpacking,
            levels,
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
        kind = TARGETS[target.dtype]
        cut: dict[tuple[float, int], _Runs] = {}

        def runs(side: float, block: int) -> _Runs:
            if (side, block) not in cut:
                cut[side, block] = self._cut(view, start, stop, side, block)
            return cut[side, block]

        for tile, level, block in self._plan([tile for tile in tiles if tile.meets(view)], view):
            for drawing in _passes(level, block, view, self.shape):
                packed = tile.unpacking is not None
                variant = _Variant(kind, drawing.block, drawing.steep, packed, level.wide)
                by = runs(level.side, drawing.block)
                self._draw_tile(variant, tile, level, view, by, drawing)
        self.ctx.memory_barrier()

    def release(self) -> None:
        """Free the programs and buffers (not the tiles, nor the context)."""
        for held in (*self._programs.values(), *self._buffers.values()):
            held.release()
        self._programs.clear()
        self._buffers.clear()
        if self._index is not None:
            self._index.release()

    def _clear(self, target: moderngl.Texture, start: int, stop: int) -> None:
        framebuffer = self.ctx.framebuffer([target])
        framebuffer.clear(alpha=1.0, viewport=(0, start, target.width, stop - start))
        framebuffer.release()

    def _plan(self, tiles: list[GlTile], view: View) -> Iterator[tuple[GlTile, GlLevel, int]]:
        """Each tile with the index and the side of the blocks to draw it by."""
        alike: dict[tuple[float, ...], list[GlTile]] = {}
        for tile in tiles:
            alike.setdefault(tuple(level.side for level in tile.levels), []).append(tile)
        for sides, group in alike.items():
            loads = [_load([tile.levels[i] for tile in group]) for i in range(len(sides))]
            side, block = blocks.choose(loads, blocks.scale_of(view), self.shape)
            for tile in group:
                yield tile, tile.levels[sides.index(side)], block

    def _cut(self, view: View, start: int, stop: int, side: float, block: int) -> _Runs:
        columns = blocks.runs(view.origin[0], view.scale[0], 0, view.size[1], side, block)
        lines = blocks.runs(view.origin[1], view.scale[1], start, stop, side, block)
        data = np.concatenate([columns, lines])
        buffer = self._buffers.get((side, block))
        if buffer is None or buffer.size < data.nbytes:
            (larger,) = allocate(self.ctx, [2 * max(data.nbytes, RUN.itemsize)])
            if buffer is not None:
                buffer.release()
            buffer = self._buffers[side, block] = larger
        buffer.orphan()
        buffer.write(data)
        return _Runs(buffer, columns["cell"], lines["cell"])

    def _draw_tile(
        self,
        variant: _Variant,
        tile: GlTile,
        level: GlLevel,
        view: View,
        runs: _Runs,
        drawing: _Pass,
    ) -> None:
        x0, x1 = np.searchsorted(runs.columns, (level.first[0], level.first[0] + level.shape[1]))
        y0, y1 = np.searchsorted(runs.lines, (level.first[1], level.first[1] + level.shape[0]))
        if x0 == x1 or y0 == y1:
            return
        program = self._program(variant)
        before = len(runs.columns)
        program["window"] = int(x0), int(x1), before + int(y0), before + int(y1)
        program["grid_first"] = level.first
        program["grid_corner"] = tuple(
            first * level.side - origin
            for first, origin in zip(level.first, tile.origin, strict=True)
        )
        program["grid_columns"] = level.shape[1]
        program["cell_side"] = level.side
        program["pixel_size"] = 1.0 / view.scale[0], 1.0 / view.scale[1]
        if tile.unpacking is not None:
            program["unpacking"] = tile.unpacking
        buffers = (tile.records, level.lists, level.entries, runs.buffer)
        for binding, buffer in enumerate(buffers):
            buffer.bind_to_storage_buffer(binding)
        across, down = (
            -(-int(count) // threads)
            for count, threads in zip((x1 - x0, y1 - y0), self.shape.threads, strict=True)
        )
        program["part"] = drawing.part
        for start in range(0, drawing.longest, PORTION):
            program["portion"] = start, start + PORTION
            program.run(across, down)
            self.ctx.memory_barrier(moderngl.SHADER_IMAGE_ACCESS_BARRIER_BIT)

    def _program(self, variant: _Variant) -> moderngl.ComputeShader:
        if variant not in self._programs:
            flags = {"STEEP": variant.steep, "PACKED": variant.packed, "WIDE": variant.wide}
            defines = {
                "BLOCK": variant.block,
                "THREADS_X": self.shape.threads[0],
                "THREADS_Y": self.shape.threads[1],
                "TARGET": variant.target,
                **{name: 1 for name, wanted in flags.items() if wanted},
            }
            source = load_shader(self.ctx, "rasterize.comp", defines)
            self._programs[variant] = self.ctx.compute_shader(source)
        return self._programs[variant]


def _passes(level: GlLevel, block: int, view: View, shape: Shape) -> Iterator[_Pass]:
    """Ordinary Gaussians, then steep ones; all as if steep where cells are too small (THIN)."""
    if level.side * min(view.scale) < blocks.THIN:
        yield _Pass(shape.steep, True, (0, 3), 2 * level.longest)
        return
    if level.ordinary:
        yield _Pass(block, False, (0, 1), level.longest)
    if level.steep:
        yield _Pass(shape.steep, True, (1, 3), level.longest)


def _packing(
    gaussians: Gaussians, quality: str, sides: tuple[float, ...]
) -> Generator[None, None, PackedTile]:
    """What `pack` makes, on a thread meanwhile, as it takes longer than a frame."""
    thread = ThreadPoolExecutor(1, thread_name_prefix="gl-pack")
    packed = thread.submit(pack, gaussians, quality, sides)
    thread.shutdown(wait=False)  # once it is done, whether or not the steps are gone through
    while not packed.done():
        wait([packed], PAUSE)  # to go through the steps without a break costs no core
        yield
    return packed.result()


def _load(levels: list[GlLevel]) -> Load:
    """Of drawing these indexes, all of one size of cells."""
    cells = max(1, sum(level.shape[0] * level.shape[1] for level in levels))
    ordinary, steep = sum(level.ordinary for level in levels), sum(level.steep for level in levels)
    return Load(levels[0].side, ordinary / cells, steep / cells)


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
    sides = (blocks.side_for(view),)  # the only view of these tiles
    held: list[GlTile] = []
    try:
        for part in split_tiles(visible(gaussians, view, quality), most=rasterizer.most):
            held.append(rasterizer.upload(part, quality, sides))
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
    target = with_room(rasterizer.ctx, rasterizer.ctx.texture, (width, height), 4, dtype="f4")
    try:
        rasterizer.draw(tiles, view, target)
        return np.frombuffer(target.read(), np.float32).reshape(height, width, 4)[..., :3]
    finally:
        target.release()
