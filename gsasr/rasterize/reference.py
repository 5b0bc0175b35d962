"""The oracle: every Gaussian at every pixel, dense, differentiable, in float64 by default."""

from __future__ import annotations

import torch

from ..gaussians import Gaussians
from ..view import View

CHUNK = 1 << 24  # Gaussian evaluations held at once when no gradient is wanted


def render(
    gaussians: Gaussians,
    view: View,
    box: tuple[float, float] | None = None,
    dtype: torch.dtype = torch.float64,
) -> torch.Tensor:
    """(h, w, 3) image, not clamped: sum opacity * color * exp(-q / 2), no cut-off.

    box: half-width and half-height in output pixels beyond which a Gaussian is dropped, only
        for comparison with the paper's rasterization ratio.
    """
    g = gaussians.map(lambda tensor: tensor.to(dtype))
    height, width = view.size
    columns = torch.arange(width, dtype=dtype, device=g.mean.device)
    x = view.origin[0] + (columns + 0.5) / view.scale[0]
    rows = torch.arange(height, dtype=dtype, device=g.mean.device)
    y = view.origin[1] + (rows + 0.5) / view.scale[1]
    if torch.is_grad_enabled() and any(t.requires_grad for t in g.tensors().values()):
        return _sum(g, x, y, view, box)
    image = torch.zeros(height, width, 3, dtype=dtype, device=x.device)
    some = max(1, min(len(g), CHUNK // max(1, width)))
    band = max(1, CHUNK // max(1, width * some))
    for start in range(0, height, band):
        for first in range(0, len(g), some):
            part = g[first : first + some]
            image[start : start + band] += _sum(part, x, y[start : start + band], view, box)
    return image


def _sum(
    g: Gaussians,
    x: torch.Tensor,  # [w] sample positions, source pixels
    y: torch.Tensor,  # [h]
    view: View,
    box: tuple[float, float] | None,
) -> torch.Tensor:  # [h, w, 3]
    dx = x[None, :] - g.mean[:, 0:1]  # [N, w]
    dy = y[None, :] - g.mean[:, 1:2]  # [N, h]
    u = (dx / g.std[:, 0:1])[:, None, :]  # [N, 1, w]
    v = (dy / g.std[:, 1:2])[:, :, None]  # [N, h, 1]
    rho = g.rho[:, None, None]
    # (u^2 - 2 rho u v + v^2) / (1 - rho^2), written so that it cannot cancel
    q = v**2 + (u - rho * v) ** 2 / (1 - rho**2)  # [N, h, w]
    weight = torch.exp(-0.5 * q)
    if box is not None:
        inside_x = (dx * view.scale[0]).abs() <= box[0]
        inside_y = (dy * view.scale[1]).abs() <= box[1]
        weight = weight * (inside_y[:, :, None] & inside_x[:, None, :])
    return torch.einsum("nhw,nc->hwc", weight, g.peak)
