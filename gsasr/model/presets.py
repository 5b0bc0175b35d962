"""Networks by name: what they are made of. `hub.py` says where the authors' weights are."""

from __future__ import annotations

from .decoder import DecoderConfig
from .encoders import EDSRConfig, HATConfig, RDNConfig, SwinIRConfig
from .network import ModelConfig


def enhanced(window: int, cross: tuple[int, int], self_blocks: int = 6) -> DecoderConfig:
    """The enhanced decoder with a seed per pixel. cross: injection blocks, layers in each."""
    return DecoderConfig(
        channels=192,
        window=window,
        seeds=window,
        cross_blocks=cross[0],
        cross_layers=cross[1],
        self_blocks=self_blocks,
        position="rotary",
    )


EDSR_ENHANCED = ModelConfig(EDSRConfig(), enhanced(12, cross=(1, 2)))
RDN_ENHANCED = ModelConfig(RDNConfig(), enhanced(12, cross=(2, 2)))
SWINIR_ENHANCED = ModelConfig(SwinIRConfig(), enhanced(16, cross=(2, 4)))

PRESETS = {
    # The authors' models: the enhanced ones of their repository by encoder and training data, ...
    "edsr-div2k": EDSR_ENHANCED,
    "edsr-df2k": EDSR_ENHANCED,
    "rdn-div2k": RDN_ENHANCED,
    "rdn-df2k": RDN_ENHANCED,
    "swinir-div2k": SWINIR_ENHANCED,
    "swinir-df2k": SWINIR_ENHANCED,
    "hatl-sa1b": ModelConfig(HATConfig(), enhanced(16, cross=(4, 4), self_blocks=8)),
    # ... and those of the paper.
    "edsr-paper": ModelConfig(EDSRConfig()),
    "rdn-paper": ModelConfig(RDNConfig()),
    "swinir-paper": ModelConfig(SwinIRConfig()),
    # The paper's numbers: k = 12, m = 16, d = 180, L = 6.
    "edsr-baseline": ModelConfig(),
    # Ours: small enough for a CPU, and shipped trained.
    "lite": ModelConfig(
        EDSRConfig(channels=48, blocks=4),
        DecoderConfig(
            channels=32,
            heads=4,
            window=8,
            seeds=8,
            cross_layers=2,
            self_blocks=1,
            self_layers=2,
            shuffle=(2, 1),
            head_expansion=1,
        ),
    ),
}
