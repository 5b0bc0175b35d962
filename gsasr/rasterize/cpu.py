"""Rasterizer for the CPU: numba, forward by bands of rows, backward by runs of Gaussians.

Each output value is written by one thread in the order of the Gaussians, so results are equal
to the bit whatever the number of threads. Along a row a Gaussian is a 1D Gaussian, and those
follow a two-multiplication recurrence: g(x+1) = g(x) r(x), r(x+1) = r(x) exp(-1/s^2).
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from .batch import Picture
from .jit import in_threads, jit, parts

CROWDED = 256  # Gaussians per pixel from which rounding each sum to float32 would add up


def forward(
    mean: Tensor, std: Tensor, rho: Tensor, peak: Tensor, cut: Tensor, batch: list[Picture]
) -> Tensor:
    """(P, 3) pixels of all pictures; arguments as of `operator.rasterize`, on the CPU."""
    arrays = _arrays(mean, std, rho, peak, cut)
    count = batch[-1].pixels.stop if batch else 0
    crowded = len(mean) > CROWDED * count  # a minified view; elsewhere float32 is a tenth faster
    pixels = np.zeros((count, 3), np.float64 if crowded else np.float32)
    calls = []
    for picture in batch:
        own = [array[picture.gaussians] for array in arrays]
        image = pixels[picture.pixels].reshape(*picture.view.size, 3)
        bands = parts(picture.view.size[0], image.size * 8 < 1 << 18)
        calls += [(*own, *_geometry(picture), image, start, stop) for start, stop in bands]
    in_threads(_forward, calls)
    return torch.from_numpy(pixels.astype(np.float32, copy=False))


def backward(
    upstream: Tensor,
    mean: Tensor,
    std: Tensor,
    rho: Tensor,
    peak: Tensor,
    cut: Tensor,
    batch: list[Picture],
) -> Tensor:
    """(N, 8) gradients of mean 2, std 2, rho, peak 3; arguments as of `forward`."""
    arrays = _arrays(mean, std, rho, peak, cut)
    (gradient,) = _arrays(upstream)
    grads = np.zeros((len(arrays[0]), 8), np.float32)
    calls = []
    for picture in batch:
        own = [array[picture.gaussians] for array in arrays]
        image = gradient[picture.pixels].reshape(*picture.view.size, 3)
        out = grads[picture.gaussians]
        runs = parts(len(out), len(out) < 4096)
        calls += [(*own, *_geometry(picture), image, out, start, stop) for start, stop in runs]
    in_threads(_backward, calls)
    return torch.from_numpy(grads)


@jit
def _span(center, half, limit):
    """First and one past the last pixel index with |index - center| <= half, in [0, limit)."""
    first = max(0.0, np.ceil(center - half))
    last = min(limit - 1.0, np.floor(center + half))
    if first > last:
        return 0, 0
    return int(first), int(last) + 1


@jit
def _drawable(center_x, center_y, std_x, std_y, correlation):
    """Whether a Gaussian is an ellipse at a place: no NaN, nothing infinite, no width of 0."""
    widths = std_x * std_y * (1.0 - correlation * correlation)
    return 0.0 < widths < np.inf and np.isfinite(center_x + center_y)


@jit
def _forward(mean, std, rho, peak, cut, ox, oy, sx, sy, image, row_start, row_stop):
    """Add the Gaussians to image rows [row_start, row_stop)."""
    width = image.shape[1]
    for n in range(mean.shape[0]):
        if not cut[n] >= 0.0:
            continue
        std_x, std_y = std[n, 0] * float(sx), std[n, 1] * float(sy)  # output pixels
        center_x, center_y = (mean[n, 0] - ox) * sx - 0.5, (mean[n, 1] - oy) * sy - 0.5
        correlation = float(rho[n])
        if not _drawable(center_x, center_y, std_x, std_y, correlation):
            continue
        y0, y1 = _span(center_y, std_y * math.sqrt(cut[n]), row_stop)
        y0 = max(y0, row_start)
        if y0 >= y1:
            continue
        narrow = std_x * math.sqrt(1.0 - correlation * correlation)  # std along a row
        falloff = math.exp(-1.0 / (narrow * narrow))
        red, green, blue = peak[n, 0], peak[n, 1], peak[n, 2]
        for y in range(y0, y1):
            t = (y - center_y) / std_y
            remaining = cut[n] - t * t
            if remaining < 0.0:
                continue
            row_center = center_x + correlation * std_x * t
            x0, x1 = _span(row_center, narrow * math.sqrt(remaining), width)
            if x0 >= x1:
                continue
            e = (x0 - row_center) / narrow
            weight = math.exp(-0.5 * (t * t + e * e))
            ratio = 1.0
            if x1 - x0 > 1:
                ratio = math.exp(-(e + 0.5 / narrow) / narrow)
            for x in range(x0, x1):
                w = np.float32(weight)
                image[y, x, 0] += w * red
                image[y, x, 1] += w * green
                image[y, x, 2] += w * blue
                weight *= ratio
                ratio *= falloff


@jit
def _backward(mean, std, rho, peak, cut, ox, oy, sx, sy, upstream, grads, start, stop):
    """Gradients of Gaussians [start, stop): sum over their pixels, then the chain rule.

    With t = dy/std_y and e = (dx/std_x - rho t) / sqrt(1 - rho^2), q = t^2 + e^2; every
    derivative of q is linear in e, t, e^2, e t, t^2, so five weighted sums hold all there is.
    """
    height, width = upstream.shape[:2]
    for n in range(start, stop):
        if not cut[n] >= 0.0:
            continue
        std_x, std_y = std[n, 0] * float(sx), std[n, 1] * float(sy)
        center_x, center_y = (mean[n, 0] - ox) * sx - 0.5, (mean[n, 1] - oy) * sy - 0.5
        correlation = float(rho[n])
        if not _drawable(center_x, center_y, std_x, std_y, correlation):
            continue
        y0, y1 = _span(center_y, std_y * math.sqrt(cut[n]), height)
        if y0 >= y1:
            continue
        root = math.sqrt(1.0 - correlation * correlation)
        narrow = std_x * root
        falloff = math.exp(-1.0 / (narrow * narrow))
        red, green, blue = float(peak[n, 0]), float(peak[n, 1]), float(peak[n, 2])
        sum_red = sum_green = sum_blue = 0.0
        sum_e = sum_t = sum_ee = sum_et = sum_tt = 0.0
        for y in range(y0, y1):
            t = (y - center_y) / std_y
            remaining = cut[n] - t * t
            if remaining < 0.0:
                continue
            row_center = center_x + correlation * std_x * t
            x0, x1 = _span(row_center, narrow * math.sqrt(remaining), width)
            if x0 >= x1:
                continue
            e = (x0 - row_center) / narrow
            weight = math.exp(-0.5 * (t * t + e * e))
            ratio = 1.0
            if x1 - x0 > 1:
                ratio = math.exp(-(e + 0.5 / narrow) / narrow)
            row_sum = row_e = row_ee = 0.0
            for x in range(x0, x1):
                e = (x - row_center) / narrow
                r, g, b = upstream[y, x, 0], upstream[y, x, 1], upstream[y, x, 2]
                sum_red += weight * r
                sum_green += weight * g
                sum_blue += weight * b
                h = weight * (red * r + green * g + blue * b)
                row_sum += h
                row_e += h * e
                row_ee += h * e * e
                weight *= ratio
                ratio *= falloff
            sum_e += row_e
            sum_ee += row_ee
            sum_t += row_sum * t
            sum_tt += row_sum * t * t
            sum_et += row_e * t
        tilt = correlation / root
        grads[n, 0] = sx * sum_e / narrow
        grads[n, 1] = sy * (sum_t - tilt * sum_e) / std_y
        grads[n, 2] = sx * (sum_ee + tilt * sum_et) / std_x
        grads[n, 3] = sy * (sum_tt - tilt * sum_et) / std_y
        grads[n, 4] = (sum_et - tilt * sum_ee) / root
        grads[n, 5] = sum_red
        grads[n, 6] = sum_green
        grads[n, 7] = sum_blue


def _arrays(*tensors: Tensor) -> list[np.ndarray]:
    return [tensor.detach().contiguous().numpy() for tensor in tensors]


def _geometry(picture: Picture) -> tuple[float, float, float, float]:
    return (*picture.view.origin, *picture.view.scale)
