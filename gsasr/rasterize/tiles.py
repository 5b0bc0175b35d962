"""Gaussians made ready for the GPU, tile by tile: packed records and the lists of their cells.

NumPy and numba only, no OpenGL: this is the heavy part, and it can run on any thread.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from . import cells, records
from .cells import CELL_SIDES, Cells
from .jit import in_threads, jit, parts
from .records import Records

if TYPE_CHECKING:
    from ..gaussians import Gaussians
    from ..view import View

SIDE = 256  # of a tile, source pixels
MOST = 1_100_000  # Gaussians in a tile: none of its buffers exceeds 128 MiB, the usual limit
THINNEST = 1e-12  # source pixels; thinner would overflow, and no sample ever meets it


@dataclass(frozen=True)
class PackedTile:
    """One tile of Gaussians as the shaders read it.

    origin: (x, y) whole source pixels; the means in `records` are relative to it.
    records: of its Gaussians, in their order.
    levels: at least one index, finest first.
    bounds: (x0, y0, x1, y1), source pixels, round all footprints; empty if none is drawn.
    extent: likewise, round all means.
    largest: of all standard deviations, source pixels.
    """

    origin: tuple[int, int]
    records: Records
    levels: tuple[Cells, ...]
    bounds: tuple[float, float, float, float]
    extent: tuple[float, float, float, float]
    largest: float

    def __len__(self) -> int:
        return len(self.records.data) - 1


def split_tiles(gaussians: Gaussians, side: int = SIDE, most: int = MOST) -> list[Gaussians]:
    """The Gaussians by the tile (side x side source pixels, at most 256) that their mean lies in.

    At most `most` to a tile, so that its buffers stay below what a driver takes. Within a tile they
    follow the pixels of the source row by row, so that the lists of a cell name near neighbours.
    Returned on the CPU.
    """
    import torch

    if len(gaussians) == 0:
        return []
    mean = _array(gaussians.mean)
    x0, y0, x1, y1 = (math.floor(edge) for edge in _extent(mean))
    columns, rows = (x1 - x0) // side + 1, (y1 - y0) // side + 1
    number = np.empty(len(mean), np.uint16 if columns * rows <= 2**16 else np.float64)
    inside = np.empty(len(mean), np.uint16)
    _places(mean, float(x0), float(y0), float(side), float(columns), number, inside)
    # Sorting by 16 bits at a time is several times faster; the second sort keeps the first's order.
    order = np.argsort(inside, kind="stable")
    order = order[np.argsort(number[order], kind="stable")]
    edges = [0, *(np.flatnonzero(np.diff(number[order])) + 1).tolist(), len(order)]
    # One Gaussian's values side by side, as a GPU wants them (gl_index.py)
    table = np.empty((len(order), 9), np.float32)
    arrays = [_array(tensor) for tensor in gaussians.tensors().values()]
    calls = [(*arrays, order[a:b], table[a:b]) for a, b in parts(len(order), len(order) < 1 << 16)]
    in_threads(_gather, calls)
    mean, std, rho, color, opacity = torch.from_numpy(table).split([2, 2, 1, 3, 1], dim=1)
    ordered = replace(
        gaussians, mean=mean, std=std, rho=rho[:, 0], color=color, opacity=opacity[:, 0]
    )
    return [
        ordered[start : min(start + most, stop)]
        for begin, stop in pairwise(edges)
        for start in range(begin, stop, most)
    ]


def pack(
    gaussians: Gaussians, quality: str = "screen", sides: tuple[float, ...] = CELL_SIDES
) -> PackedTile:
    """Records and indexes of one tile (see split_tiles).

    quality: "screen" or "export" (see footprint.cut); decides how far each Gaussian reaches and
        how exactly it is kept.
    sides: of the cells to index by, source pixels, ascending; larger where Gaussians are large.
    """
    from . import footprint

    mean = _array(gaussians.mean)
    std = np.maximum(_array(gaussians.std), np.float32(THINNEST))
    rho = _array(gaussians.rho)
    cut = footprint.cut(gaussians, quality).numpy()
    levels = cells.build(mean, std, rho, cut, sides)
    finest = levels[0]
    rows, columns = finest.shape
    x, y = (first * finest.side for first in finest.first)
    bounds = (x, y, x + columns * finest.side, y + rows * finest.side)
    # Relative to the means, not to the footprints: one huge Gaussian must not cost the others bits.
    extent = _extent(mean)
    origin = (math.floor(extent[0]), math.floor(extent[1]))
    peak = _array(gaussians.peak)
    made = records.make(mean, std, rho, peak, origin, packed=quality == "screen")
    return PackedTile(origin, made, tuple(levels), bounds, extent, float(std.max(initial=0.0)))


def visible(gaussians: Gaussians, view: View, quality: str) -> Gaussians:
    """Those whose footprint may reach the view (by bounding box)."""
    from . import footprint

    reach = footprint.cut(gaussians, quality).clamp(min=0).sqrt()[:, None].numpy()
    reach = reach * _array(gaussians.std)
    mean = _array(gaussians.mean)
    low, high = np.array(view.origin), np.array(view.to_source(view.size[1], view.size[0]))
    return gaussians[((mean + reach >= low) & (mean - reach <= high)).all(axis=1)]


def _extent(mean: np.ndarray) -> tuple[float, float, float, float]:
    """(x0, y0, x1, y1) round all means; zeros if there is none."""
    if len(mean) == 0:
        return 0.0, 0.0, 0.0, 0.0
    x, y = mean[:, 0], mean[:, 1]  # several times faster than along an axis of two
    return float(x.min()), float(y.min()), float(x.max()), float(y.max())


@jit
def _places(mean, x0, y0, side, columns, number, inside):
    """The number of the tile that each mean is in, and of the pixel in it, row by row."""
    for n in range(mean.shape[0]):
        x, y = math.floor(np.float64(mean[n, 0])) - x0, math.floor(np.float64(mean[n, 1])) - y0
        across, down = math.floor(x / side), math.floor(y / side)
        number[n] = down * columns + across
        inside[n] = int((y - down * side) * side + (x - across * side))


@jit
def _gather(mean, std, rho, color, opacity, order, table):
    for i in range(order.shape[0]):
        n = order[i]
        table[i, 0], table[i, 1] = mean[n, 0], mean[n, 1]
        table[i, 2], table[i, 3] = std[n, 0], std[n, 1]
        table[i, 4] = rho[n]
        table[i, 5], table[i, 6], table[i, 7] = color[n, 0], color[n, 1], color[n, 2]
        table[i, 8] = opacity[n]


def _array(tensor) -> np.ndarray:
    return np.ascontiguousarray(tensor.detach().cpu().numpy(), np.float32)
