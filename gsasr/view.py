"""View: the one map between source pixels and output pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass

from .errors import RequestError

MAX_SIDE = 2**31 - 1  # of the output, pixels


def output_length(length: int, scale: float) -> int:
    """floor(scale * length), safe against products such as 2.3 * 10 = 22.999999999999996."""
    return math.floor(round(min(scale * length, MAX_SIDE + 1.0), 6))


@dataclass(frozen=True)
class View:
    """A rectangular grid of samples of the continuous picture.

    Output pixel (column i, row j) samples the source at
    ``x = origin[0] + (i + 0.5) / scale[0]``, ``y = origin[1] + (j + 0.5) / scale[1]``.
    Full image, region and screen are the same thing with other numbers.

    origin: (x, y) of the output's top left corner, source pixels; the centre of the first
        source pixel is (0.5, 0.5), so (0, 0) is the picture's corner. May lie outside it.
    scale: output pixels per source pixel along (x, y), both > 0.
    size: (height, width) of the output, pixels, both >= 0.
    """

    origin: tuple[float, float]
    scale: tuple[float, float]
    size: tuple[int, int]

    def __post_init__(self) -> None:
        if not all(math.isfinite(v) for v in (*self.origin, *self.scale)):
            raise RequestError("The view must be finite; check the scale and the region.")
        if min(self.scale) <= 0:
            raise RequestError(f"The scale must be above 0, but is {min(self.scale):g}.")
        if min(self.size) < 0:
            raise RequestError(f"The output size must not be negative, but is {self.size}.")
        if max(self.size) > MAX_SIDE:
            raise RequestError(f"No side may exceed {MAX_SIDE} pixels; use a smaller scale.")

    @staticmethod
    def at_scale(image_size: tuple[int, int], scale: float) -> View:
        """The whole image (height, width) at one scale; floor(scale * side) output pixels."""
        return View.region_at_scale(_whole(image_size), scale)

    @staticmethod
    def to_size(image_size: tuple[int, int], size: tuple[int, int]) -> View:
        """The whole image (height, width) rendered to exactly `size` (height, width)."""
        return View.region_to_size(_whole(image_size), size)

    @staticmethod
    def region_at_scale(region: tuple[float, float, float, float], scale: float) -> View:
        """A region (x, y, width, height) in source pixels at one scale; sides are floored.

        Raises RequestError for a scale that is not positive and finite, or that leaves no pixel.
        """
        x, y, width, height = _checked(region)
        if not math.isfinite(scale) or scale <= 0:
            raise RequestError(f"The scale must be a number above 0, but is {scale:g}.")
        size = output_length(height, scale), output_length(width, scale)
        if min(size) < 1:
            raise RequestError(
                f"Scale {scale:g} leaves no pixel of {width:g}x{height:g}; "
                f"use at least {1 / min(width, height):g}."
            )
        return View((x, y), (scale, scale), size)

    @staticmethod
    def region_to_size(region: tuple[float, float, float, float], size: tuple[int, int]) -> View:
        """A region (x, y, width, height) in source pixels, rendered to `size` (height, width)."""
        x, y, width, height = _checked(region)
        if min(size) < 1:
            raise RequestError(f"The output size must be at least 1x1, but is {size[1]}x{size[0]}.")
        return View((x, y), (size[1] / width, size[0] / height), size)

    def to_source(self, x: float, y: float) -> tuple[float, float]:
        """Output coordinates (pixel edges at integers) to source pixels."""
        return self.origin[0] + x / self.scale[0], self.origin[1] + y / self.scale[1]

    def to_output(self, x: float, y: float) -> tuple[float, float]:
        """Source pixels to output coordinates (pixel edges at integers)."""
        return (x - self.origin[0]) * self.scale[0], (y - self.origin[1]) * self.scale[1]

    def rows(self, start: int, stop: int) -> View:
        """The band of output rows [start, stop) as a view of its own: same samples."""
        origin = (self.origin[0], self.origin[1] + start / self.scale[1])
        return View(origin, self.scale, (stop - start, self.size[1]))


def _whole(image_size: tuple[int, int]) -> tuple[float, float, float, float]:
    return 0.0, 0.0, float(image_size[1]), float(image_size[0])


def _checked(
    region: tuple[float, float, float, float],
) -> tuple[float, float, float, float]:
    if not all(math.isfinite(v) for v in region) or min(region[2:]) <= 0:
        raise RequestError("The region must be X,Y,W,H with W and H above 0.")
    return region
