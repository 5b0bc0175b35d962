"""The decoder as the paper formulates it, for comparison with ours in `predict.py`.

Same weights, same outputs. The scale embedding is repeated for every token and attended to by the
library's multi-head attention, whose queries, keys and softmax weigh equal values; window attention
keeps its logits in memory; the heads run on all tokens at once, and activations are copies.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from unittest import mock

import torch
import torch.nn.functional as F
from torch import nn

from gsasr.model import GSASR
from gsasr.model.attention import MLP, ScaleAttention, from_windows, to_windows
from gsasr.model.decoder import CrossLayer, SelfLayer


@contextmanager
def straightforward(model: GSASR) -> Iterator[None]:
    """Inside, the model's decoder works the long way. Its weights get no gradients from then on."""
    model.requires_grad_(False)
    heads = model.config.decoder.heads
    in_place = [m for m in model.modules() if isinstance(m, nn.ReLU) and m.inplace]
    for activation in in_place:
        activation.inplace = False
    with (
        mock.patch.object(CrossLayer, "forward", lambda *a: _cross(*a, heads)),
        mock.patch.object(SelfLayer, "forward", lambda *a: _own(*a, heads)),
        mock.patch.object(MLP, "forward", lambda mlp, x: mlp.fc2(torch.relu(mlp.fc1(x)))),
        torch.enable_grad(),  # the way that training goes, but there is nothing to record
    ):
        yield
    for activation in in_place:
        activation.inplace = True


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
    """The library's attention of every token to one embedding per token of its window."""
    count, tokens, dim = windows.shape
    repeated = embedding.repeat_interleave(count // len(embedding), dim=0)[:, None]
    repeated = repeated.repeat(1, tokens, 1).transpose(0, 1)
    mixed, _ = F.multi_head_attention_forward(
        windows.transpose(0, 1), repeated, repeated, dim, heads,
        attention.in_proj_weight, attention.in_proj_bias, None, None, False, 0.0,
        attention.out_proj.weight, attention.out_proj.bias, training=False,
    )  # fmt: skip
    return mixed.transpose(0, 1)
