"""What SwinIR and HAT share: groups of blocks of window attention between convolutions."""

from __future__ import annotations

from collections.abc import Iterable

import torch
import torch.nn.functional as F
from torch import nn

from ..attention import on_grid
from .parts import center_on_grey, soften


class WindowedEncoder(nn.Module):
    """(B, 3, h, w) picture in [0, 1] -> (B, channels, h, w); sides are multiples of the window."""

    def __init__(self, width: int, channels: int, groups: Iterable[Group]) -> None:
        super().__init__()
        self.channels = channels
        self.conv_first = nn.Conv2d(3, width, 3, padding=1)
        self.patch_embed = nn.ModuleDict({"norm": nn.LayerNorm(width)})
        self.layers = nn.ModuleList(groups)
        self.norm = nn.LayerNorm(width)
        self.conv_after_body = nn.Conv2d(width, width, 3, padding=1)
        self.conv_before_upsample = nn.Sequential(
            nn.Conv2d(width, channels, 3, padding=1), nn.LeakyReLU(0.01)
        )

    def initialise(self) -> None:
        for name, layer in self.layers.named_modules():
            if name.endswith((".proj", ".fc2")) or (
                name.count(".") == 1 and name.endswith(".conv")
            ):
                soften(layer)
        center_on_grey(self.conv_first)

    def forward(self, picture: torch.Tensor) -> torch.Tensor:
        shallow = self.conv_first(picture)
        tokens = self.patch_embed["norm"](shallow.permute(0, 2, 3, 1))  # [B, h, w, C]
        for group in self.layers:
            tokens = group(tokens)
        deep = on_grid(self.conv_after_body, self.norm(tokens)).permute(0, 3, 1, 2)
        return self.conv_before_upsample(shallow + deep)


class Group(nn.Module):
    """Blocks, what may follow them, and a convolution, around a residual connection.

    last: parts after the blocks, by the names that their tensors have in checkpoints.
    """

    def __init__(self, width: int, blocks: Iterable[nn.Module], **last: nn.Module) -> None:
        super().__init__()
        self.residual_group = nn.ModuleDict({"blocks": nn.Sequential(*blocks), **last})
        self.conv = nn.Conv2d(width, width, 3, padding=1)

    def forward(self, tokens: torch.Tensor) -> torch.Tensor:
        x = tokens  # [B, h, w, C]
        for part in self.residual_group.values():
            x = part(x)
        return tokens + on_grid(self.conv, x)


class FeedForward(nn.Module):
    """Two layers with a GELU between."""

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(width, hidden)
        self.fc2 = nn.Linear(hidden, width)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.fc2(F.gelu(self.fc1(x)))
