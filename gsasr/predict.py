"""A picture of any size -> Gaussians, tile by tile.

Shifted windows wrap around the edge of whatever the network is given, and convolutions see zeros
there, so a tile is predicted with a halo, at the picture's own edge as anywhere: there the picture
goes on as its reflection. Of the result a tile keeps the Gaussians whose reference position lies
in its core; cores partition the picture, so the union is one seamless field. Outer tiles also
keep those a little beyond the edge, which reach inside.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch

from .errors import Cancelled, RequestError
from .gaussians import Gaussians
from .memory import require_field
from .model import GSASR, activate

TILE = 192  # side of a core, source pixels, rounded to the network's multiple
HALO = 16  # rounded likewise; what a tile does not see beyond it changes no 8-bit level
BEYOND = 4  # source pixels past the picture's edge whose Gaussians still reach inside
SCALES = (0.1, 1000.0)  # conditioning scales that a network can be told


@dataclass(frozen=True)
class Tile:
    """A core [x0, x1) x [y0, y1) in source pixels; cores partition the padded picture."""

    x0: int
    y0: int
    x1: int
    y1: int


def plan(
    model: GSASR,
    size: tuple[int, int],
    tile: int = TILE,
    near: tuple[float, float] | None = None,
) -> list[Tile]:
    """Tiles of a picture (height, width), nearest to the source point `near` (x, y) first."""
    multiple = model.multiple
    step = max(multiple, tile // multiple * multiple)
    height, width = (_padded(side, multiple) for side in size)
    tiles = [
        Tile(x, y, min(x + step, width), min(y + step, height))
        for y in range(0, height, step)
        for x in range(0, width, step)
    ]
    if near is not None:
        tiles.sort(
            key=lambda t: ((t.x0 + t.x1) / 2 - near[0]) ** 2 + ((t.y0 + t.y1) / 2 - near[1]) ** 2
        )
    return tiles


@torch.inference_mode()
def predict_tile(model: GSASR, image: np.ndarray, tile: Tile, scale: float = 4.0) -> Gaussians:
    """Gaussians of one tile, positioned in the whole picture.

    image: (H, W, 3) float32 in [0, 1], sRGB. scale: conditioning scale, > 0.
    """
    height, width = image.shape[:2]
    multiple = model.multiple
    halo = _padded(HALO, multiple)
    x0, y0, x1, y1 = tile.x0 - halo, tile.y0 - halo, tile.x1 + halo, tile.y1 + halo
    crop = image[_reflected(y0, y1, height)][:, _reflected(x0, x1, width)]
    lr = torch.from_numpy(np.ascontiguousarray(crop, np.float32)).permute(2, 0, 1)[None]
    raw = model(lr, scale)[0]
    local = activate(raw, (y1 - y0, x1 - x0))
    per_pixel = model.config.decoder.seeds * int(np.prod(model.config.decoder.shuffle)) / multiple
    inside_x = _core(x0, x1, tile.x0, tile.x1, width, per_pixel)
    inside_y = _core(y0, y1, tile.y0, tile.y1, height, per_pixel)
    kept = local[(inside_y[:, None] & inside_x[None, :]).flatten()]
    return replace(
        kept,
        mean=kept.mean + kept.mean.new_tensor([x0, y0]),
        size=(height, width),
        model=model.name,
        scale=float(scale),
    )


def predict_tiles(
    model: GSASR,
    image: np.ndarray,
    scale: float = 4.0,
    tile: int = TILE,
    near: tuple[float, float] | None = None,
    cancelled: Callable[[], bool] = lambda: False,
) -> Iterator[tuple[Gaussians, float]]:
    """Yield (Gaussians of a tile, share of the picture done in (0, 1]), nearest tiles first.

    Memory is bounded by the tile. cancelled: asked before each tile; Cancelled is raised if true.
    """
    check(image, scale)
    tiles = plan(model, image.shape[:2], tile, near)
    for number, core in enumerate(tiles, start=1):
        if cancelled():
            raise Cancelled("Prediction was cancelled.")
        yield predict_tile(model, image, core, scale), number / len(tiles)


def predict(
    model: GSASR,
    image: np.ndarray,
    scale: float = 4.0,
    tile: int = TILE,
    progress: Callable[[float], None] = lambda share: None,
    cancelled: Callable[[], bool] = lambda: False,
) -> Gaussians:
    """All Gaussians of a picture.

    image: (H, W, 3) float32 in [0, 1], sRGB; any size from 1x1. scale: conditioning scale, > 0.
    progress: told the share done after each tile. Raises RequestError for other input.
    """
    require_field(round(image.shape[0] * image.shape[1] * model.config.decoder.gaussians_per_pixel))
    parts = []
    for part, share in predict_tiles(model, image, scale, tile, cancelled=cancelled):
        parts.append(part)
        progress(share)
    return Gaussians.concatenate(parts)


def check(image: np.ndarray, scale: float) -> None:
    """RequestError unless `image` and `scale` can be predicted from."""
    if image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise RequestError(f"The picture must have shape (H, W, 3), but has {image.shape}.")
    if not np.issubdtype(image.dtype, np.floating) or not np.isfinite(image).all():
        raise RequestError("The picture must hold finite floating-point numbers in [0, 1].")
    if not SCALES[0] <= scale <= SCALES[1]:
        raise RequestError(
            f"The conditioning scale must lie in {SCALES[0]:g}..{SCALES[1]:g}, but is {scale:g}."
        )


def _padded(length: int, multiple: int) -> int:
    return -(-length // multiple) * multiple


def _reflected(start: int, stop: int, length: int) -> np.ndarray:
    """Indices start..stop-1 folded into [0, length) by reflection without repeating the edge."""
    if length == 1:
        return np.zeros(stop - start, np.int64)
    index = np.arange(start, stop) % (2 * length - 2)
    return np.minimum(index, 2 * length - 2 - index)


def _core(
    start: int, stop: int, low: int, high: int, length: int, per_pixel: float
) -> torch.Tensor:
    """Mask over the fine-grid cells of [start, stop): those of the core [low, high).

    A core at an end of the picture [0, length) goes on beyond it.
    """
    low = -BEYOND if low == 0 else low
    high = length + BEYOND if high >= length else high
    cells = start + (torch.arange(round((stop - start) * per_pixel)) + 0.5) / per_pixel
    return (cells >= low) & (cells < high)
