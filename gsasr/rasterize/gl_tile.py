"""A tile of Gaussians in video memory, as shaders/rasterize.comp reads it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import moderngl
import numpy as np

from ..errors import BackendError
from ..view import View
from .opengl import storage_limit, with_room


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
    longest: int  # pairs in the longest list


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
    """A buffer of each: an array is uploaded, of a number so many bytes are only reserved.

    Raises BackendError, and leaves nothing behind, if there is no room for all of them, or if one
    is larger than shaders can read with this driver.
    """
    buffers: list[moderngl.Buffer] = []
    try:
        for content in contents:
            buffers.append(_buffer(ctx, content))
    except BaseException:
        for buffer in buffers:
            buffer.release()
        raise
    return buffers


def _buffer(ctx: moderngl.Context, content: np.ndarray | int) -> moderngl.Buffer:
    size, limit = content if isinstance(content, int) else content.nbytes, storage_limit(ctx)
    if size > limit:
        raise BackendError(
            f"The GPU takes {limit / 2**20:.0f} MiB in a buffer, and these Gaussians need "
            f"{size / 2**20:.0f} MiB; make smaller tiles of them or use --backend cpu."
        )
    if isinstance(content, int) or size == 0:
        return with_room(ctx, ctx.buffer, reserve=max(size, 32))  # a buffer cannot be empty
    return with_room(ctx, ctx.buffer, content)
