"""Frames of the OpenGL rasterizer, beside what one would write first, on the same fields.

    python benchmarks/gl.py
    python benchmarks/gl.py --model lite --picture assets/images/astronaut.png
    python benchmarks/gl.py --sizes 1280x720 1920x1080 3840x2160 --zooms fit 1 2 4 8 16 64 1000

Fields are random planes of Gaussians with standard deviations of 0.2 to 0.55 source pixels, or
what a model predicts from a picture. Fixed views look at the middle of the source; the path zooms
and pans as in paths.py. Rasterizers take turns, frame by frame, so that a busy machine slows all
of them alike; the first frame of each is not counted, and one that is slow draws fewer frames.

time: of the GPU, by timer queries; on software OpenGL and of what runs without OpenGL, wall time
    until the frame has finished.
by shaders: the same, of tiles that have been split: uploading them and what compute shaders then
    make of them, by timer queries, which on a GPU include its waiting for the CPU in between.
evaluations: pairs of a pixel and a Gaussian that the frame looks at. For lists, every pixel times
    the length of the list that it reads; for boxes and ellipses, the pixels within. They are
    counted on the CPU, from the index, for the view; the rate divides by the median time.
paper: where its work is too long it draws a sample of the Gaussians, as large a part of them as
    the brackets say, and the time is scaled up.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path

import moderngl
import numpy as np
import torch
from contestants import CONTESTANTS, Contestant, Ours
from contestants.contestant import gl_seconds
from fields import plane
from measure import machine
from paths import zoom_and_pan

from gsasr import image
from gsasr.gaussians import Gaussians
from gsasr.model import load_model
from gsasr.prediction import predict
from gsasr.rasterize.opengl import create_context
from gsasr.view import View

SLOWEST = 1 / 60  # seconds of a frame that nobody sees


def main() -> None:
    arguments = options().parse_args()
    ctx = create_context()
    report = Report(arguments.out)
    report.line(f"# Frames of {Ours.name} and others, {date.today()}\n")
    report.line(f"{machine()}; OpenGL by {ctx.info['GL_RENDERER']}\n")
    names = [Ours.name, *arguments.against]
    for title, make in fields(arguments):
        drawn = make()
        report.line(f"\n## {title}: {len(drawn):,} Gaussians\n")
        with contestants(ctx, drawn, names) as all_of_them:
            statistics(report, drawn, all_of_them)
            fixed_views(report, ctx, drawn, all_of_them, arguments)
            if not arguments.no_path:
                path(report, ctx, drawn, all_of_them, arguments)


def options() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--sources", type=int, nargs="+", default=[128, 512, 2048], help="sides, pixels")
    add("--per-pixel", type=int, nargs="+", default=[1, 4, 16], help="Gaussians per source pixel")
    add("--most", type=float, default=5e6, help="leave out fields of more Gaussians")
    add("--picture", type=Path, help="predict the field from this instead")
    add("--model", default="lite")
    add("--sizes", type=size, nargs="+", default=[(720, 1280)], metavar="WxH", help="of a frame")
    add("--zooms", nargs="+", default=["fit", "4", "16", "1000"], help="numbers, or fit")
    add("--against", nargs="*", default=["cell loop", "quads", "cpu", "paper"],
        choices=[name for name in CONTESTANTS if name != Ours.name], metavar="RASTERIZER",
        help=", ".join(name for name in CONTESTANTS if name != Ours.name))  # fmt: skip
    add("--frames", type=int, default=9, help="at most, of a fixed view")
    add("--seconds", type=float, default=0.5, help="after which a rasterizer leaves a fixed view")
    add("--path-seconds", type=float, default=4.0)
    add("--path-fps", type=float, default=8.0)
    add("--path-stride", type=int, default=8, help="the others draw every n-th view of the path")
    add("--no-path", action="store_true")
    add("--out", type=Path, help="also write to this file")
    return parser


def size(text: str) -> tuple[int, int]:
    width, height = text.split("x")
    return int(height), int(width)


def fields(arguments: argparse.Namespace) -> Iterator[tuple]:
    """(title, how to make it) of every field."""
    if arguments.picture:
        title = f"{arguments.model} of {arguments.picture.name}"
        picture = image.read(arguments.picture).color
        yield title, lambda: predict(load_model(arguments.model), picture)
        return
    for side in arguments.sources:
        for per_pixel in arguments.per_pixel:
            if side * side * per_pixel <= arguments.most:
                title = f"{side}x{side}, {per_pixel} per pixel"
                yield title, lambda side=side, each=per_pixel: plane(side, side, each)


class Report:
    """Lines for the screen and a file."""

    def __init__(self, path: Path | None) -> None:
        self._file = path.open("w") if path else None

    def line(self, text: str) -> None:
        print(text, flush=True)
        if self._file:
            print(text, file=self._file, flush=True)

    def header(self, *names: str) -> None:
        self.line(f"| {' | '.join(names)} |\n{'|---' * len(names)}|")

    def row(self, *cells: object) -> None:
        self.line(f"| {' | '.join(map(str, cells))} |")


@contextmanager
def contestants(
    ctx: moderngl.Context, drawn: Gaussians, names: list[str]
) -> Iterator[list[Contestant]]:
    """Rasterizers by their names in CONTESTANTS, ready to draw the field; freed at the end."""
    made = [CONTESTANTS[name](ctx, drawn) for name in names]
    for each in made:
        each.draw(View((0.0, 0.0), (1.0, 1.0), (8, 8)))  # compiles what the first frame needs
    ctx.finish()
    yield made
    for each in made:
        each.release()


def statistics(report: Report, drawn: Gaussians, made: list[Contestant]) -> None:
    """Write what the field is like, and what each rasterizer takes to hold and to index it.

    The first must be ours: its index tells how many Gaussians a cell sees.
    """
    shares = torch.tensor([0.05, 0.5, 0.95])
    some = drawn.std.flatten()[:: max(1, 2 * len(drawn) // 1_000_000)]  # quantile's limit
    low, middle, high = some.quantile(shares).tolist()
    report.line(
        f"Standard deviations: {middle:.3f} source pixels (median), 5 % below {low:.3f}, 5 % above "
        f"{high:.3f}. Lists of {made[0].mean_list():.0f} Gaussians per cell of the finest index.\n"
    )
    report.header("rasterizer", "Gaussians, bytes each", "index, bytes each", "all, MiB", "made in",
                  "by shaders")  # fmt: skip
    for each in made:
        seconds = [f"{s:.2f} s ({threads} threads)" for threads, s in each.seconds.items()]
        report.row(
            each.name,
            f"{each.gaussians / len(drawn):.1f}",
            f"{each.index / len(drawn):.1f}",
            f"{(each.gaussians + each.index) / 2**20:.1f}",
            ", ".join(seconds).replace("(1 threads)", "(1 thread)") or "-",
            "-" if each.shader_seconds is None else f"{each.shader_seconds:.3g} s",
        )
    report.line("")


@dataclass
class Timing:
    """Frames of one rasterizer: seconds of each and evaluations per frame; see Contestant.share."""

    seconds: list[float] = field(default_factory=list)
    evaluations: list[int] = field(default_factory=list)
    share: float = 1.0

    @property
    def sample(self) -> str:
        """What was drawn, if not all."""
        return f" (1/{1 / self.share:.0f})" if self.share < 1 else ""

    def milliseconds(self, percentile: float) -> str:
        time = 1e3 * np.percentile(self.seconds, percentile)
        return f"{time:.3g}" if time < 100 else f"{time:,.0f}"

    def rate(self) -> str:
        """10^9 evaluations per second."""
        return f"{np.median(np.divide(self.evaluations, self.seconds)) / 1e9:.3g}"


def fixed_views(
    report: Report,
    ctx: moderngl.Context,
    drawn: Gaussians,
    made: list[Contestant],
    arguments: argparse.Namespace,
) -> None:
    report.header("frame", "zoom", "rasterizer", "frames", "median, ms", "99 %, ms",
                  "per pixel", "evaluations, G/s", "times ours", "difference")  # fmt: skip
    for canvas in arguments.sizes:
        for zoom in arguments.zooms:
            view = middle(drawn.size, canvas, zoom)
            timings = compare(ctx, made, view, arguments.frames, arguments.seconds)
            ours = made[0].image()
            for each, timing in zip(made, timings, strict=True):
                # Only whole pictures can be compared, and the paper's boxes cut what others draw.
                same = each.name != "paper" and each is not made[0]
                report.row(
                    f"{canvas[1]}x{canvas[0]}",
                    f"{view.scale[0]:.4g}",
                    each.name + timing.sample,
                    len(timing.seconds),
                    timing.milliseconds(50),
                    timing.milliseconds(99),
                    f"{timing.evaluations[0] / math.prod(canvas):.3g}",
                    timing.rate(),
                    f"{np.median(timing.seconds) / np.median(timings[0].seconds):.1f}",
                    f"{np.abs(each.image() - ours).max():.0e}" if same else "-",
                )


def middle(source: tuple[int, int], canvas: tuple[int, int], zoom: str) -> View:
    """The view of a canvas at a zoom, or fitting all, the source's middle in its middle."""
    fit = min(c / s for c, s in zip(canvas, source, strict=True))
    scale = fit if zoom == "fit" else float(zoom)
    # A little off whole pixels, as most views are.
    x, y = (s / 2 + 0.137 - c / scale / 2 for c, s in zip(canvas[::-1], source[::-1], strict=True))
    return View((x, y), (scale, scale), canvas)


