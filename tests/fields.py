"""Fields of Gaussians that several tests draw."""

import torch

from gsasr.gaussians import Gaussians


def random_field(
    count: int, size: tuple[int, int], largest_std: float = 0.8, seed: int = 0
) -> Gaussians:
    """Gaussians all over a picture and a little beyond, of every shape, whose sum is near 1."""
    random = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=random)

    height, width = size
    return Gaussians(
        mean=uniform(count, 2) * torch.tensor([width + 2.0, height + 2.0]) - 1,
        std=uniform(count, 2) * largest_std + 1e-3,
        rho=uniform(count) * 1.9 - 0.95,
        color=uniform(count, 3),
        opacity=uniform(count) * min(1.0, 3.0 * height * width / max(1, count)),
        size=size,
    )


def one(mean, std, rho=0.0, color=(1.0, 1.0, 1.0), opacity=1.0, size=(1, 1)) -> Gaussians:
    """A single Gaussian."""
    return Gaussians(
        mean=torch.tensor([mean], dtype=torch.float32),
        std=torch.tensor([std], dtype=torch.float32),
        rho=torch.tensor([rho], dtype=torch.float32),
        color=torch.tensor([color], dtype=torch.float32),
        opacity=torch.tensor([opacity], dtype=torch.float32),
        size=size,
    )


# What a rasterizer may stumble over, each around a picture of one pixel.
EXTREMES = {
    "point": one((0.5, 0.5), (1e-6, 1e-6)),
    "line": one((0.3, 0.7), (1e-6, 0.5)),
    "ridge": one((0.5, 0.5), (0.5, 0.3), rho=0.999999),
    "other ridge": one((0.5, 0.5), (0.3, 0.5), rho=-0.999999),
    "outside": one((-50.0, 80.0), (0.8, 0.8)),
    "huge": one((0.5, 0.5), (40.0, 40.0)),
    "far": one((-1e12, 0.5), (1e12, 1e12)),
    "invisible": one((0.5, 0.5), (0.5, 0.5), opacity=0.0),
    "none": random_field(0, (1, 1)),
}
