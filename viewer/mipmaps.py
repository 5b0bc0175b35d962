"""A picture in ever smaller sizes, for views below 1:1; made on a worker."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from PIL import Image


@dataclass(frozen=True)
class Mipmaps:
    """levels: (ceil(H / 2^n), ceil(W / 2^n), 4) uint8 RGBA for n = 0, 1, ..., down to one pixel.

    A pixel of level n is the mean of 2x2 of the level before, fewer at the right and bottom edge;
    it stands for 2^n x 2^n source pixels. has_alpha: whether any pixel is transparent.
    """

    levels: list[np.ndarray]
    has_alpha: bool


def mipmaps(pixels: np.ndarray) -> Mipmaps:
    """pixels: (H, W, 4) uint8 RGBA, not premultiplied; it becomes the first level, uncopied."""
    levels = [np.ascontiguousarray(pixels)]
    while max(levels[-1].shape[:2]) > 1:
        height, width = levels[-1].shape[:2]
        # RGBX: four channels alike; as RGBA, Pillow would blacken what is transparent.
        image = Image.frombuffer("RGBX", (width, height), levels[-1], "raw", "RGBX", 0, 1)
        levels.append(np.asarray(image.reduce((min(width, 2), min(height, 2)))))
    return Mipmaps(levels, bool((pixels[..., 3] < 255).any()))
