"""GSASR: an encoder and a Gaussian decoder."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from torch import nn

from ..errors import RequestError
from ..gaussians import Gaussians
from .decoder import DecoderConfig, GaussianDecoder
from .encoders import ENCODERS, EDSRConfig, EncoderConfig


@dataclass(frozen=True)
class ModelConfig:
    """What a network is made of. The defaults are the paper's EDSR-baseline model."""

    encoder: EncoderConfig = field(default_factory=EDSRConfig)
    decoder: DecoderConfig = field(default_factory=DecoderConfig)

    @property
    def multiple(self) -> int:
        """What picture sides must divide by: both windows must fit."""
        return math.lcm(self.encoder.window, self.decoder.window)

    def __str__(self) -> str:
        """The family, such as "HAT with the enhanced decoder"."""
        kind = "enhanced" if self.decoder.enhanced else "paper's"
        return f"{self.encoder.family} with the {kind} decoder"


class GSASR(nn.Module):
    """A picture and a target scale -> raw Gaussians.

    name: shown to the user and stored in fields; `multiple`: what picture sides must divide by.
    """

    def __init__(self, config: ModelConfig, name: str = "") -> None:
        super().__init__()
        self.config = config
        self.name = name
        self.encoder = ENCODERS[config.encoder.family](config.encoder)
        self.decoder = GaussianDecoder(config.decoder, self.encoder.channels)
        self.initialise()

    def initialise(self) -> None:
        """Draw weights that keep the size of the signal from layer to layer.

        PyTorch's default shrinks it by 1.7 per layer, which hides the picture from the decoder for
        the first hundreds of steps.
        """
        for layer in self.modules():
            if isinstance(layer, (nn.Linear, nn.Conv2d)):
                nn.init.normal_(layer.weight, std=layer.weight[0].numel() ** -0.5)
                nn.init.zeros_(layer.bias)
        self.encoder.initialise()
        self.decoder.initialise()

    @property
    def multiple(self) -> int:
        return self.config.multiple

    def encode(self, lr: torch.Tensor) -> torch.Tensor:
        """(B, 3, h, w) in [0, 1], sides multiples of `multiple` -> (B, channels, h, w)."""
        height, width = lr.shape[2:]
        if height % self.multiple or width % self.multiple:
            raise RequestError(
                f"Picture sides must be multiples of {self.multiple}, but are {height}x{width}."
            )
        return self.encoder(lr)

    def decode(self, features: torch.Tensor, scale: float | torch.Tensor) -> torch.Tensor:
        """(B, channels, h, w) and a scale > 0, one number or (B,) -> (B, N, 9) raw columns."""
        scale = torch.as_tensor(scale, dtype=torch.float32)
        # The check would split the graph of torch.compile; a scale on a card would wait for it.
        if not torch.compiler.is_compiling() and not bool((scale > 0).all()):
            raise RequestError("The conditioning scale must be above 0.")
        return self.decoder(features, scale.to(features.device).expand(features.shape[0]))

    def forward(self, lr: torch.Tensor, scale: float | torch.Tensor) -> torch.Tensor:
        return self.decode(self.encode(lr), scale)


def activate(raw: torch.Tensor, size: tuple[int, int]) -> Gaussians:
    """(N, 9) raw columns of a picture of `size` (height, width) -> Gaussians.

    The released kernel's activations. Its columns are crossed: column 0 spreads along y, column 1
    along x. A spread of 1.2 kernel units is one source pixel, so std < 0.834 px.
    """
    height, width = size
    spread = 0.99999 * torch.sigmoid(raw[:, 0:2]) + 1e-6
    return Gaussians(
        mean=raw[:, 7:9] * raw.new_tensor([width, height]),
        std=spread.flip(1) / 1.2,
        rho=0.999999 * torch.tanh(raw[:, 2]),
        color=torch.sigmoid(raw[:, 4:7]),
        opacity=torch.sigmoid(raw[:, 3]),
        size=size,
    )
