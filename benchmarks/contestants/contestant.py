"""What is measured of a rasterizer, and what the baselines share."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path

import moderngl
import numpy as np

from gsasr.gaussians import Gaussians
from gsasr.rasterize import footprint, opengl, tiles
from gsasr.view import View

FOLD = math.sqrt(0.5 * math.log2(math.e))  # see shaders/gaussian.glsl


class Contestant:
    """A field of Gaussians, ready to be drawn by one rasterizer.

    seconds: what making it ready took, by the number of threads.
    shader_seconds: what shaders take for it, if they can.
    gaussians, index: bytes held of the Gaussians themselves and of lists of them.
    """

    name: str
    uses_gl = True
    seconds: dict[int, float]
    shader_seconds: float | None = None
    gaussians: int
    index: int

    def __init__(self, ctx: moderngl.Context, field: Gaussians) -> None:
        raise NotImplementedError

    def draw(self, view: View) -> None:
        """Draw a frame; what uses OpenGL need not have finished."""
        raise NotImplementedError

    def image(self) -> np.ndarray:
        """(h, w, 3) float32, the frame drawn last."""
        raise NotImplementedError

    def evaluations(self, view: View) -> int:
        """Pairs of a pixel and a Gaussian that a frame of this view looks at."""
        raise NotImplementedError

    def share(self, view: View) -> float:
        """Of the Gaussians that `draw` really draws, in (0, 1]; below 1 for what is too slow."""
        return 1.0

    def release(self) -> None:
        """Free what it holds on the GPU."""


def gl_seconds(ctx: moderngl.Context, work: Callable[[], object]) -> float:
    """Of the GPU, by a timer query; on software OpenGL wall time until the work has finished."""
    if not opengl.software(ctx.info):
        query = ctx.query(time=True)
        with query:
            work()
        return query.elapsed / 1e9
    ctx.finish()
    start = time.perf_counter()
    work()
    ctx.finish()
    return time.perf_counter() - start


class GlContestant(Contestant):
    """One that draws into a texture of `dtype`, "f2" or "f4"."""

    dtype = "f4"

    def __init__(self, ctx: moderngl.Context) -> None:
        self.ctx = ctx
        self._target: moderngl.Texture | None = None

    def target(self, view: View) -> moderngl.Texture:
        """The texture for a view's pixels; kept while the size stays."""
        size = view.size[::-1]
        if self._target is None or self._target.size != size:
            if self._target is not None:
                self._target.release()
            self._target = self.ctx.texture(size, 4, dtype=self.dtype)
        return self._target

    def image(self) -> np.ndarray:
        kind = {"f2": np.float16, "f4": np.float32}[self.dtype]
        width, height = self._target.size
        pixels = np.frombuffer(self._target.read(), kind).reshape(height, width, 4)
        return pixels[..., :3].astype(np.float32)

    def release(self) -> None:
        if self._target is not None:
            self._target.release()


def shader(ctx: moderngl.Context, name: str, defines: dict[str, object] | None = None) -> str:
    """Source of a shader of this folder, which may include those of shaders/."""
    opengl.load_shader(ctx, "rasterize.comp")  # makes the includes known
    version, rest = Path(__file__).with_name(name).read_text().split("\n", 1)
    lines = [f"#define {key} {value}" for key, value in (defines or {}).items()]
    return "\n".join([version, *lines, rest])


def drawn(field: Gaussians) -> tuple[np.ndarray, np.ndarray]:
    """What a plain rasterizer needs of each Gaussian that shows: records and cuts, in rows.

    (N, 8) float32: mean x, y, source pixels; the whitening a, b, c of shaders/gaussian.glsl; the
    peak red, green, blue. (N,) float64: draw where q <= cut, the same that ours draws.
    """
    parts = tiles.split_tiles(field)  # ours cuts by what is in a tile
    cut = np.concatenate([footprint.cut(part, "screen").numpy() for part in parts])
    field = Gaussians.concatenate(parts)
    order = np.argsort(field.mean[:, 1].numpy(), kind="stable")
    order = order[cut[order] >= 0]
    std, rho = (t.numpy()[order].astype(np.float64) for t in (field.std, field.rho))
    root = np.sqrt(1 - rho**2)
    records = np.empty((len(order), 8), np.float32)
    records[:, 0:2] = field.mean.numpy()[order]
    records[:, 2] = FOLD / (std[:, 0] * root)
    records[:, 3] = -FOLD * rho / (std[:, 1] * root)
    records[:, 4] = FOLD / std[:, 1]
    records[:, 5:8] = field.peak.numpy()[order]
    return records, cut[order].astype(np.float64)


def whole_and_rest(origin: tuple[float, float]) -> tuple[tuple[int, int], tuple[float, float]]:
    """A place as whole source pixels and what is left, so that float32 stays exact in a shader."""
    whole = math.floor(origin[0]), math.floor(origin[1])
    return whole, (origin[0] - whole[0], origin[1] - whole[1])


def pixels_in_boxes(mean: np.ndarray, reach: np.ndarray, view: View) -> np.ndarray:
    """(N,) pixels of a view whose centres lie within mean +- reach, (N, 2), source pixels."""
    count = np.ones(len(mean))
    for axis, length in enumerate(view.size[::-1]):
        middle = (mean[:, axis].astype(np.float64) - view.origin[axis]) * view.scale[axis] - 0.5
        half = reach[:, axis] * view.scale[axis]
        first = np.maximum(np.ceil(middle - half), 0)
        count *= np.maximum(np.minimum(np.floor(middle + half), length - 1) - first + 1, 0)
    return count


def visits(lengths: np.ndarray, first: tuple[int, int], side: float, view: View) -> int:
    """Entries that the pixels of a view read, each all of its cell's list.

    lengths: (rows, columns) of the lists of a grid of cells with this side, source pixels, whose
    first cell is (x, y).
    """
    counts = []
    for axis, length in enumerate(view.size[::-1]):
        centres = view.origin[axis] + (np.arange(length) + 0.5) / view.scale[axis]
        cell = np.floor(centres / side) - first[axis]
        there = cell[(cell >= 0) & (cell < lengths.shape[1 - axis])].astype(np.int64)
        counts.append(np.bincount(there, minlength=lengths.shape[1 - axis]))
    return int(counts[1] @ lengths.astype(np.int64) @ counts[0])
