"""A picture of any size -> Gaussians, tile by tile.

Shifted windows wrap around the edge of whatever the network is given, and convolutions see zeros
there, so a tile is predicted with a halo, at the picture's own edge as anywhere: there the picture
goes on as its reflection. Of the result a tile keeps the Gaussians whose reference position lies
in its core; cores partition the picture, so the union is one seamless field. Outer tiles also
keep those a little beyond the edge, which reach inside.
"""

from __future__ import annotations

import warnings
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch

from .errors import Cancelled, RequestError
from .gaussians import Gaussians
from .memory import out_of_memory, require_field
from .model import GSASR, activate
from .processor import PRECISIONS

TILE = 256  # side of a core, source pixels, rounded to the network's multiple
HALO = 16  # rounded likewise; what a tile does not see beyond it changes no 8-bit level
BEYOND = 4  # source pixels past the picture's edge whose Gaussians still reach inside
TOLD = 3.0  # conditioning scale by default: what it costs is in docs/prediction.md
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
    height, width = (_padded(side, multiple) for side in size)
    tiles = _cut(Tile(0, 0, width, height), max(multiple, tile // multiple * multiple))
    if near is not None:
        tiles.sort(
            key=lambda t: ((t.x0 + t.x1) / 2 - near[0]) ** 2 + ((t.y0 + t.y1) / 2 - near[1]) ** 2
        )
    return tiles


def _cut(area: Tile, step: int) -> list[Tile]:
    """The area in tiles of `step` source pixels, those at its right and bottom smaller."""
    return [
        Tile(x, y, min(x + step, area.x1), min(y + step, area.y1))
        for y in range(area.y0, area.y1, step)
        for x in range(area.x0, area.x1, step)
    ]


@torch.inference_mode()
def predict_tile(
    model: GSASR, image: np.ndarray, tile: Tile, scale: float = TOLD, precision: str = "float32"
) -> Gaussians:
    """Gaussians of one tile, positioned in the whole picture, on the model's device.

    image: (H, W, 3) float32 in [0, 1], sRGB. scale: conditioning scale, > 0. precision: of the
    network, "float32" or "bfloat16" (autocast).
    """
    height, width = image.shape[:2]
    multiple = model.multiple
    halo = _padded(HALO, multiple)
    x0, y0, x1, y1 = tile.x0 - halo, tile.y0 - halo, tile.x1 + halo, tile.y1 + halo
    crop = image[_reflected(y0, y1, height)][:, _reflected(x0, x1, width)]
    lr = torch.from_numpy(np.ascontiguousarray(crop, np.float32)).permute(2, 0, 1)[None]
    with torch.inference_mode(False):  # weights moved in inference mode could not be trained again
        model.to(memory_format=torch.channels_last)  # as `lr` is: what convolutions prefer
    device = next(model.parameters()).device
    with torch.autocast(device.type, torch.bfloat16, enabled=precision == "bfloat16"):
        raw = model(lr.to(device), scale)[0]
    per_pixel = model.config.decoder.gaussians_per_pixel**0.5  # along a side
    inside_x = _core(x0, x1, tile.x0, tile.x1, width, per_pixel)
    inside_y = _core(y0, y1, tile.y0, tile.y1, height, per_pixel)
    inside = (inside_y[:, None] & inside_x[None, :]).flatten().to(device)
    kept = activate(raw.float()[inside], (y1 - y0, x1 - x0))
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
    scale: float = TOLD,
    tile: int = TILE,
    precision: str = "float32",
    near: tuple[float, float] | None = None,
    cancelled: Callable[[], bool] = lambda: False,
) -> Iterator[tuple[Gaussians, float]]:
    """Yield (Gaussians of a tile, share of the picture done in (0, 1]), nearest tiles first.

    Memory is bounded by the tile; where there is too little, tiles are halved, then a card is
    given up for the CPU, with one warning each. cancelled: asked before each tile; Cancelled is
    raised if true.
    """
    check(image, scale, precision)
    pending = deque(plan(model, image.shape[:2], tile, near))
    total = sum(_area(core) for core in pending)
    done = 0
    while pending:
        if cancelled():
            raise Cancelled("Prediction was cancelled.")
        core = pending.popleft()
        try:
            part = predict_tile(model, image, core, scale, precision)
        except (MemoryError, RuntimeError) as error:
            if not out_of_memory(error):
                raise
            pending.appendleft(core)
            pending = _easier(model, pending)
            continue
        done += _area(core)
        yield part, done / total


def _area(tile: Tile) -> int:
    return (tile.x1 - tile.x0) * (tile.y1 - tile.y0)


def _easier(model: GSASR, pending: deque[Tile]) -> deque[Tile]:
    """The same tiles at half their size, or, where they are small, with the model on the CPU.

    Raises RequestError if it is there already.
    """
    side = max(pending[0].x1 - pending[0].x0, pending[0].y1 - pending[0].y0)
    half = side // 2 // model.multiple * model.multiple
    on_card = next(model.parameters()).is_cuda
    if on_card:
        torch.cuda.empty_cache()
    if half >= max(model.multiple, HALO):
        warnings.warn(f"Out of memory: going on with tiles of {half} pixels.", stacklevel=3)
        return deque(piece for tile in pending for piece in _cut(tile, half))
    if not on_card:
        raise RequestError("There is too little memory for this network; close other programs.")
    warnings.warn("Out of GPU memory: going on with the CPU.", stacklevel=3)
    model.to("cpu")
    return pending


def predict(
    model: GSASR,
    image: np.ndarray,
    scale: float = TOLD,
    tile: int = TILE,
    precision: str = "float32",
    progress: Callable[[float], None] = lambda share: None,
    cancelled: Callable[[], bool] = lambda: False,
) -> Gaussians:
    """All Gaussians of a picture, on the model's device.

    image: (H, W, 3) float32 in [0, 1], sRGB; any size from 1x1. scale: conditioning scale, > 0.
    tile: side of a tile, source pixels; bounds the memory. precision: of the network, "float32"
    or "bfloat16". progress: told the share done after each tile. Raises RequestError for other
    input.
    """
    require_field(round(image.shape[0] * image.shape[1] * model.config.decoder.gaussians_per_pixel))
    parts = []
    for part, share in predict_tiles(model, image, scale, tile, precision, cancelled=cancelled):
        parts.append(part)
        progress(share)
    device = parts[-1].mean.device  # the CPU, if memory ran out on a card
    return Gaussians.concatenate([part.map(lambda tensor: tensor.to(device)) for part in parts])


def check(image: np.ndarray, scale: float, precision: str = "float32") -> None:
    """RequestError unless `image` can be predicted from, at this scale and precision."""
    if image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise RequestError(f"The picture must have shape (H, W, 3), but has {image.shape}.")
    if not np.issubdtype(image.dtype, np.floating) or not np.isfinite(image).all():
        raise RequestError("The picture must hold finite floating-point numbers in [0, 1].")
    if not SCALES[0] <= scale <= SCALES[1]:
        raise RequestError(
            f"The conditioning scale must lie in {SCALES[0]:g}..{SCALES[1]:g}, but is {scale:g}."
        )
    if precision not in PRECISIONS:
        raise RequestError(f"Unknown precision {precision!r}; use {' or '.join(PRECISIONS)}.")


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
