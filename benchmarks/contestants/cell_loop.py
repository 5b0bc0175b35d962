"""The plain way with an index: a pixel loops over the list of its cell of one source pixel."""

from __future__ import annotations

import math
import time

import moderngl
import numba
import numpy as np

from gsasr.gaussians import Gaussians
from gsasr.rasterize import gl
from gsasr.view import View

from .contestant import FOLD, GlContestant, drawn, shader, visits, whole_and_rest

GROUP = 8  # threads along each side of a workgroup


class CellLoop(GlContestant):
    """Draws all of a source from one set of buffers, or several bands where a driver has limits."""

    name = "cell loop"
    dtype = "f2"  # each pixel is written once, so half precision does

    def __init__(self, ctx: moderngl.Context, field: Gaussians) -> None:
        super().__init__(ctx)
        defines = {"GROUP": GROUP, "TARGET": gl.TARGETS[self.dtype]}
        self._program = ctx.compute_shader(shader(ctx, "cell_loop.comp", defines))
        most = ctx.info["GL_MAX_SHADER_STORAGE_BLOCK_SIZE"]
        banded(*drawn(field[:1]), most)  # compiles
        start = time.perf_counter()
        bands = banded(*drawn(field), most)
        self.seconds = {1: time.perf_counter() - start}
        self.gaussians = sum(records.nbytes for records, *_ in bands)
        self.index = sum(offsets.nbytes + entries.nbytes for *_, offsets, entries in bands)
        self._bands = [
            (first, np.diff(offsets).reshape(shape), [ctx.buffer(a) for a in arrays])
            for records, first, shape, offsets, entries in bands
            for arrays in [(records, offsets, entries)]
        ]

    def draw(self, view: View) -> None:
        target = self.target(view)
        framebuffer = self.ctx.framebuffer([target])
        framebuffer.clear(alpha=1.0)
        framebuffer.release()
        target.bind_to_image(0, read=True, write=True)
        base, rest = whole_and_rest(view.origin)
        for first, lengths, buffers in self._bands:
            rows, columns = lengths.shape
            corners = np.array([first, (first[0] + columns, first[1] + rows)], np.float64)
            at = (corners - view.origin) * view.scale
            low = np.clip(np.floor(at[0]), 0, view.size[::-1]).astype(int)
            high = np.clip(np.ceil(at[1]), 0, view.size[::-1]).astype(int)
            if (low >= high).any():
                continue
            values = {
                "corner": tuple(low.tolist()),
                "base": base,
                "fraction": rest,
                "pixel": (1 / view.scale[0], 1 / view.scale[1]),
                "first": first,
                "shape": (columns, rows),
            }
            for name, value in values.items():
                self._program[name] = value
            for binding, buffer in enumerate(buffers):
                buffer.bind_to_storage_buffer(binding)
            groups = -(-(high - low) // GROUP)
            self._program.run(int(groups[0]), int(groups[1]))
            self.ctx.memory_barrier()

    def evaluations(self, view: View) -> int:
        return sum(visits(lengths, first, 1.0, view) for first, lengths, _ in self._bands)

    def release(self) -> None:
        super().release()
        self._program.release()
        for *_, buffers in self._bands:
            for buffer in buffers:
                buffer.release()


def banded(records: np.ndarray, cut: np.ndarray, most: int) -> list[tuple]:
    """Bands of the Gaussians, each with the lists of its cells, in buffers of at most `most` bytes.

    Per band: records (N, 8), the first cell (x, y), the shape of the grid (rows, columns),
    offsets (rows * columns + 1,) uint32 into entries (E,) uint32.
    """
    ellipses = _ellipses(records, cut)
    counts = _counts(*ellipses)
    listed = np.concatenate([[0], np.cumsum(counts)])
    bands, start = [], 0
    while start < len(records):
        fits = int(np.searchsorted(listed, listed[start] + most // 4, "right")) - 1
        stop = min(len(records), start + most // records[0].nbytes, max(fits, start + 1))
        own = tuple(a[start:stop] for a in ellipses)
        low = np.floor(own[0] - own[1]).min(axis=0)
        high = np.floor(own[0] + own[1]).max(axis=0)
        columns, rows = (high - low + 1).astype(int).tolist()
        offsets, entries = _lists(*own, low, rows, columns, int(counts[start:stop].sum()))
        first = int(low[0]), int(low[1])
        bands.append((records[start:stop], first, (rows, columns), offsets, entries))
        start = stop
    return bands


def _ellipses(records: np.ndarray, cut: np.ndarray) -> tuple[np.ndarray, ...]:
    """Mean, reach (N, 2) along the axes, and rho (N,) of the ellipses q <= cut, float64."""
    mean, (a, b, c) = records[:, :2].astype(np.float64), records[:, 2:5].T.astype(np.float64)
    # x = (u - b y) / a and y = v / c on the circle u^2 + v^2 = FOLD^2 cut
    radius = FOLD * np.sqrt(cut)
    reach = np.stack([radius * np.hypot(1, b / c) / a, radius / c], axis=1)
    return mean, reach, -b / np.hypot(b, c)


@numba.njit
def _columns(mean, reach, rho, n, y):
    """First and last cell of a row of cells, from y to y + 1, that ellipse n meets."""
    # The ellipse is x = mean + reach (rho t + root e), y = mean + reach t with t^2 + e^2 <= 1.
    low = max((y - mean[n, 1]) / reach[n, 1], -1.0)
    high = min((y + 1.0 - mean[n, 1]) / reach[n, 1], 1.0)
    if low > high:
        return 1, 0
    root = math.sqrt(1.0 - rho[n] * rho[n])
    left = min(max(-rho[n], low), high)
    right = min(max(rho[n], low), high)
    x0 = rho[n] * left - root * math.sqrt(1.0 - left * left)
    x1 = rho[n] * right + root * math.sqrt(1.0 - right * right)
    x0, x1 = mean[n, 0] + reach[n, 0] * x0, mean[n, 0] + reach[n, 0] * x1
    return int(np.floor(x0)), int(np.floor(x1))


@numba.njit
def _counts(mean, reach, rho):
    counts = np.zeros(len(rho), np.int64)
    for n in range(len(rho)):
        top, bottom = np.floor(mean[n, 1] - reach[n, 1]), np.floor(mean[n, 1] + reach[n, 1])
        for y in range(int(top), int(bottom) + 1):
            x0, x1 = _columns(mean, reach, rho, n, y)
            counts[n] += max(0, x1 - x0 + 1)
    return counts


@numba.njit
def _lists(mean, reach, rho, first, rows, columns, total):
    offsets = np.zeros(rows * columns + 1, np.uint32)
    entries = np.empty(total, np.uint32)
    for fill in range(2):  # count, then fill from the back
        for i in range(len(rho)):
            n = len(rho) - 1 - i
            top, bottom = np.floor(mean[n, 1] - reach[n, 1]), np.floor(mean[n, 1] + reach[n, 1])
            for y in range(int(top), int(bottom) + 1):
                x0, x1 = _columns(mean, reach, rho, n, y)
                for x in range(x0, x1 + 1):
                    column = min(max(x - int(first[0]), 0), columns - 1)
                    cell = (y - int(first[1])) * columns + column
                    if fill == 0:
                        offsets[cell] += 1
                    else:
                        offsets[cell] -= 1
                        entries[offsets[cell]] = n
        if fill == 0:
            offsets[:] = np.cumsum(offsets)
    return offsets, entries
