"""Fields of Gaussians that several benchmarks draw."""

from __future__ import annotations

import torch

from gsasr.gaussians import Gaussians


def plane(
    height: int, width: int, per_pixel: int, std: tuple[float, float] = (0.2, 0.55)
) -> Gaussians:
    """A plane of random Gaussians, evenly spread, that sum to about 0.5."""
    rng = torch.Generator().manual_seed(0)
    n = height * width * per_pixel
    spread = std[0] + (std[1] - std[0]) * torch.rand(n, 2, generator=rng)
    rho = 1.6 * torch.rand(n, generator=rng) - 0.8
    area = 2 * torch.pi * spread.prod(dim=1) * (1 - rho**2).sqrt()
    return Gaussians(
        mean=torch.rand(n, 2, generator=rng) * torch.tensor([float(width), float(height)]),
        std=spread,
        rho=rho,
        color=torch.rand(n, 3, generator=rng),
        opacity=(1 / (per_pixel * area)).clamp(max=1),
        size=(height, width),
    )
