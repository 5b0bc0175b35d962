"""HAT (arXiv 2309.05239) without its up-sampler, with rotary positions: the larger encoder.

Blocks look at a window through attention and at the whole picture through the mean of each channel;
at the end of each group the tokens of a window look at a larger window around it. Unlike in the
original, positions are rotary, and shifted windows wrap around the picture without a mask.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import nn

from ..attention import Attention, SelfAttention, from_windows, on_grid, to_windows
from ..state import State, count, side
from .windowed import FeedForward, Group, WindowedEncoder

CONV_SCALE = 0.01  # weight of a block's convolutions beside its attention


@dataclass(frozen=True)
class HATConfig:
    """The defaults are HAT-L as in the supplementary of the paper.

    width: of a token. depths, heads: blocks, and attention heads of a block, per group.
    window: side of a window in pixels. reach: side of the larger window at the end of a group.
    hidden: width of the hidden layer of an MLP. compressed, squeezed: channels between a block's
        convolutions, and of what is known of the whole picture. channels: of the features.
    """

    family: ClassVar[str] = "HAT"

    width: int = 192
    depths: tuple[int, ...] = (6,) * 12
    heads: tuple[int, ...] = (6,) * 12
    window: int = 16
    reach: int = 24
    hidden: int = 384
    compressed: int = 64
    squeezed: int = 6
    channels: int = 64

    def __str__(self) -> str:
        return (
            f"HAT, {self.width} channels, {sum(self.depths)} blocks in {len(self.depths)} groups, "
            f"{self.heads[0]} heads, windows {self.window} and {self.reach}"
        )


class HAT(WindowedEncoder):
    SIGN = ".residual_group.overlap_attn."

    def __init__(self, config: HATConfig) -> None:
        groups = (
            Group(
                config.width,
                (HybridBlock(config, heads, i % 2 == 1) for i in range(depth)),
                overlap_attn=OverlappingAttention(config, heads),
            )
            for depth, heads in zip(config.depths, config.heads, strict=True)
        )
        super().__init__(config.width, config.channels, groups)
        # Checkpoints carry these from the time before rotary positions; nothing reads them.
        own, larger = config.window**2, config.reach**2
        for name, keys in (("SA", own), ("OCA", larger)):
            unread = torch.zeros(own, keys, dtype=torch.long)
            self.register_buffer(f"relative_position_index_{name}", unread)

    @staticmethod
    def config_from(state: State) -> HATConfig:
        """The configuration that has tensors of these shapes. Raises KeyError, ValueError."""
        groups = range(count(state, "layers"))
        last = "layers.{}.residual_group.overlap_attn"
        block = "layers.0.residual_group.blocks.0"
        return HATConfig(
            width=len(state["conv_first.weight"]),
            depths=tuple(count(state, f"layers.{i}.residual_group.blocks") for i in groups),
            heads=tuple(state[f"{last.format(i)}.rope_freqs"].shape[1] for i in groups),
            window=side(len(state[f"{block}.attn.rope_t_x"])),
            reach=side(len(state[f"{last.format(0)}.rope_t_x"])),
            hidden=len(state[f"{block}.mlp.fc1.weight"]),
            compressed=len(state[f"{block}.conv_block.cab.0.weight"]),
            squeezed=len(state[f"{block}.conv_block.cab.3.attention.1.weight"]),
            channels=len(state["conv_before_upsample.0.weight"]),
        )


class HybridBlock(nn.Module):
    """Attention within windows and convolutions side by side, then an MLP."""

    def __init__(self, config: HATConfig, heads: int, shifted: bool) -> None:
        super().__init__()
        width = config.width
        self.window = config.window
        self.shift = config.window // 2 if shifted else 0
        self.norm1 = nn.LayerNorm(width)
        self.attn = SelfAttention(width, heads, config.window, "rotary")
        self.conv_block = ConvBlock(width, config.compressed, config.squeezed)
        self.norm2 = nn.LayerNorm(width)
        self.mlp = FeedForward(width, config.hidden)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        _, h, w, _ = x.shape  # [B, h, w, C]
        grid = self.norm1(x)
        convolved = on_grid(self.conv_block, grid)
        if self.shift:
            grid = grid.roll((-self.shift, -self.shift), (1, 2))
        attended = from_windows(self.attn(to_windows(grid, self.window)), self.window, h, w)
        if self.shift:
            attended = attended.roll((self.shift, self.shift), (1, 2))
        x = x + attended + CONV_SCALE * convolved
        return x + self.mlp(self.norm2(x))


class ConvBlock(nn.Module):
    """Two convolutions; each channel is then weighed by what is known of the whole picture."""

    def __init__(self, width: int, compressed: int, squeezed: int) -> None:
        super().__init__()
        self.cab = nn.Sequential(
            nn.Conv2d(width, compressed, 3, padding=1),
            nn.GELU(),
            nn.Conv2d(compressed, width, 3, padding=1),
            ChannelWeights(width, squeezed),
        )

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.cab(x)


class ChannelWeights(nn.Module):
    def __init__(self, width: int, squeezed: int) -> None:
        super().__init__()
        self.attention = nn.Sequential(
            nn.AdaptiveAvgPool2d(1),
            nn.Conv2d(width, squeezed, 1),
            nn.ReLU(),
            nn.Conv2d(squeezed, width, 1),
            nn.Sigmoid(),
        )

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x * self.attention(x)


class OverlappingAttention(Attention):
    """Tokens of each window look at a larger window around it, then an MLP.

    Beyond the picture's edge keys and values are zeros, which take part in the softmax.
    """

    def __init__(self, config: HATConfig, heads: int) -> None:
        super().__init__(config.width, heads, config.window, config.reach, "rotary")
        self.window, self.reach = config.window, config.reach
        self.norm1 = nn.LayerNorm(config.width)
        self.qkv = nn.Linear(config.width, 3 * config.width)
        self.norm2 = nn.LayerNorm(config.width)
        self.mlp = FeedForward(config.width, config.hidden)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        _, h, w, _ = x.shape  # [B, h, w, C]
        q, k, v = self.qkv(self.norm1(x)).chunk(3, dim=-1)
        attended = self.attend(to_windows(q, self.window), self._around(k), self._around(v))
        x = x + from_windows(attended, self.window, h, w)
        return x + self.mlp(self.norm2(x))

    def _around(self, grid: torch.Tensor) -> torch.Tensor:
        """(B, h, w, C) -> (B * windows, reach^2, C): the larger window around each window."""
        more = (self.reach - self.window) // 2
        padded = F.pad(grid, (0, 0, more, more, more, more))
        larger = padded.unfold(1, self.reach, self.window).unfold(2, self.reach, self.window)
        tokens = larger.permute(0, 1, 2, 4, 5, 3)  # [B, down, across, reach, reach, C]
        return tokens.reshape(-1, self.reach**2, grid.shape[-1])
