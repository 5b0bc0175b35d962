"""The rasterizer of this repository, as the viewer uses it.

The one place of the benchmarks that knows how its index is laid out.
"""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import moderngl
import numpy as np

from gsasr.gaussians import Gaussians
from gsasr.processor import cores
from gsasr.rasterize import gl
from gsasr.rasterize.tiles import PackedTile
from gsasr.view import View

from .contestant import GlContestant, gl_seconds, visits


class Ours(GlContestant):
    """Its tiles are on the GPU; `tiles` and `rasterizer` are what gsasr.rasterize.gl made."""

    name = "gsasr"
    dtype = "f2"  # as in the viewer

    def __init__(self, ctx: moderngl.Context, field: Gaussians) -> None:
        super().__init__(ctx)
        self.rasterizer = gl.GlRasterizer(ctx)
        self.rasterizer.warm_up(self.dtype)
        self.seconds = {}
        gl.pack(field[:1])  # compiles
        for threads in sorted({1, cores()}):
            start = time.perf_counter()
            packed = packed_field(field, threads)
            self.seconds[threads] = time.perf_counter() - start
        self.shader_seconds = seconds_by_shaders(ctx, field)
        self.tiles = [self.rasterizer.upload(tile) for tile in packed]
        self._levels = {
            id(tile): {level.side: _lists(level) for level in source.levels}
            for tile, source in zip(self.tiles, packed, strict=True)
        }
        self.gaussians = sum(tile.records.size for tile in self.tiles)
        self.index = sum(tile.nbytes for tile in self.tiles) - self.gaussians

    def draw(self, view: View) -> None:
        self.rasterizer.draw(self.tiles, view, self.target(view))

    def evaluations(self, view: View) -> int:
        """Not counted: slots of a thread's block of pixels that lie beyond its cell."""
        seen = [tile for tile in self.tiles if tile.meets(view)]
        total = 0
        for tile, level, _ in self.rasterizer._plan(seen, view):
            side, first, lengths = self._levels[id(tile)][level.side]
            total += visits(lengths, first, side, view)
        return total

    def mean_list(self) -> float:
        """Entries of the finest index per cell that has any."""
        lengths = [levels[min(levels)][2] for levels in self._levels.values()]
        return sum(map(np.sum, lengths)) / max(1, sum(map(np.count_nonzero, lengths)))

    def release(self) -> None:
        super().release()
        for tile in self.tiles:
            tile.release()
        self.rasterizer.release()


def packed_field(field: Gaussians, threads: int) -> list[PackedTile]:
    """All tiles of a field, ready to be uploaded."""
    parts = gl.split_tiles(field)
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(gl.pack, parts))


def seconds_by_shaders(ctx: moderngl.Context, field: Gaussians) -> float:
    """What uploading all tiles takes where shaders index them."""
    rasterizer = gl.GlRasterizer(ctx, index=True)
    parts = gl.split_tiles(field)
    rasterizer.upload(parts[0][:1000]).release()  # compiles

    def work() -> None:
        for part in parts:
            rasterizer.upload(part).release()

    seconds = gl_seconds(ctx, work)
    rasterizer.release()
    return seconds


def with_empty_lists(tile: PackedTile) -> PackedTile:
    """The same grid of cells with nothing in them: a frame without the Gaussians."""
    return replace(
        tile, levels=tuple(replace(c, lists=np.zeros_like(c.lists)) for c in tile.levels)
    )


def with_one_gaussian(tile: PackedTile) -> PackedTile:
    """Lists as long as before, but of the first Gaussian only: a frame that waits for no memory."""
    levels = []
    for cells in tile.levels:
        lists = cells.lists.copy()
        lists[2::3] = 0  # the bases
        levels.append(replace(cells, lists=lists, entries=np.ones_like(cells.entries)))
    return replace(tile, levels=tuple(levels))


def _lists(level) -> tuple[float, tuple[int, int], np.ndarray]:
    """Side of the cells, the first one and the lengths of their lists (rows, columns)."""
    pairs = np.diff(level.lists[::3].astype(np.int64))  # of ordinary and steep entries
    return level.side, level.first, 2 * pairs.reshape(level.shape)