def compare(
    ctx: moderngl.Context, made: list[Contestant], view: View, frames: int, most: float
) -> list[Timing]:
    """All rasterizers in turn, until each has drawn `frames` or for `most` seconds."""
    timings = [Timing(share=each.share(view)) for each in made]
    for each, timing in zip(made, timings, strict=True):
        first = draw(ctx, each, view) / timing.share
        timing.evaluations = [each.evaluations(view)]
        if first * timing.share > most:  # too slow to be drawn again
            timing.seconds = [first]
    running = [(e, t) for e, t in zip(made, timings, strict=True) if not t.seconds]
    for _ in range(frames):
        for each, timing in running:
            if sum(timing.seconds) * timing.share < most:
                timing.seconds.append(draw(ctx, each, view) / timing.share)
    return timings


def draw(ctx: moderngl.Context, contestant: Contestant, view: View) -> float:
    """Seconds of one frame."""
    if contestant.uses_gl:
        return gl_seconds(ctx, lambda: contestant.draw(view))
    ctx.finish()
    start = time.perf_counter()
    contestant.draw(view)
    return time.perf_counter() - start


def path(
    report: Report,
    ctx: moderngl.Context,
    drawn: Gaussians,
    made: list[Contestant],
    arguments: argparse.Namespace,
) -> None:
    """Frames along the recorded path: fit, in to x30, pan, in to x1000, out."""
    report.line("")
    report.header("path", "rasterizer", "frames", "median, ms", "99 %, ms", "slowest, ms",
                  "evaluations, G/s", f"within {1e3 * SLOWEST:.0f} ms", "times ours")  # fmt: skip
    for canvas in arguments.sizes:
        views = zoom_and_pan(drawn.size, canvas, arguments.path_seconds, arguments.path_fps)
        timings = [Timing() for _ in made]
        shared: list[list[float]] = [[] for _ in made]  # of the views that all draw
        for each in made:
            draw(ctx, each, views[0])
        for number, view in enumerate(views):
            all_draw = number % arguments.path_stride == 0
            for each, timing, both in zip(made, timings, shared, strict=True):
                if all_draw or each is made[0]:
                    timing.share = min(timing.share, each.share(view))
                    seconds = draw(ctx, each, view) / each.share(view)
                    timing.seconds.append(seconds)
                    timing.evaluations.append(each.evaluations(view))
                    if all_draw:
                        both.append(seconds)
        for each, timing, both in zip(made, timings, shared, strict=True):
            report.row(
                f"{canvas[1]}x{canvas[0]}",
                each.name + timing.sample,
                len(timing.seconds),
                timing.milliseconds(50),
                timing.milliseconds(99),
                timing.milliseconds(100),
                timing.rate(),
                f"{np.mean(np.array(timing.seconds) <= SLOWEST):.0%}",
                f"{np.sum(both) / np.sum(shared[0]):.1f}",
            )


if __name__ == "__main__":
    main()
