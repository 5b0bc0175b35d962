"""The index that every view reads: which Gaussians reach which cell of the source image.

Gaussians never move relative to the picture, so this is built once per tile of Gaussians.
Numba and NumPy only, no OpenGL: it can run on any thread, and releases the GIL.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..errors import FieldError
from .jit import jit
from .records import narrow

CELL_SIDES = (1.0, 2.0, 4.0)  # source pixels; small cells for high zooms, large ones for low
ENTRIES_PER_GAUSSIAN = 30  # beyond this (large Gaussians) cells grow, so memory stays bounded
CELLS_PER_GAUSSIAN = 4  # likewise for sparse Gaussians
FEW = 1 << 16  # cells or entries that are fine however few the Gaussians
SHORT = (1 << 16) - 1  # the greatest entry of 16 bits
# Standard deviations from the middle slot of a block of pixels beyond which 2^-(u^2 + v^2) leaves
# float32, so that a Gaussian cannot be followed from there: 0.5 log2(e) 12.6^2 = 114.
STEEP = 12.6
# The middle slot is at most two thirds of a cell's diagonal from a pixel that it is followed to
# (where a cell has four pixels a side; with two it would be a whole one: see blocks.THIN).
STEEP_SIDE = 1.5 / math.sqrt(2.0)


@dataclass(frozen=True)
class Cells:
    """Lists of Gaussians per square cell of a grid over the source image.

    side: of a cell, source pixels, a power of two.
    first: (x, y) of the grid's first cell: it covers [x * side, (x + 1) * side) and so on.
    shape: (rows, columns) of the grid; it covers every footprint, also outside the picture.
    lists: (3 * rows * columns + 1,) uint32; of cell i (row-major): where its ordinary Gaussians
        begin, where its steep ones do, both in pairs of entries, and its base. The next cell's
        first number is where they end.
    entries: pairs of uint16 (or uint32, where bases and these would not do): entry e > 0 of a
        cell is the Gaussian base + e - 1, ascending within a list; 0 is none, and fills a pair.
    count: entries that are not 0; steep: how many of those are in steep lists.
    longest: pairs in the longest list.
    """

    side: float
    first: tuple[int, int]
    shape: tuple[int, int]
    lists: np.ndarray
    entries: np.ndarray
    count: int
    steep: int
    longest: int

    @property
    def wide(self) -> bool:
        """Do entries have 32 bits?"""
        return self.entries.dtype == np.uint32


def build(
    mean: np.ndarray,
    std: np.ndarray,
    rho: np.ndarray,
    cut: np.ndarray,
    sides: tuple[float, ...] = (1.0,),
) -> list[Cells]:
    """One index per side (source pixels; powers of two, ascending) of the ellipses q <= cut.

    mean, std: (N, 2), source pixels; rho, cut: (N,); all float32. A Gaussian with a negative cut is
    nowhere. The test is exact (ellipse against cell, in float64). Where Gaussians are so large or
    so few that lists or grids would grow out of proportion, the finest cells are larger; at least
    one index is made.
    """
    mean, std, rho, cut = (np.ascontiguousarray(a, np.float32) for a in (mean, std, rho, cut))
    if not (cut >= 0).any():
        nothing = np.zeros(1, np.uint32), np.zeros(0, np.uint16)
        return [Cells(float(sides[0]), (0, 0), (0, 0), *nothing, 0, 0, 0)]
    spans = _finest(mean, std, rho, cut, float(sides[0]))
    steep_from = _steep_from(std, rho, cut)
    levels = [_listed(spans, steep_from)]
    for side in sides:
        if side > spans.side:
            spans = _merged(spans, round(side / spans.side))
            levels.append(_listed(spans, steep_from))
    return levels


@dataclass(frozen=True)
class _Spans:
    """Which cells each Gaussian meets: in row row[n] + j the columns [start, stop) of
    columns[begin[n] + j], for all j below begin[n + 1] - begin[n]."""

    side: float
    first: tuple[int, int]
    shape: tuple[int, int]
    row: np.ndarray
    begin: np.ndarray
    columns: np.ndarray


def _finest(mean, std, rho, cut, side: float) -> _Spans:
    """Spans of the smallest cells, `side` or larger, whose lists stay short."""
    low, high = _box(mean, std, cut)
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise FieldError("The Gaussians hold values that are not finite; predict the field anew.")
    most = max(FEW, ENTRIES_PER_GAUSSIAN * len(cut))
    row, begin = np.zeros(len(cut), np.int32), np.zeros(len(cut) + 1, np.int32)
    while True:
        first = np.floor(low / side)
        across, down = (int(count) for count in np.floor(high / side) - first + 1)
        fits = across * down <= max(FEW, CELLS_PER_GAUSSIAN * len(cut))
        if fits and _rows(mean, std, cut, side, first[1], down, most, row, begin):
            columns = np.empty((begin[-1], 2), np.uint16 if across < 2**16 else np.int32)
            if _columns(mean, std, rho, cut, side, first, across, row, begin, columns) <= most:
                corner = (int(first[0]), int(first[1]))
                return _Spans(side, corner, (down, across), row, begin, columns)
        side *= 2


def _merged(fine: _Spans, times: int) -> _Spans:
    """The spans in cells `times` as large: a large cell is met where one of its small ones is."""
    first = fine.first[0] // times, fine.first[1] // times
    shift = tuple(f - c * times for f, c in zip(fine.first, first, strict=True))
    shape = -(-(fine.shape[0] + shift[1]) // times), -(-(fine.shape[1] + shift[0]) // times)
    row, begin = np.empty_like(fine.row), np.empty_like(fine.begin)
    columns = np.empty_like(fine.columns)
    _merge(fine.row, fine.begin, fine.columns, *shift, times, row, begin, columns)
    return _Spans(fine.side * times, first, shape, row, begin, columns)


def _listed(spans: _Spans, steep_from: np.ndarray) -> Cells:
    """The lists of all cells; steep_from: the side of a cell from which each Gaussian is steep."""
    rows, across = spans.shape
    where = (spans.row, spans.begin, spans.columns, (spans.side > steep_from).astype(np.uint8))
    changes = np.zeros((rows, across + 1, 2), np.int32)
    _count(*where, changes)
    lists = np.zeros(3 * rows * across + 1, np.uint32)
    pairs, longest, ordinary, steep = _place(changes, lists)
    for kind, most in ((np.uint16, SHORT), (np.uint32, len(steep_from))):
        entries = np.zeros(2 * pairs, kind)
        done = np.zeros((rows * across, 2), np.uint32)
        if _fill(*where, across, lists, done, entries) <= most:
            break
    return Cells(
        side=spans.side,
        first=spans.first,
        shape=spans.shape,
        lists=lists,
        entries=entries,
        count=ordinary + steep,
        steep=steep,
        longest=longest,
    )


@jit
def _box(mean, std, cut):
    """The corners of the rectangle round all ellipses."""
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for n in range(cut.shape[0]):
        if cut[n] >= 0.0:
            for axis in range(2):
                reach = math.sqrt(np.float64(cut[n])) * std[n, axis]
                start, stop = mean[n, axis] - reach, mean[n, axis] + reach
                # So that a value that is no number gets into the result, and stays there
                if not (start >= low[axis] or math.isnan(low[axis])):
                    low[axis] = start
                if not (stop <= high[axis] or math.isnan(high[axis])):
                    high[axis] = stop
    return low, high


@jit
def _rows(mean, std, cut, side, first, down, most, row, begin):
    """The rows of cells that each ellipse meets; False if they are more than `most` in all."""
    total = 0
    for n in range(cut.shape[0]):
        begin[n] = total
        if cut[n] >= 0.0:
            reach = std[n, 1] * math.sqrt(np.float64(cut[n]))
            start = max(math.floor((mean[n, 1] - reach) / side) - first, 0.0)
            stop = min(math.floor((mean[n, 1] + reach) / side) - first + 1.0, float(down))
            row[n] = int(start)
            total += int(stop) - int(start)
            if total > most:
                return False
    begin[cut.shape[0]] = total
    return True


@jit
def _columns(mean, std, rho, cut, side, first, across, row, begin, columns):
    """The columns in each of those rows, and how many cells that is in all.

    With k^2 = cut, an ellipse is at height y the interval x = (rho sx / sy) y -+
    sx sqrt((1 - rho^2) (k^2 - y^2 / sy^2)), and lies farthest to the right and to the left, at
    k sx, where y = +-rho k sy. A convex shape meets exactly the cells of a row that its shadow
    on that row meets.
    """
    total = 0
    for n in range(cut.shape[0]):
        if begin[n] == begin[n + 1]:
            continue
        x, y, r = np.float64(mean[n, 0]), np.float64(mean[n, 1]), np.float64(rho[n])
        k = math.sqrt(np.float64(cut[n]))
        reach_x, reach_y = k * std[n, 0], k * std[n, 1]
        farthest = r * reach_y
        root = math.sqrt(1.0 - r * r)
        # Lines between rows, from the ellipse's top to its bottom; t = y / (k sy)
        upper, low, high = -reach_y, -r * reach_x, -r * reach_x
        for j in range(begin[n + 1] - begin[n]):
            lower = min(max((first[1] + row[n] + j + 1) * side - y, -reach_y), reach_y)
            t = lower / reach_y if reach_y > 0.0 else 1.0
            half = reach_x * root * math.sqrt(max(0.0, 1.0 - t * t))
            middle = r * reach_x * t
            left, right = min(low, middle - half), max(high, middle + half)
            if upper <= farthest <= lower:
                right = reach_x
            if upper <= -farthest <= lower:
                left = -reach_x
            start = max(math.floor((x + left) / side) - first[0], 0.0)
            stop = min(math.floor((x + right) / side) - first[0] + 1.0, float(across))
            columns[begin[n] + j, 0] = int(start)
            columns[begin[n] + j, 1] = int(stop)
            total += int(stop) - int(start)
            upper, low, high = lower, middle - half, middle + half
    return total


@jit
def _merge(row, begin, columns, shift_x, shift_y, times, new_row, new_begin, new_columns):
    used = 0
    new_begin[0] = 0
    for n in range(row.shape[0]):
        new_row[n] = (row[n] + shift_y) // times
        previous = -1
        for j in range(begin[n + 1] - begin[n]):
            here = (row[n] + j + shift_y) // times
            start = (columns[begin[n] + j, 0] + shift_x) // times
            stop = (columns[begin[n] + j, 1] - 1 + shift_x) // times + 1
            if here == previous:
                new_columns[used - 1, 0] = min(new_columns[used - 1, 0], start)
                new_columns[used - 1, 1] = max(new_columns[used - 1, 1], stop)
            else:
                new_columns[used, 0] = start
                new_columns[used, 1] = stop
                used += 1
            previous = here
        new_begin[n + 1] = used


@jit
def _steep_from(std, rho, cut):
    """The side of a cell from which the middle slot may be too far away for STEEP."""
    side = np.empty(cut.shape[0], np.float32)
    for n in range(cut.shape[0]):
        x, y, r = np.float64(std[n, 0]), np.float64(std[n, 1]), np.float64(rho[n])
        least = narrow(x, y, math.sqrt(1.0 - r * r))
        side[n] = (STEEP - math.sqrt(max(0.0, np.float64(cut[n])))) * least * STEEP_SIDE
    return side


@jit
def _count(row, begin, columns, steep, changes):
    """By how much the length of each list differs from that of the cell to its left."""
    for n in range(row.shape[0]):
        for j in range(begin[n + 1] - begin[n]):
            changes[row[n] + j, columns[begin[n] + j, 0], steep[n]] += 1
            changes[row[n] + j, columns[begin[n] + j, 1], steep[n]] -= 1


@jit
def _place(changes, lists):
    """Where each list begins; returns how many pairs there are in all and in the longest, and how
    many entries in ordinary and in steep lists."""
    pairs, longest = 0, 0
    totals = np.zeros(2, np.int64)
    lengths = np.zeros(2, np.int64)
    cell = 0
    for row in range(changes.shape[0]):
        lengths[:] = 0
        for column in range(changes.shape[1] - 1):
            for which in range(2):
                lengths[which] += changes[row, column, which]
                totals[which] += lengths[which]
                lists[3 * cell + which] = pairs
                length = (lengths[which] + 1) // 2
                pairs += length
                longest = max(longest, length)
            cell += 1
    lists[3 * cell] = pairs
    return pairs, longest, totals[0], totals[1]


@jit
def _fill(row, begin, columns, steep, across, lists, done, entries):
    """Write entries and bases; returns the greatest entry, which may not have fitted."""
    greatest = 0
    for n in range(row.shape[0]):
        which = steep[n]
        for j in range(begin[n + 1] - begin[n]):
            line = (row[n] + j) * across
            for cell in range(line + columns[begin[n] + j, 0], line + columns[begin[n] + j, 1]):
                if done[cell, 0] + done[cell, 1] == 0:
                    lists[3 * cell + 2] = n  # the first of the cell, as n ascends
                entry = n - np.int64(lists[3 * cell + 2]) + 1
                entries[2 * np.int64(lists[3 * cell + which]) + done[cell, which]] = entry
                done[cell, which] += 1
                greatest = max(greatest, entry)
    return greatest
