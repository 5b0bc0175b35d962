"""Picture -> features, one file per family."""

from .edsr import EDSR, EDSRConfig

__all__ = ["EDSR", "EDSRConfig"]
