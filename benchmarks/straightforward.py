"""The decoder as the paper formulates it, for comparison with ours in `predict.py`.

Same weights, same outputs. The scale embedding is repeated for every token and attended to, with
queries, keys and a softmax that all weigh equal values; attention keeps its logits in memory; the
heads run on all tokens at once.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from unittest import mock

import torch
import torch.nn.functional as F

from gsasr.model import GSASR
from gsasr.model.attention import MLP, ScaleAttention, from_windows, to_windows
from gsasr.model.decoder import CrossLayer, SelfLayer


@contextmanager
def straightforward(model: GSASR) -> Iterator[None]:
    """Inside, the model's decoder works the long way. Its weights get no gradients from then on."""
    model.requires_grad_(False)
    heads = model.config.decoder.heads
    with (
        mock.patch.object(CrossLayer, "forward", lambda *a: _cross(*a, heads)),
        mock.patch.object(SelfLayer, "forward", lambda *a: _own(*a, heads)),
        mock.patch.object(MLP, "forward", lambda mlp, x: mlp.fc2(torch.relu(mlp.fc1(x)))),
        torch.enable_grad(),  # the way that training goes, but there is nothing to record
    ):
        yield


def _cross(layer: CrossLayer, x, positions, guide, embedding, heads: int):
    windows = to_windows(layer.norm1(x), layer.seeds) + positions
    scaled = _scale_attention(layer.gs_cross_attn_scale, windows, embedding, heads)
    x = x + from_windows(scaled, layer.seeds, *x.shape[1:3])
    x = x + layer.mlp_crossattn_scale(layer.norm2(x))
    queries = to_windows(layer.norm3(x), layer.seeds) + positions
    shifted = guide.roll((-layer.shift, -layer.shift), (1, 2)) if layer.shift else guide
    attended = layer.window_cross_attn(queries, to_windows(shifted, layer.window))
    x = x + from_windows(attended, layer.seeds, *x.shape[1:3])
    return x + layer.mlp_crossattn_feature(layer.norm4(x))


def _own(layer: SelfLayer, x, embedding, heads: int):
    windows = to_windows(layer.norm3(x), layer.seeds)
    scaled = _scale_attention(layer.gs_cross_attn_scale, windows, embedding, heads)
    x = x + from_windows(scaled, layer.seeds, *x.shape[1:3])
    x = x + layer.mlp_crossattn(layer.norm4(x))
    grid = layer.norm1(x)
    if layer.shift:
        grid = grid.roll((-layer.shift, -layer.shift), (1, 2))
    windows = to_windows(grid, layer.seeds)
    attended = from_windows(layer.gs_self_attn(windows, windows), layer.seeds, *x.shape[1:3])
    if layer.shift:
        attended = attended.roll((layer.shift, layer.shift), (1, 2))
    x = x + attended
    return x + layer.mlp_selfattn(layer.norm2(x))


def _scale_attention(
    attention: ScaleAttention, windows: torch.Tensor, embedding: torch.Tensor, heads: int
) -> torch.Tensor:
    """Multi-head attention of every token to the embedding, once for each token of its window."""
    count, tokens, _ = windows.shape
    repeated = embedding.repeat_interleave(count // len(embedding), dim=0)[:, None]
    repeated = repeated.repeat(1, tokens, 1)
    q, k, v = (
        F.linear(x, weight, bias).unflatten(-1, (heads, -1)).transpose(1, 2)
        for x, weight, bias in zip(
            (windows, repeated, repeated),
            attention.in_proj_weight.chunk(3),
            attention.in_proj_bias.chunk(3),
            strict=True,
        )
    )
    weights = (q @ k.transpose(-2, -1) * q.shape[-1] ** -0.5).softmax(dim=-1)
    return attention.out_proj((weights.to(v.dtype) @ v).transpose(1, 2).flatten(2))
