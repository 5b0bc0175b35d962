"""The rasterizer for CPUs, without OpenGL and without an index."""

from __future__ import annotations

import math

import moderngl
import numpy as np

from gsasr.gaussians import Gaussians
from gsasr.rasterize import footprint, render
from gsasr.view import View

from .contestant import Contestant, pixels_in_boxes


class Cpu(Contestant):
    """gsasr.render(..., backend="cpu"), at the quality of the screen."""

    name = "cpu"
    uses_gl = False

    def __init__(self, ctx: moderngl.Context, field: Gaussians) -> None:
        self._field = field
        self._image = None
        self.seconds = {}
        self.gaussians = sum(t.nbytes for t in field.tensors().values())
        self.index = 0
        limit = footprint.cut(field, "screen").clamp(min=0).sqrt()[:, None]
        self._reach = (field.std * limit).numpy()

    def draw(self, view: View) -> None:
        self._image = render(self._field, view, "cpu", "screen")

    def image(self) -> np.ndarray:
        return self._image.numpy()

    def evaluations(self, view: View) -> int:
        """Pixels within the ellipses: of those in their boxes, the share by area."""
        boxes = pixels_in_boxes(self._field.mean.numpy(), self._reach, view)
        return int((boxes * (math.pi / 4) * np.sqrt(1 - self._field.rho.numpy() ** 2)).sum())
