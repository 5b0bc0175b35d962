"""Pixels as areas: the Gaussians that a view's pixels integrate.

A pixel that is a Gaussian footprint, not a point, sees each Gaussian convolved with itself, and
that is a Gaussian again. So antialiasing changes what is drawn, and nothing about drawing.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from ..gaussians import Gaussians
from ..view import View

# Variance of a pixel, in squared pixels of the output: about that of the Gaussian whose pictures
# come nearest to the mean over a square pixel (tests/test_antialias.py).
FOOTPRINT = 0.1


def integrated(gaussians: Gaussians, view: View) -> Gaussians:
    """The Gaussians that a sample of `view` must see to be the integral over its pixel.

    Means and colours stay; the covariance S grows by the footprint's to S', and the opacity
    falls by sqrt(|S| / |S'|), so that each Gaussian keeps its integral. Computed in float64,
    returned in the type given; differentiable.
    """
    std, rho = gaussians.std.double(), gaussians.rho.double()
    pixel = torch.tensor(view.scale, dtype=torch.float64, device=std.device).reciprocal()
    added = FOOTPRINT * pixel**2  # [2] variances along x and y, source pixels
    variance = std**2
    wide = variance + added  # [N, 2]
    # Sums of what is positive: no difference that could cancel near |rho| = 1.
    before = variance.prod(dim=1) * ((1 - rho) * (1 + rho))
    after = before + (variance * added.flip(0)).sum(dim=1) + added.prod()
    wide_std = wide.sqrt()
    dtype = gaussians.std.dtype
    return replace(
        gaussians,
        std=wide_std.to(dtype),
        rho=(rho * (std / wide_std).prod(dim=1)).to(dtype),
        opacity=(gaussians.opacity.double() * (before / after).sqrt()).to(dtype),
    )
