"""EDSR-baseline without its up-sampler: residual blocks of plain convolutions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import nn

from ..state import State, count
from .parts import center_on_grey, soften


@dataclass(frozen=True)
class EDSRConfig:
    """channels: feature width. blocks: residual blocks. The defaults are EDSR-baseline."""

    family: ClassVar[str] = "EDSR"
    window: ClassVar[int] = 1

    channels: int = 64
    blocks: int = 16

    def __str__(self) -> str:
        return f"EDSR, {self.channels} channels, {self.blocks} blocks"


class EDSR(nn.Module):
    """(B, 3, h, w) picture in [0, 1] -> (B, channels, h, w) features."""

    SIGN = "body.0."

    def __init__(self, config: EDSRConfig) -> None:
        super().__init__()
        self.channels = config.channels
        self.conv_first = nn.Conv2d(3, config.channels, 3, padding=1)
        self.body = nn.Sequential(*(ResidualBlock(config.channels) for _ in range(config.blocks)))
        self.conv_after_body = nn.Conv2d(config.channels, config.channels, 3, padding=1)

    def initialise(self) -> None:
        for block in self.body:
            soften(block.conv1, block.conv2)
        center_on_grey(self.conv_first)

    def forward(self, picture: torch.Tensor) -> torch.Tensor:
        # No global skip: the released encoder computes and drops it.
        return self.conv_after_body(self.body(self.conv_first(picture)))

    @staticmethod
    def config_from(state: State) -> EDSRConfig:
        """The configuration that has tensors of these shapes. Raises KeyError, ValueError."""
        return EDSRConfig(channels=len(state["conv_first.weight"]), blocks=count(state, "body"))


class ResidualBlock(nn.Module):
    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels, channels, 3, padding=1)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x + self.conv2(torch.relu(self.conv1(x)))
