"""Training a network on a folder of pictures."""

from .config import PRESETS, TrainConfig
from .loop import train

__all__ = ["PRESETS", "TrainConfig", "train"]
