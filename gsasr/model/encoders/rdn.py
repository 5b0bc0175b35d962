"""RDN (arXiv 1802.08797) without its up-sampler: densely connected convolutions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import nn

from ..state import State, count
from .parts import center_on_grey, soften


@dataclass(frozen=True)
class RDNConfig:
    """The defaults are the RDN of the paper.

    channels: feature width (G0). growth: channels that each convolution of a block adds (G).
    blocks: dense blocks (D). layers: convolutions in each (C).
    """

    family: ClassVar[str] = "RDN"
    window: ClassVar[int] = 1

    channels: int = 64
    growth: int = 64
    blocks: int = 16
    layers: int = 8

    def __str__(self) -> str:
        return (
            f"RDN, {self.channels} channels, {self.blocks} blocks of {self.layers} layers, "
            f"growth {self.growth}"
        )


class RDN(nn.Module):
    """(B, 3, h, w) picture in [0, 1] -> (B, channels, h, w) features."""

    SIGN = "RDBs.0."

    def __init__(self, config: RDNConfig) -> None:
        super().__init__()
        self.channels = dim = config.channels
        self.SFENet1 = nn.Conv2d(3, dim, 3, padding=1)
        self.SFENet2 = nn.Conv2d(dim, dim, 3, padding=1)
        self.RDBs = nn.ModuleList(
            ResidualDenseBlock(dim, config.growth, config.layers) for _ in range(config.blocks)
        )
        self.GFF = nn.Sequential(
            nn.Conv2d(config.blocks * dim, dim, 1), nn.Conv2d(dim, dim, 3, padding=1)
        )

    def initialise(self) -> None:
        soften(*(block.LFF for block in self.RDBs))
        center_on_grey(self.SFENet1)

    def forward(self, picture: torch.Tensor) -> torch.Tensor:
        shallow = self.SFENet1(picture)
        x = self.SFENet2(shallow)
        outputs = []
        for block in self.RDBs:
            x = block(x)
            outputs.append(x)
        return shallow + self.GFF(torch.cat(outputs, dim=1))

    @staticmethod
    def config_from(state: State) -> RDNConfig:
        """The configuration that has tensors of these shapes. Raises KeyError, ValueError."""
        return RDNConfig(
            channels=len(state["SFENet1.weight"]),
            growth=len(state["RDBs.0.convs.0.conv.0.weight"]),
            blocks=count(state, "RDBs"),
            layers=count(state, "RDBs.0.convs"),
        )


class ResidualDenseBlock(nn.Module):
    def __init__(self, channels: int, growth: int, layers: int) -> None:
        super().__init__()
        self.convs = nn.Sequential(
            *(DenseLayer(channels + i * growth, growth) for i in range(layers))
        )
        self.LFF = nn.Conv2d(channels + layers * growth, channels, 1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x + self.LFF(self.convs(x))


class DenseLayer(nn.Module):
    """Appends `growth` channels to its input."""

    def __init__(self, channels: int, growth: int) -> None:
        super().__init__()
        self.conv = nn.Sequential(nn.Conv2d(channels, growth, 3, padding=1), nn.ReLU())

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return torch.cat((x, self.conv(x)), dim=1)
