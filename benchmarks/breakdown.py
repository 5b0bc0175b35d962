"""Where the milliseconds of one frame of the viewer's scene go, as nested bars.

    python benchmarks/breakdown.py --side 256 --zooms 4 1000

First the calls: every OpenGL command that makes the GPU work is waited for, so that its time is
its own. This adds a little; the frame as the viewer draws it is printed above. Shown is the
frame of median length. "Python" is what remains of a call when all named within it are taken off.

Then the shader, with parts left out: a reference is the time of the rasterizer's draw alone.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from unittest import mock

import moderngl
import numpy as np
from contestants.ours import packed_field, with_empty_lists, with_one_gaussian
from fields import plane
from gl import middle, size
from measure import machine

from gsasr.processor import cores
from gsasr.rasterize import blocks, gl, opengl
from gsasr.rasterize.tiles import PackedTile
from gsasr.view import View
from viewer.scene import Overlay, Scene, Target

WIDTH = 40  # of a bar that is the whole frame, characters

# What is timed: class or module, its function, the name shown, whether the GPU works at it.
HOOKS = (
    (gl.GlRasterizer, "draw", "Gaussians", False),
    (blocks, "runs", "runs of pixels, NumPy", False),
    (moderngl.Context, "framebuffer", "framebuffers", False),
    (moderngl.Framebuffer, "clear", "clear", True),
    (moderngl.Buffer, "orphan", "uploads", False),
    (moderngl.Buffer, "write", "uploads", False),
    (moderngl.Buffer, "bind_to_storage_buffer", "bindings", False),
    (moderngl.Texture, "bind_to_image", "bindings", False),
    (moderngl.Texture, "use", "bindings", False),
    (moderngl.ComputeShader, "__setitem__", "uniforms", False),
    (moderngl.Program, "__setitem__", "uniforms", False),
    (moderngl.ComputeShader, "run", "dispatches", True),
    (moderngl.Context, "memory_barrier", "barriers", False),
    (moderngl.VertexArray, "render", "display pass", True),
    (moderngl.Context, "finish", "finish", False),
)


def main() -> None:
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument("--side", type=int, default=256, help="of the source, pixels")
    options.add_argument("--per-pixel", type=int, default=16, help="Gaussians per source pixel")
    options.add_argument("--size", type=size, default=(720, 1280), metavar="WxH", help="of a frame")
    options.add_argument(
        "--zooms", nargs="+", default=["fit", "16", "1000"], help="numbers, or fit"
    )
    options.add_argument("--frames", type=int, default=9)
    arguments = options.parse_args()
    ctx = opengl.create_context()
    drawn = plane(arguments.side, arguments.side, arguments.per_pixel)
    tiles = packed_field(drawn, cores())
    print(f"{machine()}; OpenGL by {ctx.info['GL_RENDERER']}\n")
    print(f"{arguments.side}x{arguments.side}, {arguments.per_pixel} Gaussians per pixel, ", end="")
    print(f"drawn at {arguments.size[1]}x{arguments.size[0]}")
    scene = make_scene(ctx, drawn.size, tiles)
    target = Target(ctx, arguments.size)
    variants = make_variants(ctx, tiles)
    for zoom in arguments.zooms:
        view = middle(drawn.size, arguments.size, zoom)
        print(f"\n## Zoom {view.scale[0]:.4g}\n")
        print_calls(lambda v=view: scene.draw(target, v, Overlay()), arguments.frames)
        print_variants(ctx, variants, view, arguments.frames)


def make_scene(ctx: moderngl.Context, source: tuple[int, int], tiles: list[PackedTile]) -> Scene:
    scene = Scene(ctx)
    scene.set_picture(np.full((*source, 4), 255, np.uint8))
    for tile in tiles:
        scene.add_tile(tile)
    scene.cover((0, 0, source[1], source[0]))
    return scene


@dataclass
class Span:
    """Time spent in all calls of one name within their caller."""

    seconds: float = 0.0
    calls: int = 0
    parts: dict[str, Span] = field(default_factory=dict)


def print_calls(frame: Callable[[], object], frames: int) -> None:
    """Bars of the calls of the median of some frames."""
    frame()
    plain = sorted(timed(frame) for _ in range(frames))
    traced = sorted((trace(frame) for _ in range(frames)), key=lambda span: span.seconds)
    print(f"As the viewer draws it: {1e3 * plain[frames // 2]:.1f} ms.\n\n```")
    print_span("frame", traced[frames // 2], traced[frames // 2].seconds)
    print("```\n")


def timed(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def trace(frame: Callable[[], object]) -> Span:
    """The tree of calls of one frame."""
    whole = Span(calls=1)
    stack = [whole]
    with ExitStack() as patches:
        for owner, function, name, works in HOOKS:
            hook = hooked(getattr(owner, function), name, works, stack)
            patches.enter_context(mock.patch.object(owner, function, hook))
        whole.seconds = timed(frame)
    return whole


def hooked(function: Callable, name: str, works: bool, stack: list[Span]) -> Callable:
    def call(*arguments, **named):
        span = stack[-1].parts.setdefault(name, Span())
        stack.append(span)
        start = time.perf_counter()
        result = function(*arguments, **named)
        if works:
            arguments[0].ctx.mglo.finish()  # that of moderngl's core, which is not hooked
        span.seconds += time.perf_counter() - start
        span.calls += 1
        stack.pop()
        return result

    return call


def print_span(name: str, span: Span, whole: float, depth: int = 0) -> None:
    print_bar("  " * depth + name + (f", {span.calls} calls" if span.calls > 1 else ""),
              span.seconds, whole)  # fmt: skip
    for part, inner in sorted(span.parts.items(), key=lambda item: -item[1].seconds):
        print_span(part, inner, whole, depth + 1)
    if span.parts:
        rest = span.seconds - sum(inner.seconds for inner in span.parts.values())
        print_bar("  " * (depth + 1) + "Python", rest, whole)


def print_bar(label: str, seconds: float, whole: float) -> None:
    share = seconds / whole
    print(f"{label:<36}{1e3 * seconds:>8.2f} ms {share:>6.1%}  {'█' * round(WIDTH * share)}")


Variant = tuple[gl.GlRasterizer, list[gl.GlTile]]


def make_variants(ctx: moderngl.Context, tiles: list[PackedTile]) -> dict[str, Variant]:
    """The rasterizer with parts left out."""
    whole, cheap = gl.GlRasterizer(ctx), gl.GlRasterizer(ctx)
    with without_exponentials():
        cheap.warm_up()
    uploaded = [whole.upload(tile) for tile in tiles]
    return {
        "all of it": (whole, uploaded),
        "exponentials made multiplications": (cheap, uploaded),
        "always the same Gaussian": (whole, [whole.upload(with_one_gaussian(t)) for t in tiles]),
        "empty lists": (whole, [whole.upload(with_empty_lists(t)) for t in tiles]),
    }


@contextmanager
def without_exponentials() -> Iterator[None]:
    """Shaders compiled inside get something cheap for exp2, which still depends on what it gets."""
    load = opengl.load_shader

    def edited(*arguments) -> str:
        version, rest = load(*arguments).split("\n", 1)
        return f"{version}\n#define exp2(x) (0.001 * (x) + 0.5)\n{rest}"

    with mock.patch.object(gl, "load_shader", edited):
        yield


def print_variants(
    ctx: moderngl.Context, variants: dict[str, Variant], view: View, frames: int
) -> None:
    """Bars of the median time of each variant, in turn."""
    texture = ctx.texture(view.size[::-1], 4, dtype="f2")

    def draw(rasterizer: gl.GlRasterizer, tiles: list[gl.GlTile]) -> None:
        rasterizer.draw(tiles, view, texture)
        ctx.finish()

    seconds: dict[str, list[float]] = {name: [] for name in variants}
    for _ in range(frames + 1):
        for name, variant in variants.items():
            seconds[name].append(timed(lambda v=variant: draw(*v)))
    texture.release()
    medians = {name: float(np.median(each[1:])) for name, each in seconds.items()}
    print("```")
    for name, median in medians.items():
        print_bar(name, median, medians["all of it"])
    print("```")


if __name__ == "__main__":
    main()
