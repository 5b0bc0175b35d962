"""The paper's Algorithm 1: every Gaussian walks all pixels and skips those outside its box."""

from __future__ import annotations

import math
from ctypes import c_float, c_int
from pathlib import Path

import moderngl
import numba
import numpy as np
import torch

from gsasr.gaussians import Gaussians
from gsasr.rasterize import cuda, nvrtc
from gsasr.view import View

from .contestant import Contestant, pixels_in_boxes

R = 0.1  # the paper's rasterization ratio: sides of a box by those of the picture
MOST = 2e8  # visits of pixels in a frame; where there are more, a part of the Gaussians is drawn
ON_CARD = 100  # times as many on a card


class Paper(Contestant):
    """On the card if PyTorch has one, else by one core."""

    name = "paper"
    uses_gl = False

    def __init__(self, ctx: moderngl.Context, field: Gaussians) -> None:
        self._field = field
        self._image = None
        self._most = MOST * (ON_CARD if torch.cuda.is_available() else 1)
        self.seconds = {}
        self.gaussians = sum(t.nbytes for t in field.tensors().values())
        self.index = 0

    def draw(self, view: View) -> None:
        some = sample(self._field, view, self._most)
        if torch.cuda.is_available():
            card = OnCard(some, view)
            card.forward()
            torch.cuda.synchronize()
            self._image = card.pixels
        else:
            self._image = torch.from_numpy(on_host(some, view))

    def image(self) -> np.ndarray:
        return self._image.cpu().numpy()

    def evaluations(self, view: View) -> int:
        """Pixels within the boxes."""
        half = np.array(box(self._field, view)) / view.scale
        mean = self._field.mean.numpy()
        return int(pixels_in_boxes(mean, np.broadcast_to(half, mean.shape), view).sum())

    def share(self, view: View) -> float:
        return len(sample(self._field, view, self._most)) / len(self._field)


def sample(field: Gaussians, view: View, most: float) -> Gaussians:
    """As many Gaussians, from all over the picture, as visit at most `most` pixels of a view."""
    count = max(1, min(len(field), int(most / math.prod(view.size))))
    return field if count == len(field) else field[torch.linspace(0, len(field) - 1, count).long()]


def box(field: Gaussians, view: View) -> tuple[float, float]:
    """Half the sides of the box beyond which a Gaussian is not drawn, output pixels."""
    width, height = (s * length for s, length in zip(view.scale, field.size[::-1], strict=True))
    return R * (width - 1) / 2, R * (height - 1) / 2


def on_host(field: Gaussians, view: View) -> np.ndarray:
    """(h, w, 3) float32. The scale must be the same along both axes."""
    pixels = np.zeros((*view.size, 3), np.float32)
    std, rho, peak = (t.numpy() for t in (field.std, field.rho, field.peak))
    _paper(_seen(field, view).numpy(), std, rho, peak, view.scale[0], *box(field, view), pixels)
    return pixels


class OnCard:
    """The same in CUDA (paper.cu), forward and backward, with what it needs already there.

    pixels: (h, w, 3), what `forward` has drawn.
    """

    def __init__(self, field: Gaussians, view: View) -> None:
        device = torch.device("cuda", torch.cuda.current_device())
        major, minor = torch.cuda.get_device_capability(device)
        binary = nvrtc.compiled(10 * major + minor, Path(__file__).with_name("paper.cu"))
        self._launch = cuda.module(binary, device)
        tensors = _seen(field, view), field.std, field.rho, field.peak
        height, width = view.size
        self._count = len(field)
        self._shared = (
            *(t.to(device).contiguous() for t in tensors),
            c_float(view.scale[0]), *map(c_float, box(field, view)), c_int(width), c_int(height),
        )  # fmt: skip
        self.pixels = torch.zeros(height, width, 3, device=device)
        self._grads = torch.zeros(self._count, 8, device=device)

    def forward(self) -> None:
        pixels = self.pixels.zero_()
        self._launch("paper_forward", self._count, self._count, *self._shared, pixels)

    def both(self) -> None:
        """Forward, and backward from the picture itself."""
        self.forward()
        arguments = *self._shared, self.pixels, self._grads
        self._launch("paper_backward", self._count, self._count, *arguments)


def _seen(field: Gaussians, view: View) -> torch.Tensor:
    """Means from the view's origin: the paper draws whole pictures only."""
    return (field.mean.double() - torch.tensor(view.origin, dtype=torch.float64)).float()


@numba.njit(fastmath=True)
def _paper(mean, std, rho, peak, scale, box_x, box_y, pixels):
    for n in range(mean.shape[0]):
        center_x, center_y = mean[n, 0] * scale - 0.5, mean[n, 1] * scale - 0.5
        for y in range(pixels.shape[0]):
            for x in range(pixels.shape[1]):
                dx, dy = x - center_x, y - center_y
                if abs(dx) > box_x or abs(dy) > box_y:
                    continue
                u, v = dx / (std[n, 0] * scale), dy / (std[n, 1] * scale)
                q = (u * u - 2 * rho[n] * u * v + v * v) / (1 - rho[n] * rho[n])
                weight = math.exp(-0.5 * q)
                for channel in range(3):
                    pixels[y, x, channel] += weight * peak[n, channel]
