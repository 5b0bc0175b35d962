"""Window attention: the Gaussian decoder's, and the core of the encoders'.

Tokens live on a grid (B, H, W, C) all the way, so a shifted window is a roll of the grid. Attribute
names follow the released checkpoints, whose tensors load by key.
"""

from __future__ import annotations

import math
from typing import Literal

import torch
import torch.nn.functional as F
from torch import nn

Position = Literal["bias", "rotary"]


def to_windows(grid: torch.Tensor, side: int) -> torch.Tensor:
    """(B, H, W, C) -> (B * windows, side^2, C); windows run row by row, so do tokens in one."""
    b, h, w, c = grid.shape
    windows = grid.view(b, h // side, side, w // side, side, c).transpose(2, 3)
    return windows.reshape(-1, side * side, c)


def from_windows(windows: torch.Tensor, side: int, height: int, width: int) -> torch.Tensor:
    """Inverse of `to_windows`: (B * windows, side^2, C) -> (B, height, width, C)."""
    c = windows.shape[-1]
    grid = windows.view(-1, height // side, width // side, side, side, c).transpose(2, 3)
    return grid.reshape(-1, height, width, c)


def on_grid(conv: nn.Module, tokens: torch.Tensor) -> torch.Tensor:
    """(B, H, W, C) tokens through convolutions that want (B, C, H, W)."""
    return conv(tokens.permute(0, 3, 1, 2)).permute(0, 2, 3, 1)


class Attention(nn.Module):
    """Multi-head attention of the queries of one window to its keys. Subclasses project.

    query_side, key_side: tokens along one side of a window of queries and of keys.
    position: how attention knows where tokens are. "bias": a learned number per head and offset is
        added to the logits. "rotary": queries and keys are turned by learned angles per position.
    """

    def __init__(
        self, dim: int, heads: int, query_side: int, key_side: int, position: Position
    ) -> None:
        super().__init__()
        self.heads = heads
        self.position = position
        self.aligned = query_side == key_side  # token i of both lies at the same place
        self.proj = nn.Linear(dim, dim)
        finer = max(query_side, key_side)
        if position == "bias":
            table = torch.empty((2 * finer - 1) ** 2, heads)
            self.relative_position_bias_table = nn.Parameter(nn.init.trunc_normal_(table, std=0.02))
            self.register_buffer(
                "relative_position_index", relative_position_index(query_side, key_side)
            )
        else:
            # Row by row on the finer grid. The coarser one takes the first of these positions,
            # wherever its tokens are: the released weights were trained so.
            self.rope_freqs = nn.Parameter(rotary_frequencies(heads, dim // heads))
            self.register_buffer("rope_t_x", torch.arange(finer).repeat(finer).float())
            self.register_buffer("rope_t_y", torch.arange(finer).repeat_interleave(finer).float())

    def attend(
        self,
        queries: torch.Tensor,
        keys: torch.Tensor,
        values: torch.Tensor,
        mask: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """(windows, Nq, C) queries, (windows, Nk, C) keys and values -> (windows, Nq, C).

        mask: (windows of a picture, Nq, Nk), added to the logits; only with position "bias".
        """
        q, k, v = (
            x.unflatten(-1, (self.heads, -1)).transpose(1, 2)  # [windows, heads, N, C/heads]
            for x in (queries, keys, values)
        )
        if self.position == "rotary":
            angles = self._angles()
            mixed = F.scaled_dot_product_attention(turned(q, angles), turned(k, angles), v)
        else:
            bias = self._bias()[None]
            if mask is not None:
                bias = (bias + mask[:, None]).repeat(len(q) // len(mask), 1, 1, 1)
            if torch.is_grad_enabled():
                # With a bias to train, the library's attention falls back to plain products and
                # guards against masked rows: a tenth of a training step, and none occur here.
                logits = (q * q.shape[-1] ** -0.5) @ k.transpose(-2, -1) + bias
                mixed = logits.softmax(dim=-1).to(v.dtype) @ v
            else:
                mixed = F.scaled_dot_product_attention(q, k, v, attn_mask=bias.to(q.dtype))
        return self.proj(mixed.transpose(1, 2).flatten(2))

    def _bias(self) -> torch.Tensor:
        """(heads, Nq, Nk)"""
        bias = self.relative_position_bias_table[self.relative_position_index]
        return bias.permute(2, 0, 1)

    def _angles(self) -> torch.Tensor:
        """(heads, positions, C/heads/2) radians, in float32 whatever the network computes in."""
        along_x, along_y = self.rope_freqs.float()[:, :, None]  # [heads, 1, C/heads/2]
        return self.rope_t_x[:, None] * along_x + self.rope_t_y[:, None] * along_y


class WindowAttention(Attention):
    """Attention of the Gaussian decoder: queries, keys and values are projected apart."""

    def __init__(
        self, dim: int, heads: int, query_side: int, key_side: int, position: Position = "bias"
    ) -> None:
        super().__init__(dim, heads, query_side, key_side, position)
        self.qhead = nn.Linear(dim, dim)
        self.khead = nn.Linear(dim, dim)
        self.vhead = nn.Linear(dim, dim)

    def look_at_own_position(self) -> None:
        """Start with each query looking mostly at the keys under it, not at the window's mean.

        Without it the first thousand steps of training go into finding this out.
        """
        with torch.no_grad():
            if self.position == "bias":
                keys = self.relative_position_index.shape[1]
                finer = math.isqrt(self.relative_position_bias_table.shape[0]) // 2 + 1
                no_offset = (finer - 1) * (2 * finer - 1) + finer - 1
                self.relative_position_bias_table[no_offset] = math.log(keys)
            elif self.aligned:
                # Equal biases, turned by position, agree best where the positions are equal: their
                # product adds 2 log(keys) to the logit there, and less the further away.
                keys, width = len(self.rope_t_x), self.khead.out_features // self.heads
                both = math.sqrt(2 * math.log(keys) / width**0.5)
                self.qhead.bias.fill_(both)
                self.khead.bias.fill_(both)

    def forward(self, queries: torch.Tensor, tokens: torch.Tensor) -> torch.Tensor:
        """(windows, Nq, C) queries over (windows, Nk, C) tokens -> (windows, Nq, C)."""
        return self.attend(self.qhead(queries), self.khead(tokens), self.vhead(tokens))


class SelfAttention(Attention):
    """Attention of the encoders: tokens of a window to each other, projected at once."""

    def __init__(self, dim: int, heads: int, side: int, position: Position) -> None:
        super().__init__(dim, heads, side, side, position)
        self.qkv = nn.Linear(dim, 3 * dim)

    def forward(self, tokens: torch.Tensor, mask: torch.Tensor | None = None) -> torch.Tensor:
        """(windows, N, C) -> the same. mask: see `attend`."""
        return self.attend(*self.qkv(tokens).chunk(3, dim=-1), mask)


def turned(x: torch.Tensor, angles: torch.Tensor) -> torch.Tensor:
    """(windows, heads, N, C) with each pair of neighbouring channels turned as a point of a plane.

    angles: (heads, N or more, C/2) radians; the first N are used.
    """
    first, second = x.float().unflatten(-1, (-1, 2)).unbind(-1)
    angles = angles[:, : x.shape[2]]
    cos, sin = angles.cos(), angles.sin()
    both = torch.stack((first * cos - second * sin, first * sin + second * cos), dim=-1)
    return both.flatten(-2).type_as(x)


def rotary_frequencies(heads: int, width: int) -> torch.Tensor:
    """(2, heads, width/2) radians per token along x and y, to start training from.

    Each head has a pair of perpendicular directions of its own, at random, and looks along both in
    wavelengths that grow from pair to pair by a power of 10, as in RoPE-Mixed (arXiv 2403.13298).
    """
    pairs = width // 2
    along = torch.arange(pairs) < (pairs + 1) // 2  # the first half along one direction
    step = torch.arange(pairs) % max(1, (pairs + 1) // 2)
    rate = 10.0 ** (-4.0 * step / width)
    direction = 2 * math.pi * torch.rand(heads, 1) + torch.where(along, 0.0, math.pi / 2)
    return torch.stack((rate * direction.cos(), rate * direction.sin()))


def relative_position_index(query_side: int, key_side: int) -> torch.Tensor:
    """(query_side^2, key_side^2) int64: the row of the bias table for each pair of tokens.

    Both grids share one window; positions are compared on the finer of the two grids. Loading a
    checkpoint replaces this numbering by the one it was trained with.
    """
    finer = max(query_side, key_side)
    offsets = (
        _centers(query_side, finer)[:, None] - _centers(key_side, finer)[None, :] + finer - 1
    ).long()  # [query_side, key_side], in [0, 2 finer - 2]
    rows = offsets[:, None, :, None] * (2 * finer - 1)
    return (rows + offsets[None, :, None, :]).flatten(2).flatten(0, 1).contiguous()


def _centers(side: int, finer: int) -> torch.Tensor:
    """Index on a grid of `finer` cells under the centre of each of `side` cells."""
    return ((torch.arange(side) + 0.5) * finer / side).floor()


class ScaleAttention(nn.Module):
    """Cross-attention to the scale embedding, as the one vector that it is.

    All keys and values are the same embedding, so the softmax weighs equal values: whatever the
    query, the result is out_proj(v_proj(embedding)). The query and key thirds of `in_proj` are
    kept only because checkpoints carry them.
    """

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.in_proj_weight = nn.Parameter(torch.empty(3 * dim, dim))
        self.in_proj_bias = nn.Parameter(torch.zeros(3 * dim))
        self.out_proj = nn.Linear(dim, dim)
        nn.init.xavier_uniform_(self.in_proj_weight)
        nn.init.zeros_(self.out_proj.bias)

    def forward(self, embedding: torch.Tensor) -> torch.Tensor:
        """(B, C) scale embedding -> (B, 1, 1, C), to be added to every token."""
        dim = embedding.shape[-1]
        value = F.linear(embedding, self.in_proj_weight[-dim:], self.in_proj_bias[-dim:])
        return self.out_proj(value)[:, None, None, :]


class MLP(nn.Module):
    """Two layers with a ReLU between."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(dim, dim)
        self.fc2 = nn.Linear(dim, dim)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.fc2(self.fc1(x).relu_())
