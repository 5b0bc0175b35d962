"""Gaussians made ready for the GPU, tile by tile: packed records and the lists of their cells.

NumPy and numba only, no OpenGL: this is the heavy part, and it can run on any thread.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from . import cells, records
from .cells import Cells
from .records import Records

if TYPE_CHECKING:
    from ..gaussians import Gaussians
    from ..view import View

SIDE = 256  # of a tile, source pixels
MOST = 1_100_000  # Gaussians in a tile: none of its buffers exceeds 128 MiB, the usual limit
CELL_SIDES = (1.0, 2.0, 4.0)  # source pixels; small cells for high zooms, large ones for low
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


def split_tiles(gaussians: Gaussians, side: int = SIDE) -> list[Gaussians]:
    """The Gaussians by the tile (side x side source pixels, at most 256) that their mean lies in.

    At most MOST to a tile, so that its buffers stay below what a driver takes. Within a tile they
    follow the pixels of the source row by row, so that the lists of a cell name near neighbours.
    """
    if len(gaussians) == 0:
        return []
    mean = _array(gaussians.mean)
    pixel = np.clip(np.floor(mean) - np.floor(mean.min(axis=0)), 0, 2**31).astype(np.int64)
    tile, inside = np.divmod(pixel, side)
    number = tile[:, 1] * (tile[:, 0].max() + 1) + tile[:, 0]
    if number.max() >= 2**16:  # far apart: count only tiles that hold something
        number = np.unique(number, return_inverse=True)[1]
    # Sorting 16 bits at a time is several times faster; the second sort keeps the first's order.
    order = np.argsort((inside[:, 1] * side + inside[:, 0]).astype(np.uint16), kind="stable")
    number = number[order]
    small = number.astype(np.uint16) if number.max() < 2**16 else number
    by_tile = np.argsort(small, kind="stable")
    order, number = order[by_tile], number[by_tile]
    parts = np.split(order, np.flatnonzero(np.diff(number)) + 1)
    return [
        gaussians[part[start : start + MOST]]
        for part in parts
        for start in range(0, len(part), MOST)
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
    std = np.maximum(_array(gaussians.std), THINNEST)
    rho = _array(gaussians.rho)
    cut = footprint.cut(gaussians, quality).numpy()
    levels = cells.build(mean, std, rho, cut, sides)
    finest = levels[0]
    rows, columns = finest.shape
    x, y = (first * finest.side for first in finest.first)
    bounds = (x, y, x + columns * finest.side, y + rows * finest.side)
    # Relative to the means, not to the footprints: one huge Gaussian must not cost the others bits.
    around = np.concatenate([mean.min(axis=0), mean.max(axis=0)]) if len(mean) else np.zeros(4)
    low = np.floor(around[:2])
    made = records.make(mean - low, std, rho, _array(gaussians.peak), packed=quality == "screen")
    origin = (int(low[0]), int(low[1]))
    extent = tuple(around.tolist())
    return PackedTile(origin, made, tuple(levels), bounds, extent, float(std.max(initial=0.0)))


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
