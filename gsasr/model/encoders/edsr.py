"""EDSR-baseline without its up-sampler: residual blocks of plain convolutions."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import nn


@dataclass(frozen=True)
class EDSRConfig:
    """channels: feature width. blocks: residual blocks. The defaults are EDSR-baseline."""

    channels: int = 64
    blocks: int = 16


class EDSR(nn.Module):
    """(B, 3, h, w) picture in [0, 1] -> (B, channels, h, w) features."""

    def __init__(self, config: EDSRConfig) -> None:
        super().__init__()
        self.config = config
        self.conv_first = nn.Conv2d(3, config.channels, 3, padding=1)
        self.body = nn.Sequential(*(ResidualBlock(config.channels) for _ in range(config.blocks)))
        self.conv_after_body = nn.Conv2d(config.channels, config.channels, 3, padding=1)

    @property
    def channels(self) -> int:
        return self.config.channels

    def initialise(self) -> None:
        """Small residuals, so that deep stacks start stable; features of mid-grey start at 0."""
        with torch.no_grad():
            for block in self.body:
                block.conv1.weight.mul_(0.1)
                block.conv2.weight.mul_(0.1)
            self.conv_first.weight.mul_(2)
            self.conv_first.bias.copy_(-0.5 * self.conv_first.weight.sum((1, 2, 3)))

    def forward(self, picture: torch.Tensor) -> torch.Tensor:
        # No global skip: the released encoder computes and drops it.
        return self.conv_after_body(self.body(self.conv_first(picture)))

    @staticmethod
    def config_from(state: dict[str, torch.Tensor]) -> EDSRConfig:
        """The configuration that has tensors of these shapes."""
        blocks = 1 + max(int(key.split(".")[1]) for key in state if key.startswith("body."))
        return EDSRConfig(channels=state["conv_first.weight"].shape[0], blocks=blocks)


class ResidualBlock(nn.Module):
    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels, channels, 3, padding=1)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x + self.conv2(torch.relu(self.conv1(x)))
