"""Picture -> features, one file per family."""

from __future__ import annotations

from torch import nn

from ..state import State
from .edsr import EDSR, EDSRConfig
from .hat import HAT, HATConfig
from .rdn import RDN, RDNConfig
from .swinir import SwinIR, SwinIRConfig

EncoderConfig = EDSRConfig | RDNConfig | SwinIRConfig | HATConfig

ENCODERS: dict[str, type[nn.Module]] = {"EDSR": EDSR, "RDN": RDN, "HAT": HAT, "SwinIR": SwinIR}
"""By their configuration's `family`. A state dict is of the first whose SIGN is in a key of it."""


def family_of(state: State) -> str:
    """The family that these keys belong to. Raises KeyError for none."""
    for family, encoder in ENCODERS.items():
        if any(encoder.SIGN in key for key in state):
            return family
    raise KeyError("encoder")


__all__ = [
    "EDSR",
    "ENCODERS",
    "HAT",
    "RDN",
    "EDSRConfig",
    "EncoderConfig",
    "HATConfig",
    "RDNConfig",
    "SwinIR",
    "SwinIRConfig",
    "family_of",
]
