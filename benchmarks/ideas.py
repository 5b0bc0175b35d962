"""What each idea in the compute shader is worth: the shader as it is, beside it without one idea.

    python benchmarks/ideas.py --zooms 4 8 16 64

Every variant draws the same field and takes its turn frame by frame, so that a busy machine slows
all alike; medians, and how many times the shader's own. `difference` is to the shader's picture.
The findings are in NOTES.md.
"""

from __future__ import annotations

import argparse
import math
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from unittest import mock

import moderngl
import numpy as np
from fields import plane
from gl import size
from measure import machine

from gsasr.rasterize import cells, gl, opengl, records
from gsasr.rasterize.tiles import PackedTile
from gsasr.view import View

IDEAS = Path(__file__).parent / "ideas"


@dataclass(frozen=True)
class Variant:
    """A way to draw: what is patched while its shaders are compiled and its tiles packed."""

    name: str
    patched: Callable[[], AbstractContextManager] = nullcontext
    sides: tuple[float, ...] = cells.CELL_SIDES
    blocks: tuple[int, ...] | None = None
    texture: bool = False


def main() -> None:
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument("--zooms", type=float, nargs="+", default=[4, 8, 16, 64])
    options.add_argument("--size", type=size, default=(720, 1280), metavar="WxH", help="of a frame")
    options.add_argument("--per-pixel", type=int, default=16, help="Gaussians per source pixel")
    options.add_argument("--frames", type=int, default=5)
    options.add_argument("--only", nargs="*", help="parts of the names of variants")
    arguments = options.parse_args()
    ctx = opengl.create_context()
    print(f"{machine()}; OpenGL by {ctx.info['GL_RENDERER']}; {arguments.size[1]}x", end="")
    print(f"{arguments.size[0]}, {arguments.per_pixel} Gaussians per pixel\n")
    for zoom in arguments.zooms:
        print(f"\n## Zoom {zoom:g}\n\n| variant | median, ms | times as long | difference |")
        print("|---|---|---|---|")
        compare(ctx, zoom, arguments)


def variants() -> Iterator[Variant]:
    """The shader as it is first, then without each idea in turn, then ideas that did not win."""
    yield Variant("as it is")
    for block in (2, 4, 6, 8, 10):
        yield Variant(f"blocks of {block}x{block}", blocks=(block,))
    for side in (0.5, 1.0, 2.0, 4.0):
        yield Variant(f"cells of {side:g}", with_long_lists, sides=(side,))
    yield Variant("records of 32 bytes", lambda: mock.patch.object(records, "WIDEST", 0.0))
    yield Variant("entries of 32 bits", lambda: mock.patch.object(cells, "SHORT", -1))
    yield Variant("an exponential per pixel", lambda: adding("exponentials"))
    yield Variant("exponentials for every row", lambda: adding("rows"))
    yield Variant("weights times colour", lambda: adding("weights"))
    yield Variant("one Gaussian per round", lambda: edited(ROUND, ONE_BY_ONE))
    yield Variant("records from a texture", from_texture, texture=True)


def with_long_lists() -> AbstractContextManager:
    """Else cells of half a pixel would grow until lists are short."""
    return mock.patch.object(cells, "ENTRIES_PER_GAUSSIAN", 100)


ROUND = """        add_entry(base, first, position, offset);
        add_entry(base, second, position, offset);
"""
ONE_BY_ONE = """        for (int k = 0; k < 2; ++k) {
            add_entry(base, first, position, offset);
            first = second;
        }
"""


def adding(name: str) -> AbstractContextManager:
    """With another function that adds an ordinary Gaussian to the sums of a block."""
    start, end = "// Along a line of pixels", "#endif\n\n// position:"
    return edited((start, end), (IDEAS / f"{name}.glsl").read_text() + end)


def from_texture() -> AbstractContextManager:
    start = "layout(std430, binding = 0) readonly buffer Records { uvec4"
    return edited((start, "#else"), (IDEAS / "texture.glsl").read_text() + "#else")


