"""Bicubic downscaling as MATLAB's `imresize` does it, which the benchmarks' pictures come from.

The cubic kernel has a = -0.5. When a picture shrinks, the kernel is widened by the factor (which
is its antialiasing), the weights of each output pixel are normalised to add up to 1, and pixels
beyond the edge repeat the last one. Like MATLAB's older versions this works on 8-bit levels: down
the columns first, rounded to 8 bits, then along the rows, rounded again, halves up. With that the
LR pictures of Set5 and Set14 in circulation come out equal to the bit.

Training crops are made by PyTorch's antialiased bicubic instead (`training.data.downscale`): the
same kernel without the rounding between and with the weights cut off at the edge, in a
quarter of the time. The two differ by less than 0.2 levels on average.
"""

from __future__ import annotations

import numpy as np


def downscale(picture: np.ndarray, factor: int) -> np.ndarray:
    """(H, W, C) uint8 -> (H // factor, W // factor, C) uint8.

    Rows and columns beyond a multiple of the factor, at the bottom and the right, are not seen.
    """
    height, width = (side // factor for side in picture.shape[:2])
    picture = picture[: height * factor, : width * factor]
    return _along(_along(picture, factor, 0), factor, 1)


def _along(picture: np.ndarray, factor: int, axis: int) -> np.ndarray:
    """`picture` with one axis shortened to length / factor, in 8-bit levels."""
    lines = np.moveaxis(picture, axis, 0)
    length = lines.shape[0]
    # Output pixel i lies over the source coordinate (i + 0.5) * factor; all have equal taps.
    first = np.floor(0.5 * factor - 0.5 - 2 * factor).astype(int) + 1
    taps = np.arange(first, first + 4 * factor)
    weights = _cubic((taps + 0.5) / factor - 0.5)
    weights /= weights.sum()
    result = np.zeros((length // factor, *lines.shape[1:]))
    starts = np.arange(length // factor) * factor
    for tap, weight in zip(taps, weights, strict=True):
        result += weight * lines[np.clip(starts + tap, 0, length - 1)]
    rounded = np.floor(np.clip(result, 0, 255) + 0.5).astype(np.uint8)
    return np.ascontiguousarray(np.moveaxis(rounded, 0, axis))


def _cubic(x: np.ndarray) -> np.ndarray:
    """Keys' kernel with a = -0.5: 1 at 0, 0 at the other integers and beyond 2."""
    x = np.abs(x)
    near = 1.5 * x**3 - 2.5 * x**2 + 1
    far = -0.5 * x**3 + 2.5 * x**2 - 4 * x + 2
    return np.where(x <= 1, near, np.where(x < 2, far, 0.0))
