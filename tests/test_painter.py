"""How the painter keeps to its budget: reduced in motion, exact at rest; and how it knows costs."""

from __future__ import annotations

import math
import time
from types import SimpleNamespace

import numpy as np
import pytest
from test_scene import STEP, add, random_picture, show
from viewer_scenarios import assert_shows, make_field

from gsasr.view import View
from viewer.clock import LATE, Clock
from viewer.painter import Painter
from viewer.rates import Rates
from viewer.scene import Overlay, Scene


@pytest.fixture
def scene(gl_context):
    made = Scene(gl_context)
    yield made
    made.release()


def reduced(view: View, reduction: int) -> View:
    size = tuple(-(-side // reduction) for side in view.size)
    return View(view.origin, tuple(side / reduction for side in view.scale), size)


def in_motion(scene: Scene, budget: float) -> Painter:
    """A painter that has just followed a moving view, with so many seconds per frame."""
    painter = Painter(scene)
    painter.budget = budget
    for step in range(6):
        view = View((-8 + step, -2), (10.0, 10.0), (300, 400))
        assert painter.paint(view, Overlay())
    return painter


def rest(painter: Painter) -> None:
    """Let the time pass after which a view counts as one at rest."""
    painter._changed -= 1.0


LAST = View((-3, -2), (10.0, 10.0), (300, 400))  # of in_motion


def shown(painter: Painter) -> np.ndarray:
    return (painter.target.read() / 255).astype(np.float32)


def test_a_view_in_motion_is_reduced_and_sharpens_in_slices_when_it_rests(scene):
    field = make_field()
    scene.set_picture(random_picture())
    add(scene, field)
    painter = in_motion(scene, 1e-3)
    assert painter.reduction > 1 and painter.busy
    (layer, exact) = painter.layers()
    assert exact.y1 == 0
    small = painter._small.size
    assert layer.u1 * small[1] * painter.reduction == pytest.approx(400)
    painter._changed = math.inf
    assert not painter.paint(LAST, Overlay())  # nothing changed, and it has not rested yet
    painter._changed = -math.inf
    count = 0
    while painter.busy:
        assert painter.paint(LAST, Overlay())
        count += 1
    assert count > 1  # not all at once
    assert painter.reduction == 1
    assert_shows(shown(painter), field, LAST)
    assert not painter.paint(LAST, Overlay())


def test_in_motion_gaussians_are_drawn_as_small_as_the_budget_demands(scene):
    field = make_field()
    scene.set_picture(random_picture())
    add(scene, field)
    painter = Painter(scene)
    rates = painter._gaussians, painter._passes
    for rate, seconds in zip(rates, (1e-6, 1e-8), strict=True):
        rate.learn = lambda *_: None
        rate.predict = lambda scale, seconds=seconds: seconds
    work = scene.work(LAST).sum()
    # Smaller still, Gaussians would be coarser than the source, which is drawn instead.
    for reduction, share in ((1, 1.0), (3, 1.0), (8, 1.0), (2, 0.0), (8, 0.0)):
        area = reduction**2
        seconds = painter._seconds(10 / reduction, 300 * 400 / area, share * work / area)
        painter.budget = 1.001 * seconds
        painter.reset()
        painter.paint(LAST, Overlay())
        assert painter.reduction == reduction
        assert painter.busy == (reduction > 1)
        if reduction > 1:
            small = painter._small.read() / 255
            assert np.array_equal(small, show(scene, reduced(LAST, reduction), share=share))


def test_a_change_of_view_is_drawn_in_the_next_frame_whatever_slice_was_drawn(scene):
    scene.set_picture(random_picture())
    add(scene, make_field())
    painter = in_motion(scene, 1e-3)
    rest(painter)
    for slices in (1, 2, 3):
        for _ in range(slices):
            assert painter.busy and painter.paint(LAST, Overlay())
        moved = View((3.0 + slices, 1.0), (10.0, 10.0), (300, 400))
        assert painter.paint(moved, Overlay())
        assert painter.layers()[1].y1 == 0  # all of the canvas shows the new view
        small = painter._small.read() / 255
        view = reduced(moved, painter.reduction)
        differences = [np.abs(small - show(scene, view, share=share)).max() for share in (0.0, 1.0)]
        assert min(differences) <= 1.01 * STEP
        assert painter.paint(LAST, Overlay())
        rest(painter)


def test_an_overlay_at_rest_comes_without_blurring_the_picture(scene):
    scene.set_picture(random_picture())
    add(scene, make_field())
    painter = in_motion(scene, 1e-3)
    rest(painter)
    while painter.busy:
        painter.paint(LAST, Overlay())
    before = shown(painter)
    overlay = Overlay("centers")
    while painter.paint(LAST, overlay):
        assert len(painter.layers()) == 1
    assert np.abs(shown(painter) - show(scene, LAST, overlay=overlay)).max() <= 1.01 * STEP
    assert np.abs(shown(painter) - before).max() > 0.1


class Query:
    """A timer query of a GPU."""

    made = 0
    elapsed = 2_000_000  # nanoseconds

    def __init__(self, time: bool) -> None:
        assert time
        Query.made += 1

    def __enter__(self):
        pass

    def __exit__(self, *_):
        pass


def test_on_a_gpu_times_come_from_queries_some_frames_later_and_nothing_waits():
    # No `finish`: it must not be called.
    gpu = SimpleNamespace(info={"GL_RENDERER": "NVIDIA H200/PCIe/SSE2"}, query=Query)
    clock, learned = Clock(gpu), []
    assert not clock.software
    for frame in range(10):
        clock.tick()
        assert learned == [0.002] * max(0, frame - LATE + 1)
        with clock.measure(learned.append):
            pass
    assert Query.made == LATE  # used again and again


def test_on_software_times_are_those_of_the_cpu():
    cpu = SimpleNamespace(info={"GL_RENDERER": "llvmpipe"}, finish=lambda: time.sleep(0.02))
    clock, learned = Clock(cpu), []
    with clock.measure(learned.append):
        pass
    assert learned[0] >= 0.02


def test_what_a_pixel_costs_is_bounded_by_what_is_known_of_other_scales():
    rates = Rates(1.0)
    assert rates.predict(8.0) == 1.0  # no dearer at a larger scale
    assert rates.predict(0.5) == 4.0  # four times the picture per pixel
    rates.learn(8.0, 0.1)
    assert rates.predict(8.0) == rates.predict(1000.0) == 0.1
    assert rates.predict(4.0) == pytest.approx(0.4)
    rates.learn(8.0, 0.3)
    assert rates.predict(8.0) == 0.3  # at once
    rates.learn(8.0, 0.1)
    assert 0.1 < rates.predict(8.0) < 0.3  # by and by


def test_painter_draws_again_only_what_arrived(scene):
    scene.set_picture(random_picture())
    painter = Painter(scene)
    view = View((0, 0), (10.0, 10.0), (300, 400))
    painter.paint(view, Overlay())
    while painter.busy:
        painter.paint(view, Overlay())
    painter.invalidate((-50, -10))
    assert not painter.busy
    before = shown(painter)
    field = make_field()
    add(scene, field)
    painter.invalidate((100, 150))
    assert painter.busy
    while painter.busy:
        painter.paint(view, Overlay())
    after, wanted = shown(painter), show(scene, view).astype(np.float32)
    # Where slices begin, sums are rounded otherwise.
    assert np.abs(after[100:150] - wanted[100:150]).max() <= 1.01 * STEP
    assert np.abs(before[100:150] - wanted[100:150]).max() > 10 * STEP
    for untouched in (slice(0, 100), slice(150, 300)):
        assert np.array_equal(after[untouched], before[untouched])
        assert np.abs(after[untouched] - wanted[untouched]).max() > 0.1
    painter.invalidate((-50, 1000))
    while painter.busy:
        painter.paint(view, Overlay())
    assert_shows(shown(painter), field, view)


def test_how_much_there_is_to_draw_is_counted_once_per_view_and_change_of_tiles(scene):
    scene.set_picture(random_picture())
    near, far = View((0, 0), (10.0, 10.0), (300, 400)), View((500, 0), (10.0, 10.0), (300, 400))
    assert scene.work(near).sum() == 0
    add(scene, make_field())
    counted = scene.work(near)
    assert scene.work(near) is counted and counted.min() >= 400
    assert scene.work(far).sum() == 0
    scene.clear_tiles()
    assert scene.work(near).sum() == 0
