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

from .contestant import GlContestant, visits


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
        self._levels = [[_lists(level) for level in tile.levels] for tile in packed]
        self.tiles = [self.rasterizer.upload(tile) for tile in packed]
        self.gaussians = sum(tile.records.size for tile in self.tiles)
        self.index = sum(tile.nbytes for tile in self.tiles) - self.gaussians

    def draw(self, view: View) -> None:
        self.rasterizer.draw(self.tiles, view, self.target(view))

    def evaluations(self, view: View) -> int:
        """Not counted: slots of a thread's block of pixels that lie beyond its cell."""
        total = 0
        for tile, levels in zip(self.tiles, self._levels, strict=True):
            if tile.meets(view):
                sides = [side for side, _, _ in levels]
                index, _ = gl.choose(sides, view, self.rasterizer._shapes)
                side, first, lengths = levels[index]
                total += visits(lengths, first, side, view)
        return total

    def mean_list(self) -> float:
        """Entries of the finest index per cell that has any."""
        lengths = [levels[0][2] for levels in self._levels]
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


def with_empty_lists(tile: PackedTile) -> PackedTile:
    """The same grid of cells with nothing in them: a frame without the Gaussians."""
    return replace(
        tile, levels=tuple(replace(c, offsets=np.zeros_like(c.offsets)) for c in tile.levels)
    )


def with_one_gaussian(tile: PackedTile) -> PackedTile:
    """Lists as long as before, but of the first Gaussian only: a frame that waits for no memory."""
    return replace(
        tile, levels=tuple(replace(c, entries=np.zeros_like(c.entries)) for c in tile.levels)
    )


def _lists(level) -> tuple[float, tuple[int, int], np.ndarray]:
    """Side of the cells, the first one and the lengths of their lists (rows, columns)."""
    # A cell has two lists, smooth and steep, and a pixel reads both.
    lengths = np.diff(level.offsets.astype(np.int64)).reshape(*level.shape, 2).sum(axis=2)
    return level.side, level.first, lengths
