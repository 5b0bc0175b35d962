"""How a view is cut into blocks of pixels, one per thread of the shader, each inside one cell."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ..view import View
from .cells import CELL_SIDES

# Consecutive pixels along one axis in one cell: the first, how many, the cell, and from its edge to
# the centre of pixel count // 2, source pixels (Run in shaders/rasterize.comp)
RUN = np.dtype([("pixel", "i4"), ("count", "i4"), ("cell", "i4"), ("offset", "f4")])


# Pixels along the side of a cell below which Gaussians are not followed from pixel to pixel: where
# a cell has two, one step is too far for some that are not steep (cells.STEEP_SIDE).
THIN = 3.0


@dataclass(frozen=True)
class Shape:
    """What suits a kind of device.

    blocks: sides of a block that a thread may own, pixels, ascending; steep: of those in which
        steep Gaussians are drawn. threads: of a workgroup, along x and y.
    loading: what it costs to load a Gaussian, in evaluations at one pixel; steep_cost: what such
        an evaluation costs where it takes an exponential.
    """

    blocks: tuple[int, ...]
    steep: int
    threads: tuple[int, int]
    loading: float
    steep_cost: float


# Software runs 8 threads in step and loads for each by itself, so a thread owns as much as it
# can: measured, benchmarks/NOTES.md. A GPU has few registers per thread; for it, a guess.
SOFTWARE = Shape((4, 5, 6, 8, 10), 4, (8, 1), 42.0, 5.0)
HARDWARE = Shape((2, 3, 4), 2, (8, 8), 6.0, 4.0)


@dataclass(frozen=True)
class Load:
    """What drawing with the cells of one size takes: mean entries per cell, ordinary and steep."""

    side: float
    ordinary: float
    steep: float


def choose(loads: Iterable[Load], scale: float, shape: Shape) -> tuple[float, int]:
    """The side of the cells (source pixels) and of the blocks (pixels) that are cheapest.

    scale: output pixels per source pixel.
    """
    costs = {
        (load.side, block): _cost(load, block, scale, shape)
        for load in loads
        for block in shape.blocks
    }
    return min(costs, key=costs.get)


def _cost(load: Load, block: int, scale: float, shape: Shape) -> float:
    """Per output pixel, in evaluations at one pixel."""
    pixels = load.side * scale
    steep = (shape.loading + shape.steep_cost * shape.steep**2) * _blocks(pixels, shape.steep)
    if pixels < THIN:
        return (load.ordinary + load.steep) * steep
    ordinary = (shape.loading + block**2) * _blocks(pixels, block)
    return load.ordinary * ordinary + load.steep * steep


def _blocks(pixels: float, block: int) -> float:
    """Blocks per output pixel, where a cell is so many pixels wide, more or less."""
    if pixels <= 1:
        return 1.0
    low = math.floor(pixels)
    more = pixels - low  # share of the cells that are one pixel wider
    runs = (1 - more) * math.ceil(low / block) + more * math.ceil((low + 1) / block)
    return (runs / pixels) ** 2


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
    middle = begin + (end - begin) // 2
    made["offset"] = centre[middle] - cell[begin] * side
    return made


def side_for(view: View) -> float:
    """The side of cells that suit one view, for want of any figures of the field."""
    fine = (side for side in CELL_SIDES if side * scale_of(view) >= 4)
    return next(fine, CELL_SIDES[-1])


def scale_of(view: View) -> float:
    """Output pixels per source pixel; the geometric mean, where the axes differ."""
    return math.sqrt(view.scale[0] * view.scale[1])
