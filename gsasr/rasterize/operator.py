"""The differentiable rasterizer as a PyTorch operator, `torch.ops.gsasr.rasterize`.

It runs on the device of its tensors: numba on the CPU (cpu.py), our kernels on NVIDIA cards
(cuda.py). Autograd, `torch.compile` and `torch.library.opcheck` know it.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate

import torch
from torch import Tensor

from ..gaussians import Gaussians
from ..view import View
from . import footprint
from .batch import pictures, views_tensor


def draw(gaussians: Gaussians, counts: list[int], views: list[View], quality: str) -> list[Tensor]:
    """One (h, w, 3) image per view, on the device of the Gaussians, differentiable in them.

    gaussians: float32, of all pictures, one after the other; counts: how many each has.
    quality: "screen", "export" or "gradient" (see footprint.cut).
    """
    g = gaussians
    ends = list(accumulate(counts))
    own = [g[end - count : end] for count, end in zip(counts, ends, strict=True)]
    cut = torch.cat([footprint.cut(part, quality) for part in own])
    heights, widths = [v.size[0] for v in views], [v.size[1] for v in views]
    pixels = rasterize(
        g.mean, g.std, g.rho, g.peak, cut, views_tensor(views), counts, heights, widths
    )
    parts = pixels.split([h * w for h, w in zip(heights, widths, strict=True)])
    return [part.view(*view.size, 3) for part, view in zip(parts, views, strict=True)]


@torch.library.custom_op("gsasr::rasterize", mutates_args=())
def rasterize(
    mean: Tensor,  # [N, 2] float32, source pixels
    std: Tensor,  # [N, 2] source pixels
    rho: Tensor,  # [N]
    peak: Tensor,  # [N, 3] opacity * colour
    cut: Tensor,  # [N] drawn where q <= cut, nowhere if negative; no gradient
    views: Tensor,  # [B, 4] float64 on the CPU, of views_tensor
    counts: Sequence[int],  # [B] Gaussians of each picture
    heights: Sequence[int],  # [B] output pixels
    widths: Sequence[int],  # [B]
) -> Tensor:  # [P, 3] the pixels of all pictures, row by row
    batch = pictures(views, counts, heights, widths)
    return _backend(mean).forward(mean, std, rho, peak, cut, batch)


@torch.library.custom_op("gsasr::rasterize_backward", mutates_args=())
def rasterize_backward(
    upstream: Tensor,  # [P, 3]
    mean: Tensor,
    std: Tensor,
    rho: Tensor,
    peak: Tensor,
    cut: Tensor,
    views: Tensor,
    counts: Sequence[int],
    heights: Sequence[int],
    widths: Sequence[int],
) -> Tensor:  # [N, 8]: mean 2, std 2, rho, peak 3
    batch = pictures(views, counts, heights, widths)
    return _backend(mean).backward(upstream, mean, std, rho, peak, cut, batch)


@rasterize.register_fake
def _(mean, std, rho, peak, cut, views, counts, heights, widths):
    return mean.new_empty(sum(h * w for h, w in zip(heights, widths, strict=True)), 3)


@rasterize_backward.register_fake
def _(upstream, mean, std, rho, peak, cut, views, counts, heights, widths):
    return mean.new_empty(mean.shape[0], 8)


def _remember(ctx, inputs, output):
    *tensors, ctx.counts, ctx.heights, ctx.widths = inputs
    ctx.save_for_backward(*tensors)


def _chain(ctx, upstream):
    grads = rasterize_backward(
        upstream.contiguous(), *ctx.saved_tensors, ctx.counts, ctx.heights, ctx.widths
    )
    mean, std, rho, peak = grads.split((2, 2, 1, 3), dim=1)
    return mean, std, rho.squeeze(1), peak, None, None, None, None, None


rasterize.register_autograd(_chain, setup_context=_remember)


def _backend(tensor: Tensor):
    if tensor.is_cuda:
        from . import cuda

        return cuda
    from . import cpu

    return cpu
