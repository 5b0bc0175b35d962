"""Window attention of the Gaussian decoder.

Tokens live on a grid (B, H, W, C) all the way, so a shifted window is a roll of the grid. Attribute
names follow the released checkpoints, whose tensors load by key.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import nn


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


class WindowAttention(nn.Module):
    """Multi-head attention of the queries of one window to its keys, with a learned position bias.

    query_side, key_side: tokens along one side of a window of queries and of keys.
    """

    def __init__(self, dim: int, heads: int, query_side: int, key_side: int) -> None:
        super().__init__()
        self.heads = heads
        self.qhead = nn.Linear(dim, dim)
        self.khead = nn.Linear(dim, dim)
        self.vhead = nn.Linear(dim, dim)
        self.proj = nn.Linear(dim, dim)
        table = (2 * max(query_side, key_side) - 1) ** 2
        self.relative_position_bias_table = nn.Parameter(torch.empty(table, heads))
        nn.init.trunc_normal_(self.relative_position_bias_table, std=0.02)
        self.register_buffer(
            "relative_position_index", relative_position_index(query_side, key_side)
        )

    def look_at_own_position(self) -> None:
        """Start with each query looking mostly at the keys under it, not at the window's mean.

        Without it the first thousand steps of training go into finding this out.
        """
        finer = math.isqrt(self.relative_position_bias_table.shape[0]) // 2 + 1
        no_offset = (finer - 1) * (2 * finer - 1) + finer - 1
        with torch.no_grad():
            keys = self.relative_position_index.shape[1]
            self.relative_position_bias_table[no_offset] = math.log(keys)

    def forward(self, queries: torch.Tensor, tokens: torch.Tensor) -> torch.Tensor:
        """(windows, Nq, C) queries over (windows, Nk, C) tokens -> (windows, Nq, C)."""
        q, k, v = (
            head(x).unflatten(-1, (self.heads, -1)).transpose(1, 2)  # [windows, heads, N, C/heads]
            for head, x in ((self.qhead, queries), (self.khead, tokens), (self.vhead, tokens))
        )
        bias = self.relative_position_bias_table[self.relative_position_index]  # [Nq, Nk, heads]
        # Windows are small, so plain products; the library's attention guards against rows
        # that are masked out, which costs a tenth of a training step and cannot happen here.
        logits = (q * q.shape[-1] ** -0.5) @ k.transpose(-2, -1) + bias.permute(2, 0, 1)
        mixed = logits.softmax(dim=-1).to(v.dtype) @ v
        return self.proj(mixed.transpose(1, 2).flatten(2))


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
    def __init__(self, dim: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(dim, dim)
        self.fc2 = nn.Linear(dim, dim)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.fc2(self.fc1(x).relu_())
