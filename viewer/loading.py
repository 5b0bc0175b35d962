"""From a file to Gaussians that can be drawn, on the worker's thread.

The network and its libraries take a second or two to import, so everything here that needs
them is imported when first used; the picture itself is on screen before that.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gsasr.errors import FieldError, ImageError
from gsasr.files import require_file

from .state import Document, Rectangle
from .worker import Task

MOST = 12_000_000  # Gaussians held of one document: about 1.7 GB on the GPU and 0.4 GB beside
BYTES = 190  # that one takes: 36 as tensors, and its records and lists

if TYPE_CHECKING:
    from gsasr.gaussians import Gaussians
    from gsasr.model import GSASR
    from gsasr.predict import Tile
    from gsasr.view import View

FIELD_SUFFIX = ".safetensors"
TILE = 192  # side of a tile, source pixels


class Loader:
    """Opens documents; keeps the last network in memory."""

    def __init__(self) -> None:
        self._model: GSASR | None = None
        self._model_name: tuple[str, float] | None = None

    def open(self, task: Task, path: Path) -> tuple[Document, list[tuple[Gaussians, Rectangle]]]:
        """The document in a file, and for a saved field its tiles as (Gaussians, rectangle).

        Raises ImageError or FieldError in one sentence.
        """
        if path.suffix.lower() == FIELD_SUFFIX:
            return self._open_field(task, path)
        from gsasr import image

        picture = image.read(path)
        return Document(path, to_rgba(picture.color, picture.alpha), picture), []

    def _open_field(
        self, task: Task, path: Path
    ) -> tuple[Document, list[tuple[Gaussians, Rectangle]]]:
        from gsasr import rasterize
        from gsasr.gaussians import Gaussians
        from gsasr.memory import require_picture
        from gsasr.view import View

        field = Gaussians.load(path)
        if min(field.size) < 1:
            raise FieldError(f"{path} is of an empty picture; predict the field anew.")
        require_picture(field.size)
        task.check()
        # What one sees below 1:1 is the field itself, rendered once at 1:1.
        color = rasterize.render(field, View.at_scale(field.size, 1.0), "cpu", "screen").numpy()
        document = Document(
            path, to_rgba(color, None), model=field.model or "saved field", condition=field.scale
        )
        return document, list(split(field))

    def predict(
        self,
        task: Task,
        document: Document,
        model_name: str,
        condition: float,
        near: Callable[[], tuple[float, float]],
        within: tuple[float, float, float, float] | None = None,
    ) -> Iterator[tuple[Gaussians, Rectangle]]:
        """Gaussians tile by tile with the rectangle each completes, nearest to `near()` first.

        within: (x0, y0, x1, y1); only the tiles that meet it. Of a picture too large to hold all,
        the nearest: document.partial is then set. Raises Cancelled, CheckpointError.
        """
        task.progress(None, "Loading the network")
        model = self._load(model_name)
        task.check()
        from gsasr.predict import check, plan, predict_tile

        image = document.picture.color
        check(image, condition)
        document.model, document.condition, document.partial = model.name, condition, False
        most, total_count = _affordable(), 0
        title = f"Predicting {document.path.name}"
        task.progress(0.0, title)
        waiting = [tile for tile in plan(model, document.size, TILE) if _meets(tile, within)]
        total = len(waiting)
        while waiting:
            task.check()
            x, y = near()
            tile = min(
                waiting,
                key=lambda t: ((t.x0 + t.x1) / 2 - x) ** 2 + ((t.y0 + t.y1) / 2 - y) ** 2,
            )
            waiting.remove(tile)
            part = predict_tile(model, image, tile, condition)
            task.progress(1 - len(waiting) / total)
            yield part, (tile.x0, tile.y0, tile.x1, tile.y1)
            total_count += len(part)
            if total_count + len(part) > most and waiting:
                document.partial = True
                return

    def upscale(
        self,
        task: Task,
        document: Document,
        model_name: str,
        condition: float,
        view: View,
        antialias: bool,
    ) -> np.ndarray:
        """(h, w, 3) float32: a picture through a view, without holding its Gaussians."""
        model = self._load(model_name)
        from gsasr.picture import upscale

        image = document.picture.color
        return upscale(
            model,
            image,
            view,
            condition,
            backend="cpu",
            antialias=antialias,
            progress=task.progress,
            cancelled=task.cancelled,
        )

    def _load(self, name: str) -> GSASR:
        import torch

        import gsasr

        # One core is left to the window, which may be drawing without a GPU.
        torch.set_num_threads(max(1, (os.cpu_count() or 2) - 1))
        changed = os.path.getmtime(name) if os.path.isfile(name) else 0.0
        if self._model is None or self._model_name != (name, changed):
            self._model = gsasr.load_model(name)
            self._model_name = (name, changed)
        return self._model


def _affordable() -> int:
    """How many Gaussians of a document to hold at once."""
    from gsasr.memory import available

    return int(min(MOST, available() / 3 / BYTES))


def _meets(tile: Tile, within: tuple[float, float, float, float] | None) -> bool:
    if within is None:
        return True
    x0, y0, x1, y1 = within
    return tile.x0 < x1 and x0 < tile.x1 and tile.y0 < y1 and y0 < tile.y1


def to_rgba(color: np.ndarray, alpha: np.ndarray | None) -> np.ndarray:
    """(H, W, 3) and (H, W) float32 in [0, 1] to (H, W, 4) uint8."""
    pixels = np.full((*color.shape[:2], 4), 255, np.uint8)
    for band in range(0, color.shape[0], 256):  # no second float copy of a large picture
        rows = slice(band, band + 256)
        pixels[rows, :, :3] = np.rint(np.clip(color[rows], 0, 1) * 255)
        if alpha is not None:
            pixels[rows, :, 3] = np.rint(alpha[rows] * 255)
    return pixels


def split(field: Gaussians) -> Iterator[tuple[Gaussians, Rectangle]]:
    """A field as tiles of its source picture, so that no tile outgrows a buffer of the GPU."""
    height, width = field.size
    columns, rows = -(-width // TILE), -(-height // TILE)
    column = (field.mean[:, 0] // TILE).long().clamp(0, columns - 1)
    row = (field.mean[:, 1] // TILE).long().clamp(0, rows - 1)
    order = (row * columns + column).argsort(stable=True)
    counts = (row * columns + column).bincount(minlength=rows * columns).tolist()
    start = 0
    for number, count in enumerate(counts):
        x0, y0 = number % columns * TILE, number // columns * TILE
        yield field[order[start : start + count]], (x0, y0, x0 + TILE, y0 + TILE)
        start += count


def check_path(path: Path) -> None:
    """Raise at once for what `open` would refuse later: no such file, a folder."""
    require_file(path, FieldError if path.suffix.lower() == FIELD_SUFFIX else ImageError)