@contextmanager
def edited(old: str | tuple[str, str], new: str) -> Iterator[None]:
    """Shaders compiled inside have `old` (or all from one text to another) replaced by `new`."""
    load = opengl.load_shader

    def changed(ctx: moderngl.Context, name: str, defines: dict) -> str:
        source = load(ctx, name, defines)
        if "STEEP" in defines:
            return source
        for include in ("gaussian.glsl", "records.glsl"):
            source = source.replace(f'#include "{include}"', ctx.includes[include])
        if isinstance(old, str):
            whole = old
        else:
            start = source.index(old[0])
            whole = source[start : source.index(old[1], start) + len(old[1])]
        assert source.count(whole) == 1, f"{name} has changed; so must this benchmark"
        return source.replace(whole, new)

    with mock.patch.object(gl, "load_shader", changed):
        yield


def compare(ctx: moderngl.Context, zoom: float, arguments: argparse.Namespace) -> None:
    """The rows of the table of one zoom."""
    height, width = arguments.size
    field = plane(math.ceil(height / zoom) + 4, math.ceil(width / zoom) + 4, arguments.per_pixel)
    view = View((2.1, 2.2), (zoom, zoom), (height, width))
    parts = gl.split_tiles(field)
    target = ctx.texture((width, height), 4, dtype="f2")
    wanted = [v for v in variants() if chosen(v.name, arguments.only)]
    if len(parts) > 1:  # one texture is bound at a time
        wanted = [variant for variant in wanted if not variant.texture]
    drawn = {variant.name: Drawing(ctx, variant, parts, view, target) for variant in wanted}
    for _ in range(arguments.frames):
        for drawing in drawn.values():
            drawing.frame()
    usual = next(iter(drawn.values()))
    for name, drawing in drawn.items():
        difference = np.abs(drawing.picture - usual.picture).max()
        print(
            f"| {name} | {1e3 * drawing.median:.1f} | {drawing.median / usual.median:.2f} "
            f"| {difference:.5f} |",
            flush=True,
        )
        drawing.release()
    target.release()


def chosen(name: str, only: list[str] | None) -> bool:
    return not only or name == "as it is" or any(part in name for part in only)


class Drawing:
    """A variant at work."""

    def __init__(self, ctx, variant: Variant, parts, view: View, target) -> None:
        self.view, self.target, self.seconds = view, target, []
        self.rasterizer = gl.GlRasterizer(ctx)
        if variant.blocks is not None:
            self.rasterizer.shape = replace(self.rasterizer.shape, blocks=variant.blocks)
        with variant.patched():
            packed: list[PackedTile] = [gl.pack(part, sides=variant.sides) for part in parts]
            self.tiles = [self.rasterizer.upload(tile) for tile in packed]
            self.texture = texture_of(ctx, packed[0]) if variant.texture else None
            self.frame()
        self.seconds.clear()
        self.picture = np.frombuffer(target.read(), np.float16).astype(np.float32)

    def frame(self) -> None:
        if self.texture is not None:
            self.texture.use(7)
        start = time.perf_counter()
        self.rasterizer.draw(self.tiles, self.view, self.target)
        self.rasterizer.ctx.finish()
        self.seconds.append(time.perf_counter() - start)

    @property
    def median(self) -> float:
        return statistics.median(self.seconds)

    def release(self) -> None:
        for held in (self.rasterizer, *self.tiles, *filter(None, [self.texture])):
            held.release()


def texture_of(ctx: moderngl.Context, tile: PackedTile) -> moderngl.Texture:
    data = tile.records.data
    rows = -(-len(data) // 1024)
    padded = np.zeros((rows * 1024, 4), np.uint32)
    padded[: len(data)] = data
    return ctx.texture((1024, rows), 4, padded.tobytes(), dtype="u4")


if __name__ == "__main__":
    main()
