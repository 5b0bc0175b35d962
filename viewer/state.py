"""What the window knows: one document and a handful of settings. Changed on its thread only."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from gsasr.gaussians import Gaussians
    from gsasr.image import Picture

OVERLAYS = ("none", "centers", "ellipses")
SIGMA = (0.5, 4.0)  # least and greatest size of the drawn ellipses, standard deviations
CONDITION = (1.0, 4.0)  # scales that the networks are trained for
TOLD = 3.0  # the one told by default, as in gsasr.predict, which would load PyTorch

Rectangle = tuple[int, int, int, int]  # x0, y0, x1, y1 in source pixels


@dataclass
class Document:
    """An open picture or field.

    pixels: (H, W, 4) uint8, RGBA, sRGB-encoded: the source as the screen shows it.
    picture: what was read from a picture file; None for a saved field.
    parts: the Gaussians that have arrived, one item per tile.
    complete: whether all have arrived; partial: whether there are too many to hold, so that
        only those around the view have.
    model, condition: what made them.
    """

    path: Path
    pixels: np.ndarray
    picture: Picture | None = None
    parts: list[Gaussians] = field(default_factory=list)
    complete: bool = False
    partial: bool = False
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
        """How many Gaussians have arrived."""
        return sum(len(part) for part in self.parts)


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
    document: Document | None = None
    message: Message | None = None
    cursor: tuple[float, float] | None = None  # canvas pixels, None when not over the canvas
    color: tuple[int, int, int] | None = None  # of the picture under the cursor, 8 bits
    frame_seconds: float = 0.0  # that the last drawing of the picture took
    dialogs: set[str] = field(default_factory=set)  # names of the open ones
