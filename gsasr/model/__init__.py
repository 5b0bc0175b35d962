"""The network: picture -> raw Gaussians."""

from .checkpoint import load_model, save_model
from .network import GSASR, ModelConfig, activate
from .presets import PRESETS

__all__ = ["GSASR", "PRESETS", "ModelConfig", "activate", "load_model", "save_model"]
