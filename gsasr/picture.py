"""Gaussians to a finished picture, of a size chosen as people choose it."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
import torch
from PIL import Image

from . import rasterize
from .errors import Cancelled, RequestError
from .gaussians import Gaussians
from .memory import require_picture
from .model import GSASR
from .prediction import TILE, predict_tiles
from .rasterize import footprint
from .rasterize.antialias import integrated
from .rasterize.tiles import split_tiles
from .view import View

TRAINED_SCALES = (1.0, 4.0)  # target scales that the networks saw in training


def render(
    field: Gaussians,
    scale: float | None = None,
    size: tuple[int, int] | None = None,
    view: View | None = None,
    backend: str = "auto",
    antialias: bool = False,
    progress: Callable[[float], None] = lambda share: None,
    cancelled: Callable[[], bool] = lambda: False,
) -> np.ndarray:
    """(h, w, 3) float32 picture of a field, sRGB, not clamped, within 1e-4 of the exact sum.

    Exactly one of: scale (floor(scale * side) pixels), size (height, width) of the whole
    picture, or view. backend: see rasterize.render. antialias: integrate over each pixel instead
    of sampling at its centre, which aliases at small scales. progress: told the share done in
    (0, 1]. cancelled: asked now and then; Cancelled is raised if true. Raises RequestError,
    BackendError.
    """
    if sum(choice is not None for choice in (scale, size, view)) != 1:
        raise RequestError("Give exactly one of scale, size and view.")
    if scale is not None:
        view = View.at_scale(field.size, scale)
    elif size is not None:
        view = View.to_size(field.size, size)
    if backend == "auto":
        backend = "cuda" if field.mean.is_cuda else rasterize.default_backend()
    # The GPU draws all at once; elsewhere tile by tile, so that progress can be told.
    tiles = split_tiles(field) if backend == "cpu" else [field]
    parts = ((tile, number / len(tiles)) for number, tile in enumerate(tiles, start=1))
    return sum_of(parts, view, backend, antialias, progress, cancelled)


def upscale(
    model: GSASR,
    image: np.ndarray,
    view: View,
    condition: float | None = None,
    backend: str = "auto",
    tile: int = TILE,
    precision: str = "float32",
    antialias: bool = False,
    progress: Callable[[float], None] = lambda share: None,
    cancelled: Callable[[], bool] = lambda: False,
) -> np.ndarray:
    """(h, w, 3) float32 picture through `view`, without ever holding all Gaussians.

    Each tile is predicted, drawn and dropped; since a picture is a sum of Gaussians, it is also
    the sum of its tiles. image: (H, W, 3) float32 in [0, 1]. condition: the scale told to the
    network; by default the view's, within what networks are trained for. tile, precision: see
    predict. antialias: see render. progress: told the share done in (0, 1].
    """
    if condition is None:
        condition = conditioning_scale(max(view.scale))
    parts = predict_tiles(model, image, condition, tile, precision, cancelled=cancelled)
    return sum_of(parts, view, backend, antialias, progress, cancelled)


def sum_of(
    parts: Iterable[tuple[Gaussians, float]],
    view: View,
    backend: str,
    antialias: bool,
    progress: Callable[[float], None],
    cancelled: Callable[[], bool],
) -> np.ndarray:
    """(h, w, 3) float32: what parts of a field, each with the share done after it, add up to."""
    require_picture(view.size)
    picture = np.zeros((*view.size, 3), np.float32)
    for part, share in parts:
        if cancelled():
            raise Cancelled("Rendering was cancelled.")
        if antialias:
            part = integrated(part, view)
        rows, columns, window = _window(part, view)
        if window is not None:
            with torch.no_grad():
                drawn = rasterize.render(part, window, backend, "export")
            picture[rows, columns] += drawn.cpu().numpy()
        progress(share)
    return picture


def resample_alpha(alpha: np.ndarray, view: View) -> np.ndarray:
    """(H, W) float32 transparency seen through `view`, bicubic -> (h, w) in [0, 1].

    The network paints colour; transparency is upscaled on its own. Outside the picture it is 0.
    """
    height, width = alpha.shape
    x0, y0 = view.origin
    x1, y1 = view.to_source(view.size[1], view.size[0])
    # A whole picture's edge may be missed by a rounding error, which is not beyond it.
    left, top, right, bottom = (
        max(0, int(np.ceil(round(beyond, 6)))) for beyond in (-x0, -y0, x1 - width, y1 - height)
    )
    padded = Image.fromarray(np.pad(alpha, ((top, bottom), (left, right))).astype(np.float32))
    box = (
        max(0.0, x0 + left),
        max(0.0, y0 + top),
        min(x1 + left, padded.width),
        min(y1 + top, padded.height),
    )
    resized = padded.resize((view.size[1], view.size[0]), Image.Resampling.BICUBIC, box)
    return np.clip(np.asarray(resized), 0, 1)


def conditioning_scale(scale: float) -> float:
    """The nearest scale that networks are trained for."""
    return float(np.clip(scale, *TRAINED_SCALES))


def _window(part: Gaussians, view: View) -> tuple[slice, slice, View | None]:
    """The output pixels that `part` reaches, as slices and as a view of their own, or None."""
    x0, y0, x1, y1 = footprint.bounds(part, "export")
    left, top = view.to_output(x0, y0)
    right, bottom = view.to_output(x1, y1)
    columns = _clipped(left, right, view.size[1])
    rows = _clipped(top, bottom, view.size[0])
    if columns.start >= columns.stop or rows.start >= rows.stop:
        return rows, columns, None
    origin = view.to_source(columns.start, rows.start)
    size = (rows.stop - rows.start, columns.stop - columns.start)
    return rows, columns, View(origin, view.scale, size)


def _clipped(low: float, high: float, length: int) -> slice:
    return slice(int(np.clip(np.floor(low), 0, length)), int(np.clip(np.ceil(high), 0, length)))
