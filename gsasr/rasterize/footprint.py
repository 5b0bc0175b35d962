"""Where a Gaussian is worth drawing: the ellipse q(x) <= cut outside which it is dropped.

Dropping costs accuracy, so the cut is chosen per Gaussian such that everything dropped at a
pixel adds up to less than the tolerance of the quality asked for:

- "screen": below half an 8-bit step (1/510), with a margin of nearly three;
- "export": below 1e-4, with a margin of two;
- "gradient": a fixed cut in standard deviations, whatever the opacity, so that a faint Gaussian
  still receives its gradient.

For a covered plane the mass that a cut at amplitude t drops is, per Gaussian,
t * 2 pi sx sy sqrt(1 - rho^2): the same t for all minimises the drawn area for a given loss.
"""

from __future__ import annotations

import math

import torch

from ..gaussians import Gaussians

TOLERANCE = {"screen": 7e-4, "export": 5e-5}
GRADIENT_CUT = 5.0**2  # tails of second moments: (1 + k^2/2) exp(-k^2/2) = 5e-5


def cut(gaussians: Gaussians, quality: str) -> torch.Tensor:
    """(N,) float32: draw where q(x) <= cut; a negative value means nowhere. Same device.

    quality: "screen", "export" or "gradient".
    """
    if quality == "gradient":
        return torch.full_like(gaussians.opacity, GRADIENT_CUT, requires_grad=False)
    with torch.no_grad():
        peak = (gaussians.opacity * gaussians.color.amax(dim=1)).double()
        threshold = math.log(TOLERANCE[quality] / max(1.0, _densest(gaussians)))
        return (2.0 * (peak.log() - threshold)).clamp(min=-1.0).float()


def _densest(gaussians: Gaussians) -> float:
    """Largest sum, over one source pixel, of Gaussian areas 2 pi sx sy sqrt(1 - rho^2).

    It bounds how many Gaussians, each just below the threshold, add up at one place. Each counts
    as at least one pixel, since small ones may sit on top of each other.
    """
    if len(gaussians) == 0:
        return 0.0
    column, row = gaussians.mean.detach().floor().clamp(-(2.0**30), 2.0**30).long().unbind(dim=1)
    std = gaussians.std.double()
    area = 2 * math.pi * std.prod(dim=1) * (1 - gaussians.rho.double() ** 2).clamp(min=0).sqrt()
    # Only the pixels around these Gaussians, which may be a small tile of a large picture.
    column, row = column - column.min(), row - row.min()
    across = int(column.max()) + 1
    pixel = row * across + column
    if across * (int(row.max()) + 1) > 16 * len(gaussians) + 4096:
        pixel = pixel.unique(return_inverse=True)[1]
    # In integers, so that the sum is the same in any order, and so on any device in any run.
    fixed = (area.clamp(1, 2**40) * 256).ceil().long()
    load = fixed.new_zeros(int(pixel.max()) + 1).scatter_add_(0, pixel, fixed)
    return float(load.max()) / 256


def bounds(gaussians: Gaussians, quality: str) -> tuple[float, float, float, float]:
    """(x0, y0, x1, y1) in source pixels around every footprint; empty (0, 0, 0, 0) if none."""
    limit = cut(gaussians, quality)
    drawn = limit >= 0
    if not bool(drawn.any()):
        return 0.0, 0.0, 0.0, 0.0
    mean, reach = gaussians.mean[drawn], gaussians.std[drawn] * limit[drawn].sqrt()[:, None]
    low, high = (mean - reach).amin(dim=0), (mean + reach).amax(dim=0)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])
