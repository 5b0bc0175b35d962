"""The recorded path through the viewer's painter, in real time; a busy machine keeps the bounds."""

from __future__ import annotations

import functools
import itertools
import sys
from pathlib import Path

import numpy as np
import pytest
from viewer_scenarios import assert_shows, make_field

from gsasr.rasterize.gl import pack
from viewer.mipmaps import mipmaps
from viewer.painter import Painter
from viewer.scene import Overlay, Scene
from viewer.streaming import deliver
from viewer.worker import Worker

sys.path.append(str(Path(__file__).parent.parent / "benchmarks"))
from paths import LEGS, zoom_and_pan
from player import play, rests, send

SOURCE, CANVAS, SECONDS, FPS = (120, 200), (180, 240), 4.0, 60.0


@pytest.fixture
def scene(gl_context):
    made = Scene(gl_context)
    made.show_picture(mipmaps(np.full((*SOURCE, 4), 255, np.uint8)))
    # Drivers compile when something is first drawn, which is not what is tested here.
    made.add_tile(pack(make_field((2, 2))))
    while made.loading:
        made.load(1.0)
    for covered in (False, True):
        if covered:
            made.cover((0, 0, SOURCE[1], SOURCE[0]))
        play(Painter(made), zoom_and_pan(SOURCE, CANVAS, 0.5, FPS), FPS)
    made.clear_tiles()
    yield made
    made.release()


def test_the_path_goes_from_fit_to_x1000_and_back():
    views = zoom_and_pan(SOURCE, CANVAS, SECONDS, FPS)
    assert len(views) == SECONDS * FPS
    assert views[0] == views[-1]
    assert views[0].to_output(0, 0)[1] >= 0 and views[0].to_output(*SOURCE[::-1])[1] <= CANVAS[0]
    assert max(view.scale[0] for view in views) == pytest.approx(1000)
    held = [views[0]]  # one view for each rest
    for before, view in itertools.pairwise(views):
        if view == before and view != held[-1]:
            held.append(view)
    assert [round(view.scale[0]) for view in held] == [1, 30, 30, 1000, 1]
    assert sum(share for share, *_ in LEGS) == pytest.approx(1)


def test_the_path_is_smooth_while_gaussians_arrive_and_sharp_at_rest(scene):
    field = make_field(SOURCE)
    worker = Worker(on_error=pytest.fail)
    painter = Painter(scene)
    painter.budget = 2e-3  # far too little for this canvas in one frame
    views = zoom_and_pan(SOURCE, CANVAS, SECONDS, FPS)
    task = send(worker, scene, painter, field)
    work = functools.partial(deliver, worker, scene, painter)
    frames = play(painter, views, FPS, work, patience=60.0)
    worker.stop()
    assert task not in worker.tasks and scene.covers(views[-1])  # all has arrived on the way
    seconds = [frame.seconds for frame in frames]
    assert np.percentile(seconds, 90) < 0.25
    assert max(seconds) < 3.0
    assert any(frame.reduction > 1 for frame in frames)
    assert all(frame.moved or not frame.sharp for frame in frames if frame.reduction > 1)
    assert frames[-1].sharp and frames[-1].reduction == 1
    assert rests(frames)[-1][1] < 30.0

    zoomed = next(view for view in views if view.scale[0] > 29)
    play(painter, [zoomed], FPS, patience=60.0)
    assert_shows((painter.target.read() / 255).astype(np.float32), field, zoomed, step=11)


def test_where_the_budget_suffices_every_frame_is_exact(scene):
    field = make_field(SOURCE)
    worker = Worker(on_error=pytest.fail)
    painter = Painter(scene)
    task = send(worker, scene, painter, field)
    while task in worker.tasks:
        worker.deliver(0.01)
    worker.deliver(60.0)
    worker.stop()
    painter.budget = 1e3
    views = zoom_and_pan(SOURCE, CANVAS, 1.0, 20.0)
    assert all(frame.sharp and frame.reduction == 1 for frame in play(painter, views, 20.0))
    zoomed = next(view for view in views if view.scale[0] > 25)
    assert painter.paint(zoomed, Overlay()) and not painter.busy
    assert_shows((painter.target.read() / 255).astype(np.float32), field, zoomed, step=11)
