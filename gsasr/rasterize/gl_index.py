"""Records and index of a tile of Gaussians made by the GPU: what tiles.pack makes, in shaders.

Every Gaussian finds its place in the order of source pixels (count per pixel, prefix sum, scatter)
and then its cells, for each size of these (count, prefix sum, fill). Lists hold the same Gaussians
as those of cells.py, or a few more that miss a cell by less than SLACK, in no fixed order.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import moderngl
import numpy as np

from . import cells
from .cells import CELL_SIDES
from .gl_tile import GlLevel, GlTile, allocate
from .opengl import load_shader
from .records import FOLD, unpacking_of
from .tiles import MOST, SIDE, THINNEST

if TYPE_CHECKING:
    from ..gaussians import Gaussians

THREADS = 128  # of a workgroup
REACH = 64  # source pixels; Gaussians that reach farther from their mean are left to the CPU
SLACK = 2.0**-12  # source pixels; beyond what float32 rounds off positions below 512
COARSEST = int(CELL_SIDES[-1])
PIXELS = SIDE + COARSEST  # along a side of a tile whose origin is a multiple of COARSEST
GRID = PIXELS + 2 * REACH + COARSEST  # cells of side 1 along a side, with what footprints reach
CELLS = sum((GRID >> level) ** 2 for level in range(len(CELL_SIDES)))  # of all levels

# What shaders find out about a tile: the greatest of each of these, then sums (index.glsl); LEFT,
# TOP, NARROWEST, FLATTEST, FIRST_COLUMN and FIRST_ROW are inverted. Some are kept for each level.
MAXIMA = (
    "LEFT", "TOP", "RIGHT", "BOTTOM",  # of the means, as `rank` in index.glsl
    "NARROWEST", "FLATTEST", "WIDEST", "BRIGHTEST", "DENSEST",  # bits of floats
    "UNFIT",  # 1 if the tile is not for these shaders
    "FIRST_COLUMN", "FIRST_ROW", "LAST_COLUMN", "LAST_ROW",  # cells of side 1 that are met
)  # fmt: skip
LEVEL_MAXIMA = (
    "LONGEST",
    "SPAN",
)  # pairs in a list; from the least place in a cell to the greatest
SUMS = ("BOXES",)  # cells in bounding boxes, in units of 8
LEVEL_SUMS = ("PAIRS", "ORDINARY", "STEEP")  # pairs of entries; entries of either kind
SLOTS = {
    name: number
    for number, name in enumerate(
        name if level == 0 else f"{name}_{level}"
        for names, levels in (
            (MAXIMA, 1), (LEVEL_MAXIMA, len(CELL_SIDES)), (SUMS, 1), (LEVEL_SUMS, len(CELL_SIDES))
        )
        for name in names
        for level in range(levels)
    )
}  # fmt: skip

# Tables that are zero at first, in uint32 (see index_pixels.glsl, index_load.comp and
# index_tables.glsl), and where shaders bind them
TABLES = {
    "found": (1, len(SLOTS)),
    "heads": (3, PIXELS**2),
    "loads": (4, 2 * PIXELS**2),
    "counts": (3, 2 * CELLS),
    "starts": (4, 2 * CELLS + 1),
    "spans": (5, 2 * CELLS),
}
PROGRAMS = ("clear", "measure", "load", "densest", "place", "cells", "pairs", "lists", "records")
ALIGNMENT = 64  # uint32; the most that a driver may demand of a table's offset
DEFINES = {
    **SLOTS,
    "FOUND": len(SLOTS),
    "SUMS": SLOTS[SUMS[0]],
    "THREADS": THREADS,
    "LEVELS": len(CELL_SIDES),
    "COARSEST": float(COARSEST),
    "REACH": float(REACH),
    "MARGIN": float(REACH),
    "SLACK": SLACK,
    "PIXELS": PIXELS,
    "GRID": GRID,
    "THINNEST": THINNEST,
    "LARGEST": float(1 << 22),  # area, square source pixels: 32 bits hold it in 256ths
    "FOLD": FOLD,
    "STEEP_FROM": cells.STEEP,
    "STEEP_SIDE": cells.STEEP_SIDE,
}


class GlIndex:
    """Makes tiles with a given context, on that context's thread."""

    def __init__(self, ctx: moderngl.Context) -> None:
        self.ctx = ctx
        self._scan = PrefixSum(ctx)
        self._programs: dict[tuple[str, bool], moderngl.ComputeShader] = {}
        self._tables: moderngl.Buffer | None = None
        self._offsets: dict[str, int] = {}
        end = 0
        for name, (_, size) in TABLES.items():
            self._offsets[name] = end
            end += -(-size // ALIGNMENT) * ALIGNMENT
        self._table_size = end

    def warming(self) -> Iterator[None]:
        """Compile what `build` needs for the screen, lest a first tile wait; a program per step."""
        for name in PROGRAMS:
            self._program(name, packed=name == "records")
            yield
        yield from self._scan.warming()

    def build(
        self, gaussians: Gaussians, quality: str, sides: tuple[float, ...] = CELL_SIDES
    ) -> GlTile | None:
        """The tile that tiles.pack and GlRasterizer.upload make, or None if it needs the CPU.

        That is the case where nothing is drawn, where one Gaussian reaches farther than REACH, and
        where pack would make larger cells than asked for, or raise an error.

        The one read-back, of `found`, tells how large the tile's buffers have to be: the bounds
        that are known before are more than twice that. Raises BackendError as allocate does.
        """
        from .footprint import TOLERANCE

        known = quality in TOLERANCE and set(sides) <= set(CELL_SIDES)
        if not (known and 0 < len(gaussians) <= MOST and _single(gaussians)):
            return None
        if self._tables is None:
            (self._tables,) = allocate(self.ctx, [4 * self._table_size])
        table = _table(gaussians)
        levels = [CELL_SIDES.index(side) for side in sides]
        most = max(cells.FEW, cells.ENTRIES_PER_GAUSSIAN * len(table))
        uniforms = {
            "count": len(table),
            "tolerance": TOLERANCE[quality],
            "finest": levels[0],
            "most_boxes": most // 2,  # 4 times as many cells: boxes are larger than ellipses
        }
        raw, places = allocate(self.ctx, [table, 4 * len(table)])
        try:
            work = _Work(len(table), raw, places, uniforms)
            self._count(work, levels)
            found = _Found(np.frombuffer(self._tables.read(4 * len(SLOTS)), np.uint32))
            if not found.suits(levels[0], len(table), most):
                return None
            return self._fill(work, found, levels, packed=quality == "screen")
        finally:
            raw.release()
            places.release()

    def release(self) -> None:
        """Free the programs and buffers (not the tiles, nor the context)."""
        for program in self._programs.values():
            program.release()
        self._programs.clear()
        self._scan.release()
        if self._tables is not None:
            self._tables.release()
            self._tables = None

    def _count(self, work: _Work, levels: list[int]) -> None:
        """All up to the lengths of all lists."""
        self._clear(self._tables)
        self._run("measure", work, work.count)
        self._run("load", work, work.count, ("heads", "loads"))
        self._run("densest", work, PIXELS**2, ("loads",))
        self._scan.run(self._tables, self._offsets["heads"], PIXELS**2)
        self._run("place", work, work.count, ("heads",))
        for level in levels:
            tables = ("counts", "starts", "spans")
            self._run("cells", work, work.count, tables, level=level, listing=False)
        self._run("pairs", work, 2 * CELLS, ("counts", "starts", "spans"))

    def _fill(self, work: _Work, found: _Found, levels: list[int], packed: bool) -> GlTile:
        self._scan.run(self._tables, self._offsets["starts"], 2 * CELLS + 1)
        unpacking = found.unpacking() if packed else None
        shapes = [found.shape(level) for level in levels]
        sizes = [(work.count + 1) * (16 if unpacking else 32)]
        for level, (rows, columns) in zip(levels, shapes, strict=True):
            wide = found.wide(level)
            sizes += [4 * (3 * rows * columns + 1), (8 if wide else 4) * found.get("PAIRS", level)]
        records, *buffers = allocate(self.ctx, sizes)
        records.bind_to_storage_buffer(6)
        short = {"unpacking": unpacking} if unpacking else {}
        self._run("records", work, work.count, packed=bool(unpacking), **short)
        made = []
        for level, (rows, columns), lists, entries in zip(
            levels, shapes, buffers[::2], buffers[1::2], strict=True
        ):
            tables = ("counts", "starts", "spans")
            lists.bind_to_storage_buffer(6)
            where = {"first": found.first(level), "shape": (columns, rows)}
            self._run("lists", work, rows * columns + 1, tables, level=level, **where)
            self._clear(entries)
            entries.bind_to_storage_buffer(6)
            wide = found.wide(level)
            self._run("cells", work, work.count, tables, level=level, listing=True, wide=wide)
            made.append(
                GlLevel(
                    side=CELL_SIDES[level],
                    first=found.first_cell(level),
                    shape=(rows, columns),
                    lists=lists,
                    entries=entries,
                    wide=wide,
                    ordinary=found.get("ORDINARY", level),
                    steep=found.get("STEEP", level),
                    longest=found.get("LONGEST", level),
                )
            )
        return GlTile(
            count=work.count,
            origin=found.origin,
            bounds=found.bounds(levels[0]),
            extent=found.extent,
            largest=found.real("WIDEST"),
            records=records,
            unpacking=unpacking,
            levels=tuple(made),
        )

    def _run(
        self,
        name: str,
        work: _Work,
        threads: int,
        tables: tuple[str, ...] = (),
        packed: bool = False,
        **uniforms: object,
    ) -> None:
        """One shader over so many threads.

        What it writes of the tile itself (records, lists, entries) must have been bound to 6.
        """
        program = self._program(name, packed)
        work.raw.bind_to_storage_buffer(0)
        work.places.bind_to_storage_buffer(2)
        for table in ("found", *tables):
            binding, size = TABLES[table]
            self._tables.bind_to_storage_buffer(binding, 4 * self._offsets[table], 4 * size)
        for uniform, value in {**work.uniforms, **uniforms}.items():
            if uniform in program:  # some read only a few of them
                program[uniform] = value
        program.run(-(-threads // THREADS))
        self.ctx.memory_barrier()

    def _clear(self, buffer: moderngl.Buffer) -> None:
        """By a shader: moderngl itself would do it on the CPU, and wait for the GPU first."""
        program = self._program("clear")
        buffer.bind_to_storage_buffer(0)
        program["count"] = buffer.size // 4
        program.run(min(1 << 14, -(-buffer.size // (4 * THREADS))))
        self.ctx.memory_barrier()

    def _program(self, name: str, packed: bool = False) -> moderngl.ComputeShader:
        if (name, packed) not in self._programs:
            defines = {**DEFINES, **({"PACKED": 1} if packed else {})}
            source = load_shader(self.ctx, f"index_{name}.comp", defines)
            self._programs[name, packed] = self.ctx.compute_shader(source)
        return self._programs[name, packed]


class PrefixSum:
    """Exclusive prefix sums of uint32 in a buffer, in place; of any number of them."""

    BLOCK = 1024  # values of a workgroup

    def __init__(self, ctx: moderngl.Context) -> None:
        self.ctx = ctx
        self._programs: dict[bool, moderngl.ComputeShader] = {}
        self._sums: list[moderngl.Buffer] = []  # of blocks, of blocks of these, and so on

    def warming(self) -> Iterator[None]:
        """Compile what `run` needs, one program per step."""
        for carry in (False, True):
            self._program(carry)
            yield

    def run(self, values: moderngl.Buffer, start: int, count: int, depth: int = 0) -> None:
        """Of `count` values from number `start` on, which must be a multiple of ALIGNMENT."""
        blocks = -(-count // self.BLOCK)
        if depth == len(self._sums):
            self._sums += allocate(self.ctx, [4 * blocks])
        elif self._sums[depth].size < 4 * blocks:
            (larger,) = allocate(self.ctx, [4 * blocks])
            self._sums[depth].release()
            self._sums[depth] = larger
        sums = self._sums[depth]
        self._run(self._program(carry=False), values, start, count, sums)
        if blocks > 1:
            self.run(sums, 0, blocks, depth + 1)
            self._run(self._program(carry=True), values, start, count, sums)

    def release(self) -> None:
        """Free the programs and buffers."""
        for held in (*self._programs.values(), *self._sums):
            held.release()
        self._programs.clear()
        self._sums.clear()

    def _program(self, carry: bool) -> moderngl.ComputeShader:
        """That sums up blocks, or that carries the sums of blocks into these."""
        if carry not in self._programs:
            defines = {"THREADS": THREADS, "BLOCK": self.BLOCK, **({"CARRY": 1} if carry else {})}
            source = load_shader(self.ctx, "prefix_sum.comp", defines)
            self._programs[carry] = self.ctx.compute_shader(source)
        return self._programs[carry]

    def _run(self, program, values, start: int, count: int, sums) -> None:
        values.bind_to_storage_buffer(0, 4 * start, 4 * count)
        sums.bind_to_storage_buffer(1)
        program["count"] = count
        program.run(-(-count // self.BLOCK))
        self.ctx.memory_barrier()


@dataclass(frozen=True)
class _Work:
    """A tile that is being made: its Gaussians as they came, and their places."""

    count: int
    raw: moderngl.Buffer
    places: moderngl.Buffer
    uniforms: dict[str, object]


@dataclass(frozen=True)
class _Found:
    """What shaders found out about a tile, by the names of SLOTS."""

    values: np.ndarray

    def get(self, name: str, level: int = 0) -> int:
        return int(self.values[SLOTS[name] + level])

    def inverted(self, name: str) -> int:
        return 0xFFFFFFFF - self.get(name)

    def real(self, name: str) -> float:
        return _float(self.get(name))

    def suits(self, finest: int, count: int, most: int) -> bool:
        """Would tiles.pack use cells of the same size, and are these results whole?"""
        nowhere = self.get("FIRST_COLUMN") == 0
        if self.get("UNFIT") or nowhere or self.get("BOXES") > most // 2:
            return False
        rows, columns = self.shape(finest)
        entries = self.get("ORDINARY", finest) + self.get("STEEP", finest)
        return entries <= most and rows * columns <= max(
            cells.FEW, cells.CELLS_PER_GAUSSIAN * count
        )

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Round all means."""
        low = (_unranked(self.inverted(name)) for name in ("LEFT", "TOP"))
        return *low, *(_unranked(self.get(name)) for name in ("RIGHT", "BOTTOM"))

    @property
    def origin(self) -> tuple[int, int]:
        """See origin in index.glsl."""
        x, y = (int(np.floor(edge / COARSEST)) * COARSEST for edge in self.extent[:2])
        return x, y

    def first(self, level: int) -> tuple[int, int]:
        """The first cell (column, row) of the shaders' grid that is met."""
        return self.inverted("FIRST_COLUMN") >> level, self.inverted("FIRST_ROW") >> level

    def first_cell(self, level: int) -> tuple[int, int]:
        """The same in the grid of all the picture."""
        side = 1 << level
        x, y = (
            cell + (origin - REACH) // side
            for cell, origin in zip(self.first(level), self.origin, strict=True)
        )
        return x, y

    def shape(self, level: int) -> tuple[int, int]:
        """Rows and columns of cells from there to the last that is met."""
        column, row = self.first(level)
        return (
            (self.get("LAST_ROW") >> level) - row + 1,
            (self.get("LAST_COLUMN") >> level) - column + 1,
        )

    def bounds(self, level: int) -> tuple[float, float, float, float]:
        """Round all footprints, source pixels."""
        side = CELL_SIDES[level]
        x, y = (cell * side for cell in self.first_cell(level))
        rows, columns = self.shape(level)
        return x, y, x + columns * side, y + rows * side

    def wide(self, level: int) -> bool:
        """Does a cell name Gaussians too far apart for 16 bits?"""
        return self.get("SPAN", level) >= cells.SHORT

    def unpacking(self) -> tuple[float, float, float] | None:
        """See Records."""
        corner = zip(self.extent[2:], self.origin, strict=True)
        farthest = max(1e-9, *(edge - start for edge, start in corner))
        narrowest, flattest = (_float(self.inverted(name)) for name in ("NARROWEST", "FLATTEST"))
        brightest = max(1e-9, self.real("BRIGHTEST"))
        return unpacking_of(narrowest, flattest, self.real("WIDEST"), brightest, farthest)


def _single(gaussians: Gaussians) -> bool:
    """Are these float32, or fewer bits?"""
    return all(tensor.element_size() <= 4 for tensor in gaussians.tensors().values())


def _table(gaussians: Gaussians) -> np.ndarray:
    """(N, 9) float32: mean, std, rho, color, opacity. Not copied if they lie so in memory, as those
    of split_tiles do: to copy a million takes 30 ms and more."""
    import torch

    count, tensors = len(gaussians), [t.detach().cpu() for t in gaussians.tensors().values()]
    mean = tensors[0]
    sizes = [t[:1].numel() for t in tensors]
    if all(
        t.dtype == torch.float32
        and t.stride() == (9, 1)[: t.ndim]
        and t.data_ptr() == mean.data_ptr() + 4 * sum(sizes[:i])
        for i, t in enumerate(tensors)
    ):
        return mean.as_strided((count, 9), (9, 1)).numpy()
    return torch.cat([t.reshape(count, -1) for t in tensors], dim=1).float().numpy()


def _float(bits: int) -> float:
    return float(np.uint32(bits).view(np.float32))


def _unranked(rank: int) -> float:
    """The float of such a `rank` (index.glsl)."""
    return _float(rank & 0x7FFFFFFF if rank >> 31 else 0xFFFFFFFF - rank)
