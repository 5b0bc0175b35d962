"""How smoothly the viewer follows the recorded path, as a markdown table.

    python benchmarks/smoothness.py --size 1280 720 --source 512 --per-pixel 16

Plays the path in real time through the viewer's own painter and scene, headless: first while
tiles of Gaussians arrive from a worker, which packs them beside it on the CPU, then with all of
them there. Left out are what Dear ImGui takes to show the result, the prediction of the tiles,
and what decides which of them come and go (viewer/streaming.py, viewer/store.py): they come once,
in order, and all stay. On a GPU the viewer packs nothing, as shaders index the Gaussians there.
"""

from __future__ import annotations

import argparse
import functools
import time

import numpy as np
from fields import plane
from paths import zoom_and_pan
from player import Frame, play, rests, send

from gsasr.rasterize.opengl import create_context
from viewer.mipmaps import mipmaps
from viewer.painter import Painter
from viewer.scene import Scene
from viewer.streaming import deliver
from viewer.worker import Worker


def report(name: str, frames: list[Frame]) -> None:
    """One line of the table, and one for the rests."""
    seconds = np.array([frame.seconds for frame in frames])
    moving = [frame for frame in frames if frame.moved]
    gaps = np.diff([frame.start for frame in moving])
    rate = 1 / gaps[gaps < 0.2].mean()  # a longer gap is a rest
    half, most = 1e3 * np.percentile(seconds, (50, 99))
    reductions = np.bincount([frame.reduction for frame in moving])
    common = ", ".join(f"{r}: {n}" for r, n in enumerate(reductions) if n)
    sharp = ", ".join(f"x{view.scale[0]:.3g}: {1e3 * s:.0f}" for view, s in rests(frames))
    print(
        f"| {name} | {rate:.0f} | {half:.1f} | {most:.1f} | {1e3 * seconds.max():.1f} "
        f"| {sharp} | {common} |",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--size", type=int, nargs=2, default=(1280, 720), help="of the canvas")
    parser.add_argument("--source", type=int, default=512, help="side of the picture, pixels")
    parser.add_argument("--per-pixel", type=int, default=16, help="Gaussians per source pixel")
    parser.add_argument("--seconds", type=float, default=10.0, help="of the path")
    parser.add_argument("--fps", type=float, default=60.0)
    arguments = parser.parse_args()
    canvas, source = arguments.size[::-1], (arguments.source, arguments.source)

    ctx = create_context()
    scene = Scene(ctx)
    pixels = np.random.default_rng(0).integers(0, 256, (*source, 4), dtype=np.uint8)
    pixels[..., 3] = 255
    scene.show_picture(mipmaps(pixels))
    painter = Painter(scene)
    worker = Worker(on_error=print)
    views = zoom_and_pan(source, canvas, arguments.seconds, arguments.fps)
    print(f"{ctx.info['GL_RENDERER']}, {canvas[1]}x{canvas[0]}, {source[1]}x{source[0]} source,")
    print(f"{arguments.per_pixel} Gaussians per pixel, {1e3 * painter.budget:g} ms per frame\n")
    print(
        "| | moving, frames/s | median, ms | 99 %, ms | longest, ms | rest to sharp, ms | sizes |"
    )
    print("|---|---|---|---|---|---|---|")

    task = send(worker, scene, painter, plane(*source, arguments.per_pixel))
    work = functools.partial(deliver, worker, scene, painter)
    report("tiles arrive", play(painter, views, arguments.fps, work))
    while task in worker.tasks:
        time.sleep(0.1)
    while worker.deliver(1.0):
        pass
    report("all tiles there", play(painter, views, arguments.fps))
    worker.stop()


if __name__ == "__main__":
    main()
