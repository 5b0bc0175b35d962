"""SwinIR (arXiv 2108.10257) without its up-sampler: attention in windows and shifted windows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import nn

from ..attention import SelfAttention, from_windows, to_windows
from ..state import State, count, side
from .windowed import FeedForward, Group, WindowedEncoder


@dataclass(frozen=True)
class SwinIRConfig:
    """The defaults are the SwinIR of the paper.

    width: of a token. depths, heads: blocks, and attention heads of a block, per group.
    window: side of a window in pixels. hidden: width of the hidden layer of a block's MLP.
    channels: of the features. picture: side of the pictures it was made for, in pixels; only the
        masks stored in checkpoints depend on it, and nothing shifts where that is one window.
    """

    family: ClassVar[str] = "SwinIR"

    width: int = 180
    depths: tuple[int, ...] = (6,) * 6
    heads: tuple[int, ...] = (6,) * 6
    window: int = 8
    hidden: int = 360
    channels: int = 64
    picture: int = 48

    def __str__(self) -> str:
        return (
            f"SwinIR, {self.width} channels, {sum(self.depths)} blocks in {len(self.depths)} "
            f"groups, {self.heads[0]} heads, window {self.window}"
        )


class SwinIR(WindowedEncoder):
    SIGN = ".residual_group."

    def __init__(self, config: SwinIRConfig) -> None:
        groups = (
            Group(config.width, (SwinBlock(config, heads, i % 2 == 1) for i in range(depth)))
            for depth, heads in zip(config.depths, config.heads, strict=True)
        )
        super().__init__(config.width, config.channels, groups)

    @staticmethod
    def config_from(state: State) -> SwinIRConfig:
        """The configuration that has tensors of these shapes. Raises KeyError, ValueError."""
        groups = range(count(state, "layers"))
        attention = "layers.{}.residual_group.blocks.0.attn.relative_position_"
        window = side(len(state[attention.format(0) + "index"]))
        masks = [value for key, value in state.items() if key.endswith(".attn_mask")]
        return SwinIRConfig(
            width=len(state["conv_first.weight"]),
            depths=tuple(count(state, f"layers.{i}.residual_group.blocks") for i in groups),
            heads=tuple(state[attention.format(i) + "bias_table"].shape[1] for i in groups),
            window=window,
            hidden=len(state["layers.0.residual_group.blocks.0.mlp.fc1.weight"]),
            channels=len(state["conv_before_upsample.0.weight"]),
            picture=window * side(len(masks[0])) if masks else window,
        )


class SwinBlock(nn.Module):
    """Attention within windows, then an MLP."""

    def __init__(self, config: SwinIRConfig, heads: int, shifted: bool) -> None:
        super().__init__()
        self.window = config.window
        self.shift = config.window // 2 if shifted and config.picture > config.window else 0
        self.norm1 = nn.LayerNorm(config.width)
        self.attn = SelfAttention(config.width, heads, config.window, "bias")
        self.norm2 = nn.LayerNorm(config.width)
        self.mlp = FeedForward(config.width, config.hidden)
        if self.shift:  # kept for checkpoints; pictures of other sizes need their own
            mask = shift_mask(config.picture, config.picture, config.window, self.shift)
            self.register_buffer("attn_mask", mask)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        _, h, w, _ = x.shape  # [B, h, w, C]
        grid, mask = self.norm1(x), None
        if self.shift:
            grid = grid.roll((-self.shift, -self.shift), (1, 2))
            mask = shift_mask(h, w, self.window, self.shift, x.device)
        attended = from_windows(self.attn(to_windows(grid, self.window), mask), self.window, h, w)
        if self.shift:
            attended = attended.roll((self.shift, self.shift), (1, 2))
        x = x + attended
        return x + self.mlp(self.norm2(x))


def shift_mask(
    height: int, width: int, window: int, shift: int, device: torch.device | None = None
) -> torch.Tensor:
    """(windows, window^2, window^2): 0 for tokens that are neighbours in the picture, else -100.

    A grid of height x width tokens rolled by `shift` brings opposite edges into one window.
    """

    def region(length: int) -> torch.Tensor:
        i = torch.arange(length, device=device)
        return (i >= length - window).int() + (i >= length - shift).int()  # 0, 1 or 2

    regions = 3 * region(height)[:, None] + region(width)
    tokens = to_windows(regions[None, :, :, None], window)[..., 0]  # [windows, window^2]
    apart = tokens[:, :, None] != tokens[:, None, :]
    return torch.zeros(apart.shape, device=device).masked_fill_(apart, -100.0)
