"""Gaussians in 24 bytes each instead of 36, for keeping many: closer than any export asks for.

Each value is coded on the scale on which its errors weigh the same everywhere: standard deviations
by their logarithm, the correlation by atanh (near 1, where the ellipse is thin, it takes ever finer
steps), opacity by its root, so that many faint Gaussians add up as exactly as a few strong ones.
Means stay float32. What lies outside of these scales is kept as it is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch

from .gaussians import Gaussians
from .rasterize.jit import jit

STEP = 1e-5  # between two codes of ln(std) and of atanh(rho)
BITS = 21  # of each of these codes, three of which make one number
SHAPE_LAST = (1 << BITS) - 1
MASK, SECOND, THIRD = np.uint64(SHAPE_LAST), np.uint64(BITS), np.uint64(2 * BITS)
THINNEST = math.log(1e-6)  # of the coded standard deviations, ln(source pixels); up to 1280 pixels
ROUND = 1 << BITS - 1  # the code of rho = 0; |atanh(rho)| up to 10.4 leaves out only 1 itself
PAINT_LAST = 65535  # of colour and opacity


@dataclass(frozen=True)
class CodedGaussians:
    """N Gaussians, coded; `decode` gives them back.

    mean: (N, 2) float32, as in Gaussians.
    shape: (N,) uint64: the codes of std x, std y and rho, lowest bits first.
    paint: (N, 4) uint16: red, green, blue, opacity.
    exceptions: (E,) int64, the indices of those that the codes cannot hold.
    plain: (E, 7) float32, their std, rho, colour and opacity.
    like: no Gaussians; of what picture and by which network they are.
    """

    mean: np.ndarray
    shape: np.ndarray
    paint: np.ndarray
    exceptions: np.ndarray
    plain: np.ndarray
    like: Gaussians

    def __len__(self) -> int:
        return len(self.mean)

    @property
    def nbytes(self) -> int:
        """Main memory it takes."""
        arrays = (self.mean, self.shape, self.paint, self.exceptions, self.plain)
        return sum(array.nbytes for array in arrays)

    def decode(self) -> Gaussians:
        """The Gaussians, on the CPU."""
        values = np.empty((len(self), 7), np.float32)
        _decode(self.shape, self.paint, values)
        values[self.exceptions] = self.plain
        std, rho, color, opacity = _columns(torch.from_numpy(values))
        mean = torch.from_numpy(self.mean.copy())
        return replace(self.like, mean=mean, std=std, rho=rho, color=color, opacity=opacity)


def encode(gaussians: Gaussians) -> CodedGaussians:
    """Gaussians on any device, coded."""
    at_hand = gaussians.map(lambda tensor: tensor.detach().to("cpu", torch.float32))
    values = np.empty((len(gaussians), 7), np.float32)
    given = (at_hand.std, at_hand.rho, at_hand.color, at_hand.opacity)
    for columns, tensor in zip(_columns(torch.from_numpy(values)), given, strict=True):
        columns.copy_(tensor)
    shape = np.empty(len(gaussians), np.uint64)
    paint = np.empty((len(gaussians), 4), np.uint16)
    held = np.empty(len(gaussians), np.bool_)
    _encode(values, shape, paint, held)
    exceptions = np.flatnonzero(~held)
    mean = at_hand.mean.numpy().copy()  # not a view that would keep all the rest alive
    like = at_hand[:0].map(torch.clone)
    return CodedGaussians(mean, shape, paint, exceptions, values[exceptions], like)


def _columns(values: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """std, rho, color and opacity as views of (N, 7)."""
    return values[:, 0:2], values[:, 2], values[:, 3:6], values[:, 6]


@jit
def _encode(values, shape, paint, held):
    """Codes of each row, and whether they can hold it; what is not a number cannot be held."""
    for n in range(values.shape[0]):
        std_x, std_y, rho = values[n, 0], values[n, 1], values[n, 2]
        fits = std_x > 0.0 and std_y > 0.0 and abs(rho) < 1.0
        if fits:
            x = np.rint((math.log(std_x) - THINNEST) / STEP)
            y = np.rint((math.log(std_y) - THINNEST) / STEP)
            turn = np.rint(0.5 * math.log((1.0 + rho) / (1.0 - rho)) / STEP) + ROUND
            low, high = min(x, y, turn), max(x, y, turn)
            fits = low >= 0.0 and high <= SHAPE_LAST
        if fits:
            shape[n] = np.uint64(x) | np.uint64(y) << SECOND | np.uint64(turn) << THIRD
        else:
            shape[n] = 0
        for k in range(4):
            value = values[n, 3 + k]
            inside = 0.0 <= value <= 1.0
            if not inside:
                value = np.float32(0.0)
            elif k == 3:
                value = math.sqrt(value)
            paint[n, k] = np.uint16(value * PAINT_LAST + 0.5)
            fits = fits and inside
        held[n] = fits


@jit
def _decode(shape, paint, values):
    for n in range(shape.shape[0]):
        x, y, turn = shape[n], shape[n] >> SECOND, shape[n] >> THIRD
        values[n, 0] = math.exp(THINNEST + STEP * np.float64(x & MASK))
        values[n, 1] = math.exp(THINNEST + STEP * np.float64(y & MASK))
        ratio = math.exp(2.0 * STEP * (np.float64(turn & MASK) - ROUND))  # (1 + rho) / (1 - rho)
        values[n, 2] = (ratio - 1.0) / (ratio + 1.0)
        values[n, 3] = paint[n, 0] / PAINT_LAST
        values[n, 4] = paint[n, 1] / PAINT_LAST
        values[n, 5] = paint[n, 2] / PAINT_LAST
        root = paint[n, 3] / PAINT_LAST
        values[n, 6] = root * root
