"""Several pictures in one launch: whose Gaussians and whose pixels are where."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from ..view import View


@dataclass(frozen=True)
class Picture:
    """One picture of a batch.

    gaussians: its Gaussians among those of all pictures. pixels: its rows of the (P, 3) output.
    """

    view: View
    gaussians: slice
    pixels: slice


def views_tensor(views: list[View]) -> torch.Tensor:
    """(B, 4) float64 on the CPU: origin x, y and scale x, y of each view."""
    return torch.tensor([(*v.origin, *v.scale) for v in views], dtype=torch.float64).view(-1, 4)


def pictures(
    views: torch.Tensor, counts: list[int], heights: list[int], widths: list[int]
) -> list[Picture]:
    """The pictures whose Gaussians and pixels follow one another in this order.

    views: from `views_tensor`. counts: Gaussians of each. heights, widths: output pixels.
    """
    found, gaussian, pixel = [], 0, 0
    for (ox, oy, sx, sy), n, h, w in zip(views.tolist(), counts, heights, widths, strict=True):
        view = View((ox, oy), (sx, sy), (h, w))
        found.append(Picture(view, slice(gaussian, gaussian + n), slice(pixel, pixel + h * w)))
        gaussian, pixel = gaussian + n, pixel + h * w
    return found
