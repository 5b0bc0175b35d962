"""Gaussians made ready for the GPU, tile by tile: packed records and the lists of their cells.

NumPy and numba only, no OpenGL: this is the heavy part, and it can run on any thread.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from . import cells
from .cells import Cells

if TYPE_CHECKING:
    from ..gaussians import Gaussians
    from ..view import View

SIDE = 128  # of a tile, source pixels
MOST = 1 << 19  # Gaussians in a tile: 16 MiB of records, at most 96 MiB for one list
CELL_SIDES = (1.0, 2.0, 4.0)  # source pixels; small cells for high zooms, large ones for low
FOLD = math.sqrt(0.5 * math.log2(math.e))  # exp(-q/2) = 2^-(FOLD^2 q)
THINNEST = 1e-12  # source pixels; thinner would overflow, and no sample ever meets it


@dataclass(frozen=True)
class PackedTile:
    """One tile of Gaussians as the shaders read it.

    origin: (x, y) whole source pixels; the means in `records` are relative to it.
    records: (N, 8) float32, N in the order of the Gaussians: mean x and y, the whitening a, b, c
        of shaders/gaussian.glsl, and the peak red, green, blue (opacity * color).
    levels: at least one index, finest first.
    bounds: (x0, y0, x1, y1), source pixels, round all footprints; empty if none is drawn.
    extent: likewise, round all means.
    largest: of all standard deviations, source pixels.
    """

    origin: tuple[int, int]
    records: np.ndarray
    levels: tuple[Cells, ...]
    bounds: tuple[float, float, float, float]
    extent: tuple[float, float, float, float]
    largest: float

    def __len__(self) -> int:
        return len(self.records)


def split_tiles(gaussians: Gaussians, side: int = SIDE) -> list[Gaussians]:
    """The Gaussians by the tile (side x side source pixels) that their mean lies in.

    At most MOST to a tile, so that its buffers stay below what a driver takes; their order
    within a tile is kept.
    """
    if len(gaussians) == 0:
        return []
    keys = np.floor(_array(gaussians.mean) / side)
    order = np.lexsort((keys[:, 0], keys[:, 1]))
    changes = np.flatnonzero((np.diff(keys[order], axis=0) != 0).any(axis=1)) + 1
    parts = np.split(order, changes)
    return [
        gaussians[part[start : start + MOST]]
        for part in parts
        for start in range(0, len(part), MOST)
    ]


def pack(
    gaussians: Gaussians, quality: str = "screen", sides: tuple[float, ...] = CELL_SIDES
) -> PackedTile:
    """Records and indexes of one tile (see split_tiles).

    quality: "screen" or "export" (see footprint.cut); decides how far each Gaussian reaches.
    sides: of the cells to index by, source pixels, ascending; larger where Gaussians are large.
    """
    from . import footprint

    mean = _array(gaussians.mean)
    std = np.maximum(_array(gaussians.std), THINNEST)
    rho = _array(gaussians.rho)
    cut = footprint.cut(gaussians, quality).numpy().astype(np.float64)
    levels: list[Cells] = []
    for side in sides:
        if not levels or side > levels[-1].side:
            levels.append(cells.build(mean, std, rho, cut, side))
    finest = levels[0]
    rows, columns = finest.shape
    x, y = (first * finest.side for first in finest.first)
    # Relative to the means, not to the footprints: one huge Gaussian must not cost the others bits.
    low = np.floor(mean.min(axis=0)) if len(mean) else np.zeros(2)
    origin = (int(low[0]), int(low[1]))
    root = np.sqrt(1.0 - rho**2)
    records = np.empty((len(gaussians), 8), np.float32)
    records[:, 0:2] = mean - origin
    records[:, 2] = FOLD / (std[:, 0] * root)
    records[:, 3] = -FOLD * rho / (std[:, 1] * root)
    records[:, 4] = FOLD / std[:, 1]
    records[:, 5:8] = _array(gaussians.peak)
    bounds = (x, y, x + columns * finest.side, y + rows * finest.side)
    around = np.concatenate([mean.min(axis=0), mean.max(axis=0)]) if len(mean) else np.zeros(4)
    extent = tuple(around.tolist())
    return PackedTile(origin, records, tuple(levels), bounds, extent, float(std.max(initial=0.0)))


def visible(gaussians: Gaussians, view: View, quality: str) -> Gaussians:
    """Those whose footprint may reach the view (by bounding box)."""
    from . import footprint

    reach = footprint.cut(gaussians, quality).clamp(min=0).sqrt()[:, None].numpy()
    reach = reach * _array(gaussians.std)
    mean = _array(gaussians.mean)
    low, high = np.array(view.origin), np.array(view.to_source(view.size[1], view.size[0]))
    return gaussians[((mean + reach >= low) & (mean - reach <= high)).all(axis=1)]


def _array(tensor) -> np.ndarray:
    return tensor.detach().cpu().numpy().astype(np.float64)
