"""Gaussians as the shaders read them, one record each (shaders/records.glsl).

Full records are float32 throughout, for export. Packed ones take half the memory, and half the
time of loading; what they lose cannot be seen: for the screen, wherever their range suffices.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .jit import jit

FOLD = math.sqrt(0.5 * math.log2(math.e))  # exp(-q/2) = 2^-(FOLD^2 q)
STEPS = (1 << 20) - 1  # of a packed mean across a tile
FEWEST_STEPS = 100.0  # of a packed mean per standard deviation: 0.3 % of a peak
FLATTEST = 0.2  # least sqrt(1 - rho^2) that half floats do justice to, where terms cancel
WIDEST = 4096.0  # standard deviation that half floats hold with all their digits, source pixels


@dataclass(frozen=True)
class Records:
    """All Gaussians of a tile; record 0 is of none, and fills up lists (see cells.py).

    data: (N + 1, 4) uint32 if packed, else (N + 1, 8) float32: mean x and y relative to the
        tile, the whitening a, b, c of shaders/gaussian.glsl, and the peak red, green, blue.
        Packed: 20 bits each of x and y, above them 12 bits of red and blue; a, b and c as half
        floats, and 16 bits of green.
    unpacking: source pixels per step of a packed mean, and colour per step of 12 and 16 bits.
    """

    data: np.ndarray
    unpacking: tuple[float, float, float] | None

    @property
    def packed(self) -> bool:
        """Are these the short ones?"""
        return self.unpacking is not None


def make(
    mean: np.ndarray,
    std: np.ndarray,
    rho: np.ndarray,
    peak: np.ndarray,
    origin: tuple[int, int],
    packed: bool,
) -> Records:
    """Records of Gaussians; mean, std (N, 2), rho (N,), peak (N, 3) float32; origin: of the tile.

    packed: use the short ones if they hold all of these.
    """
    full = np.zeros((len(rho) + 1, 8), np.float32)
    narrowest, flattest, widest, brightest, farthest = _full(
        mean, std, rho, peak, *map(float, origin), full
    )
    unpacking = unpacking_of(narrowest, flattest, widest, brightest, farthest)
    if not (packed and unpacking and len(rho)):
        return Records(full, None)
    short = np.empty((len(full), 4), np.uint32)
    _pack(full, full[:, 2:5].astype(np.float16).view(np.uint16), unpacking[0], brightest, short)
    return Records(short, unpacking)


def unpacking_of(
    narrowest: float, flattest: float, widest: float, brightest: float, farthest: float
) -> tuple[float, float, float] | None:
    """Records.unpacking where short records hold such Gaussians, else None.

    narrowest, flattest: least semi-axis and sqrt(1 - rho^2); widest: standard deviation;
    brightest: of the peaks; farthest: of the means from the tile's origin along an axis.
    """
    step = farthest / STEPS
    shaped = FEWEST_STEPS * step <= narrowest and flattest >= FLATTEST and widest <= WIDEST
    if shaped and math.isfinite(brightest):
        return step, brightest / 4095.0, brightest / 65535.0
    return None


@jit
def _full(mean, std, rho, peak, x0, y0, out):
    """Fill all but record 0; returns what unpacking_of asks for."""
    narrowest, flattest, widest, brightest, farthest = np.inf, 1.0, 0.0, 1e-9, 1e-9
    for n in range(rho.shape[0]):
        x, y, r = np.float64(std[n, 0]), np.float64(std[n, 1]), np.float64(rho[n])
        root = math.sqrt(1.0 - r * r)
        record = out[n + 1]
        record[0] = mean[n, 0] - x0
        record[1] = mean[n, 1] - y0
        record[2] = FOLD / (x * root)
        record[3] = -FOLD * r / (y * root)
        record[4] = FOLD / y
        for channel in range(3):
            record[5 + channel] = peak[n, channel]
            brightest = max(brightest, peak[n, channel])
        widest = max(widest, max(x, y))
        narrowest, flattest = min(narrowest, narrow(x, y, root)), min(flattest, root)
        farthest = max(farthest, max(record[0], record[1]))
    return narrowest, flattest, widest, brightest, farthest


@jit
def narrow(x, y, root):
    """The smaller semi-axis of the ellipse q = 1, source pixels; root: sqrt(1 - rho^2)."""
    # Of the covariance's eigenvalues, by their product and sum
    determinant = (x * y * root) ** 2
    half = 0.5 * (x * x + y * y)
    return math.sqrt(determinant / (half + math.sqrt(max(0.0, half * half - determinant))))


@jit
def _pack(full, halves, step, brightest, out):
    for n in range(full.shape[0]):
        record = full[n]
        x, y = np.uint32(record[0] / step + 0.5), np.uint32(record[1] / step + 0.5)
        red = np.uint32(record[5] / brightest * 4095.0 + 0.5)
        green = np.uint32(record[6] / brightest * 65535.0 + 0.5)
        blue = np.uint32(record[7] / brightest * 4095.0 + 0.5)
        out[n, 0] = x | (red << 20)
        out[n, 1] = y | (blue << 20)
        out[n, 2] = halves[n, 0] | (np.uint32(halves[n, 1]) << 16)
        out[n, 3] = halves[n, 2] | (green << 16)
