"""Writing a picture file: which pixels, and the work of making them."""

from __future__ import annotations

import math
from pathlib import Path

from gsasr.errors import RequestError
from gsasr.view import View, output_length

from .state import Document
from .worker import Task

BEYOND = 3  # output pixels by which antialiasing lets a Gaussian reach further, at most


def region_of(view: View, size: tuple[int, int]) -> View:
    """The part of a canvas view that lies on the picture (height, width), pixel for pixel.

    Raises RequestError if there is none.
    """
    left, top = (max(0, math.ceil(round(v, 6))) for v in view.to_output(0, 0))
    right, bottom = view.to_output(size[1], size[0])
    right = min(view.size[1], math.floor(round(right, 6)))
    bottom = min(view.size[0], math.floor(round(bottom, 6)))
    if left >= right or top >= bottom:
        raise RequestError("The view shows nothing of the picture; move it back.")
    return View(view.to_source(left, top), view.scale, (bottom - top, right - left))


def at_scale(region: View, scale: float) -> View:
    """The source rectangle that `region` shows, at another scale."""
    if not math.isfinite(scale) or scale <= 0:
        raise RequestError(f"The scale must be a number above 0, but is {scale:g}.")
    if region.scale == (scale, scale):
        return region
    height, width = (
        max(1, output_length(side, scale / old))
        for side, old in zip(region.size, region.scale[::-1], strict=True)
    )
    return View(region.origin, (scale, scale), (height, width))


def to_size(region: View, size: tuple[int, int]) -> View:
    """The source rectangle that `region` shows, at exactly `size` (height, width)."""
    height, width = (
        side / scale for side, scale in zip(region.size, region.scale[::-1], strict=True)
    )
    return View.region_to_size((*region.origin, width, height), size)


def export(
    task: Task,
    document: Document,
    view: View,
    path: Path,
    antialias: bool,
) -> None:
    """Render the Gaussians through a view, exactly, and write them to a picture file.

    antialias: integrate over each pixel (see gsasr.render).

    Those of the tiles that are not in memory are predicted, and not kept.
    The source's alpha, gray, depth and colour profile are kept where the format holds them.
    Raises GsasrError; a cancelled or failed export leaves no file.
    """
    from gsasr import image
    from gsasr.memory import require_picture
    from gsasr.picture import sum_of

    image.check_output(path, view.size, document.has_alpha)
    require_picture(view.size)
    task.progress(0.0)
    height, width = view.size
    wider = View(
        view.to_source(-BEYOND, -BEYOND), view.scale, (height + 2 * BEYOND, width + 2 * BEYOND)
    )
    visible = document.tiles.visible(wider)
    parts = (
        (document.tiles.gaussians(index), number / len(visible))
        for number, index in enumerate(visible, start=1)
    )
    color = sum_of(parts, view, "cpu", antialias, task.progress, task.cancelled)
    alpha = None
    if document.has_alpha:
        from gsasr.picture import resample_alpha

        alpha = resample_alpha(document.picture.alpha, view)
    task.check()
    task.progress(None, f"Writing {path.name}")
    image.write(path, color, like=document.picture, alpha=alpha)
