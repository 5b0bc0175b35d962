"""Networks of every family that run in milliseconds, in sizes that no released one has."""

from gsasr.model import ModelConfig
from gsasr.model.decoder import DecoderConfig
from gsasr.model.encoders import EDSRConfig, HATConfig, RDNConfig, SwinIRConfig

# Seeds finer and coarser than the pixels of a window; several blocks; unequal shuffles.
PAPER = DecoderConfig(8, 2, 4, 8, 2, 1, 1, 2, shuffle=(1, 2), head_expansion=2)
COARSE = DecoderConfig(8, 2, 6, 3, 1, 2, 1, 2, shuffle=(2, 2), head_expansion=1)
ENHANCED = DecoderConfig(8, 2, 8, 4, 1, 2, 1, 3, shuffle=(2, 2), position="rotary")

SWINIR = SwinIRConfig(12, (1, 2), (2, 3), window=4, hidden=20, channels=10, picture=12)
HAT = HATConfig(
    8, (2, 1), (2, 1), window=4, reach=6, hidden=12, compressed=3, squeezed=5, channels=9
)

TINY = {
    "EDSR paper": ModelConfig(EDSRConfig(8, 1), PAPER),
    "EDSR enhanced": ModelConfig(EDSRConfig(8, 1), ENHANCED),
    "RDN paper": ModelConfig(RDNConfig(6, 4, 3, 2), COARSE),
    "RDN enhanced": ModelConfig(RDNConfig(6, 4, 3, 2), ENHANCED),
    "SwinIR paper": ModelConfig(SWINIR, COARSE),
    "SwinIR enhanced": ModelConfig(SWINIR, ENHANCED),
    "HAT paper": ModelConfig(HAT, PAPER),
    "HAT enhanced": ModelConfig(HAT, ENHANCED),
}
