"""What the window knows: one document and a handful of settings. Changed on its thread only."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from gsasr.image import Picture

    from .store import TileStore

OVERLAYS = ("none", "centers", "ellipses")
SIGMA = (0.5, 4.0)  # least and greatest size of the drawn ellipses, standard deviations
CONDITION = (1.0, 4.0)  # scales that the networks are trained for
TOLD = 3.0  # the one told by default, as in gsasr.prediction, which would load PyTorch

LEAST_MEMORY = 1 << 24  # bytes of Gaussians that the user can let the GPU hold


@dataclass
class Document:
    """An open picture or field.

    pixels: (H, W, 4) uint8, RGBA, sRGB-encoded: the source as the screen shows it.
    picture: what was read from a picture file; None for a saved field.
    tiles: its Gaussians; None before the network is there.
    model, condition: what makes them.
    """

    path: Path
    pixels: np.ndarray
    picture: Picture | None = None
    tiles: TileStore | None = None
    model: str = ""
    condition: float = 0.0

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) of the source, pixels."""
        return self.pixels.shape[0], self.pixels.shape[1]

    @property
    def has_alpha(self) -> bool:
        """Does the picture have an alpha channel?"""
        return self.picture is not None and self.picture.alpha is not None

    @property
    def count(self) -> int:
        """How many Gaussians are held."""
        return 0 if self.tiles is None else self.tiles.count

    @property
    def complete(self) -> bool:
        """Are all Gaussians held?"""
        return self.tiles is not None and self.tiles.complete


@dataclass
class Message:
    """One sentence for the user; an error stays until it is closed, a note fades."""

    text: str
    error: bool
    seconds: float  # left to show


@dataclass
class State:
    """Settings and what is on screen."""

    model: str = "lite"
    condition: float = TOLD
    overlay: str = "none"
    sigma: float = 2.0
    gpu_memory: int = 0  # bytes of Gaussians that the GPU may hold
    document: Document | None = None
    message: Message | None = None
    cursor: tuple[float, float] | None = None  # canvas pixels, None when not over the canvas
    color: tuple[int, int, int] | None = None  # of the picture under the cursor, 8 bits
    frame_seconds: float = 0.0  # that the last drawing of the picture took
    dialogs: set[str] = field(default_factory=set)  # names of the open ones
