"""Networks by name."""

from __future__ import annotations

from .decoder import DecoderConfig
from .encoders import EDSRConfig
from .network import ModelConfig

PRESETS = {
    # The paper's numbers: k = 12, m = 16, d = 180, L = 6.
    "edsr-baseline": ModelConfig(),
    # Ours: small enough for a CPU, and shipped trained.
    "lite": ModelConfig(
        EDSRConfig(channels=48, blocks=8),
        DecoderConfig(
            channels=48,
            heads=4,
            window=8,
            seeds=8,
            cross_layers=2,
            self_blocks=2,
            self_layers=2,
            shuffle=(2, 1),
            head_expansion=2,
        ),
    ),
}
