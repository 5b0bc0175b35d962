"""A tile of Gaussians in video memory, as shaders/rasterize.comp reads it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import moderngl
import numpy as np

from ..errors import BackendError
from ..view import View


@dataclass(frozen=True)
class GlLevel:
    """One index of a tile on the GPU (see cells.Cells)."""

    side: float
    first: tuple[int, int]
    shape: tuple[int, int]
    lists: moderngl.Buffer
    entries: moderngl.Buffer
    wide: bool
    ordinary: int  # entries in ordinary lists, and in steep ones
    steep: int
    longest: int


@dataclass(frozen=True)
class GlTile:
    """A PackedTile on the GPU. `count` Gaussians; the rest as in PackedTile and Records."""

    count: int
    origin: tuple[int, int]
    bounds: tuple[float, float, float, float]
    extent: tuple[float, float, float, float]
    largest: float
    records: moderngl.Buffer
    unpacking: tuple[float, float, float] | None
    levels: tuple[GlLevel, ...]

    @property
    def nbytes(self) -> int:
        """Video memory it holds."""
        lists = sum(level.lists.size + level.entries.size for level in self.levels)
        return self.records.size + lists

    def meets(self, view: View) -> bool:
        """Whether any of it can be seen."""
        x0, y0 = view.origin
        x1, y1 = view.to_source(view.size[1], view.size[0])
        return (
            self.bounds[0] < x1
            and x0 < self.bounds[2]
            and self.bounds[1] < y1
            and y0 < self.bounds[3]
        )

    def release(self) -> None:
        """Free the video memory; on the thread of the context."""
        self.records.release()
        for level in self.levels:
            level.lists.release()
            level.entries.release()


def allocate(ctx: moderngl.Context, contents: Iterable[np.ndarray | int]) -> list[moderngl.Buffer]:
    """A buffer of each array, or of so many bytes. Raises BackendError if there is no room."""
    buffers = []
    for content in contents:
        size = content if isinstance(content, int) else content.nbytes
        if size and not isinstance(content, int):
            buffers.append(ctx.buffer(content))
        else:
            buffers.append(ctx.buffer(reserve=max(size, 32)))  # a buffer cannot be empty
    if ctx.error == "GL_OUT_OF_MEMORY":
        for buffer in buffers:
            buffer.release()
        raise BackendError("The GPU is out of memory; close other programs or use --backend cpu.")
    return buffers
