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

ENTRIES_PER_GAUSSIAN = 48  # beyond this (large Gaussians) the cells grow, so memory stays bounded
CELLS_PER_GAUSSIAN = 4  # likewise for sparse Gaussians
FEW = 1 << 16  # cells or entries that are fine however few the Gaussians
# Standard deviations from the middle of a cell beyond which 2^-(u^2 + v^2) leaves float32, so
# that a Gaussian cannot be followed along a row by multiplication: 0.5 log2(e) 12.6^2 = 114.
STEEP = 12.6


@dataclass(frozen=True)
class Cells:
    """Lists of Gaussians per square cell of a grid over the source image (CSR).

    side: of a cell, source pixels, a power of two.
    first: (x, y) of the grid's first cell: it covers [x * side, (x + 1) * side) and so on.
    shape: (rows, columns) of the grid; it covers every footprint, also outside the picture.
    offsets: (2 * rows * columns + 1,) uint32; cell i (row-major) has two lists, its ordinary
        Gaussians entries[offsets[2i] : offsets[2i + 1]] and its steep ones
        entries[offsets[2i + 1] : offsets[2i + 2]].
    entries: (E,) uint32, Gaussian indices, ascending within a list.
    """

    side: float
    first: tuple[int, int]
    shape: tuple[int, int]
    offsets: np.ndarray
    entries: np.ndarray


def build(
    mean: np.ndarray, std: np.ndarray, rho: np.ndarray, cut: np.ndarray, side: float = 1.0
) -> Cells:
    """Cells of at least `side` source pixels; a Gaussian is listed where q <= cut meets the cell.

    mean, std: (N, 2), source pixels; rho, cut: (N,); a Gaussian with a negative cut is nowhere.
    The test is exact (ellipse against cell); the cells double in size until the lists are short.
    """
    mean, std, rho, cut = (np.ascontiguousarray(a, np.float64) for a in (mean, std, rho, cut))
    narrow = std[:, 0] * np.sqrt(1 - rho**2)  # standard deviation along a row
    drawn = cut >= 0
    if not drawn.any():
        return Cells(side, (0, 0), (0, 0), np.zeros(1, np.uint32), np.zeros(0, np.uint32))
    extent = np.sqrt(np.maximum(cut, 0))
    reach = extent[drawn, None] * std[drawn]
    low, high = (mean[drawn] - reach).min(axis=0), (mean[drawn] + reach).max(axis=0)
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise FieldError("The Gaussians hold values that are not finite; predict the field anew.")
    while True:
        first, last = np.floor(low / side), np.floor(high / side)
        columns, rows = last - first + 1
        if rows * columns <= max(FEW, CELLS_PER_GAUSSIAN * len(cut)):
            counts = np.zeros((int(rows), int(columns), 2), np.int64)
            steep = (side / (2 * narrow) + extent > STEEP).astype(np.int64)
            _count(mean, std, rho, cut, steep, side, first, counts)
            if counts.sum() <= max(FEW, ENTRIES_PER_GAUSSIAN * len(cut)):
                break
        side *= 2
    offsets = np.zeros(counts.size + 1, np.int64)
    np.cumsum(counts.ravel(), out=offsets[1:])
    entries = np.empty(offsets[-1], np.uint32)
    cursor = offsets[:-1].copy().reshape(counts.shape)
    _fill(mean, std, rho, cut, steep, side, first, cursor, entries)
    corner = (int(first[0]), int(first[1]))
    return Cells(float(side), corner, counts.shape[:2], offsets.astype(np.uint32), entries)


@jit
def _columns(mean, std, rho, cut, n, y0, y1):
    """Least and greatest x of ellipse n within y0 <= y <= y1; (1, 0) if they do not meet.

    The ellipse is x = mean + std (rho t + root e), y = mean + std t with t^2 + e^2 <= cut, and
    a convex shape meets exactly the cells of a row that its shadow on that row meets.
    """
    k = math.sqrt(cut[n])
    t0 = max((y0 - mean[n, 1]) / std[n, 1], -k)
    t1 = min((y1 - mean[n, 1]) / std[n, 1], k)
    if t0 > t1:
        return 1.0, 0.0
    root = math.sqrt(1.0 - rho[n] * rho[n])
    right = min(max(rho[n] * k, t0), t1)
    left = min(max(-rho[n] * k, t0), t1)
    x0 = rho[n] * left - root * math.sqrt(max(0.0, cut[n] - left * left))
    x1 = rho[n] * right + root * math.sqrt(max(0.0, cut[n] - right * right))
    return mean[n, 0] + std[n, 0] * x0, mean[n, 0] + std[n, 0] * x1


@jit
def _span(low, high, side, first, count):
    """First and one past the last cell that [low, high] touches."""
    start = np.floor(low / side) - first
    stop = np.floor(high / side) - first + 1.0
    return int(max(start, 0.0)), int(min(stop, float(count)))


@jit
def _count(mean, std, rho, cut, steep, side, first, counts):
    for n in range(cut.shape[0]):
        if not cut[n] >= 0.0:
            continue
        reach = std[n, 1] * math.sqrt(cut[n])
        row0, row1 = _span(mean[n, 1] - reach, mean[n, 1] + reach, side, first[1], counts.shape[0])
        for row in range(row0, row1):
            y = (first[1] + row) * side
            low, high = _columns(mean, std, rho, cut, n, y, y + side)
            if low > high:
                continue
            column0, column1 = _span(low, high, side, first[0], counts.shape[1])
            for column in range(column0, column1):
                counts[row, column, steep[n]] += 1


@jit
def _fill(mean, std, rho, cut, steep, side, first, cursor, entries):
    for n in range(cut.shape[0]):
        if not cut[n] >= 0.0:
            continue
        reach = std[n, 1] * math.sqrt(cut[n])
        row0, row1 = _span(mean[n, 1] - reach, mean[n, 1] + reach, side, first[1], cursor.shape[0])
        for row in range(row0, row1):
            y = (first[1] + row) * side
            low, high = _columns(mean, std, rho, cut, n, y, y + side)
            if low > high:
                continue
            column0, column1 = _span(low, high, side, first[0], cursor.shape[1])
            for column in range(column0, column1):
                entries[cursor[row, column, steep[n]]] = n
                cursor[row, column, steep[n]] += 1
