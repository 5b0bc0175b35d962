"""From a file to a document and the tiles of its Gaussians, on the worker's thread.

The network and its libraries take a second or two to import, so everything here that needs
them is imported when first used; the picture itself is on screen before that.
"""

from __future__ import annotations

import ctypes
import importlib.util
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gsasr.errors import FieldError, ImageError
from gsasr.files import require_file

from .coverage import Rectangle
from .state import Document
from .store import TileStore
from .worker import Task

if TYPE_CHECKING:
    from gsasr.gaussians import Gaussians
    from gsasr.model import GSASR

FIELD_SUFFIX = ".safetensors"
TILE = 192  # side of a tile, source pixels


class Loader:
    """Opens documents; keeps the last network in memory."""

    def __init__(self) -> None:
        self._model: GSASR | None = None
        self._model_name: tuple[str, float] | None = None

    def open(self, task: Task, path: Path) -> Document:
        """The document in a file; that of a saved field has all its tiles, a picture none yet.

        Raises ImageError or FieldError in one sentence.
        """
        if path.suffix.lower() == FIELD_SUFFIX:
            return self._open_field(task, path)
        from gsasr import image

        picture = image.read(path)
        return Document(path, to_rgba(picture.color, picture.alpha), picture)

    def _open_field(self, task: Task, path: Path) -> Document:
        _load_torch()
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
        parts = list(split(field))
        tiles = TileStore([core for _, core in parts])
        for index, (part, _) in enumerate(parts):
            task.check()
            tiles.keep(index, part)
        model = field.model or "saved field"
        return Document(path, to_rgba(color, None), None, tiles, model, field.scale)

    def plan(
        self, task: Task, document: Document, model_name: str, condition: float
    ) -> tuple[TileStore, str]:
        """The tiles of a picture, none of them predicted yet, and the name of what will.

        Raises CheckpointError.
        """
        task.progress(None, "Loading the network")
        _load_torch()
        model = self._load(model_name)
        task.check()
        from gsasr.prediction import check, plan, predict_tile

        image = document.picture.color
        check(image, condition)
        tiles = plan(model, document.size, TILE)
        store = TileStore(
            [(tile.x0, tile.y0, tile.x1, tile.y1) for tile in tiles],
            lambda index: predict_tile(model, image, tiles[index], condition),
        )
        return store, model.name

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


def _load_torch() -> None:
    """Load PyTorch's library where that would stop the window: importing it holds Python's lock.

    A foreign call does not: the longest stop is then 0.2 s instead of 0.5 s. What fails here,
    the import does again, and can say why.
    """
    if sys.platform != "linux" or "torch" in sys.modules:
        return
    found = importlib.util.find_spec("torch")
    if found is not None and found.origin is not None:
        load = ctypes.CDLL(None).dlopen
        load.argtypes, load.restype = [ctypes.c_char_p, ctypes.c_int], ctypes.c_void_p
        load(os.fsencode(Path(found.origin).parent / "lib" / "libtorch_cpu.so"), os.RTLD_NOW)


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
