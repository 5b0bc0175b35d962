"""Plays views through the viewer's painter and scene, headless and in real time."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from dataclasses import dataclass

from gsasr.gaussians import Gaussians
from gsasr.rasterize import gl
from gsasr.view import View
from viewer.loading import split
from viewer.painter import Painter
from viewer.scene import Overlay, Scene
from viewer.worker import Task, Worker


@dataclass(frozen=True)
class Frame:
    """start: seconds since the first frame; seconds: that it took; moved: is the view another
    than in the frame before; reduction, sharp: what the painter shows then."""

    start: float
    seconds: float
    view: View
    moved: bool
    reduction: int
    sharp: bool


def play(
    painter: Painter,
    views: list[View],
    fps: float,
    work: Callable[[], object] = lambda: None,
    patience: float = 10.0,
) -> list[Frame]:
    """Show each view at its time, as a window at `fps` would; late frames skip views.

    work: done at the start of each frame. The last view is held until it is sharp, but no longer
    than `patience` seconds.
    """
    frames: list[Frame] = []
    begin = time.perf_counter()
    while True:
        start = time.perf_counter()
        number = min(int((start - begin) * fps), len(views) - 1)
        view = views[number]
        work()
        painter.paint(view, Overlay(), time.perf_counter() - start)
        end = time.perf_counter()
        moved = not frames or frames[-1].view != view
        sharp = not painter.busy
        frames.append(Frame(start - begin, end - start, view, moved, painter.reduction, sharp))
        over = (end - begin) - len(views) / fps
        if over > 0 and (sharp or over > patience):
            return frames
        time.sleep(max(0.0, begin + (int((end - begin) * fps) + 1) / fps - time.perf_counter()))


def rests(frames: list[Frame], least: float = 0.2) -> list[tuple[View, float]]:
    """Each view held for at least so long, and seconds until it was sharp (inf: it never was)."""
    found = []
    starts = [i for i, frame in enumerate(frames) if frame.moved] + [len(frames)]
    for first, last in itertools.pairwise(starts):
        held = frames[first:last]
        if held[-1].start + held[-1].seconds - held[0].start >= least:
            ends = [f.start + f.seconds - held[0].start for f in held if f.sharp]
            found.append((held[0].view, min(ends, default=float("inf"))))
    return found


def send(worker: Worker, scene: Scene, painter: Painter, field: Gaussians) -> Task:
    """Pack the tiles of a field on the worker, which hands them to the scene one by one."""

    def cover(core) -> None:
        scene.cover(core)
        painter.invalidate()

    def work(task: Task) -> None:
        worker.show(task, scene.prepare)
        for part, core in split(field):
            for piece in gl.split_tiles(part):
                task.check()
                worker.carry_out(task, scene.adding(gl.pack(piece)))
            worker.show(task, lambda core=core: cover(core))

    return worker.post("Packing", work)
