"""The camera keeps the point under the cursor, ends where it should, and stays in reach."""

import math

import pytest

from viewer.camera import Camera, Pose


def looking(width=1280, height=720, picture=(480, 640)) -> Camera:
    camera = Camera()
    camera.resize(width, height)
    camera.set_picture(picture)
    return camera


def settle(camera: Camera, seconds: float = 1 / 60) -> int:
    frames = 0
    while camera.moving:
        camera.tick(seconds)
        frames += 1
        assert frames < 1000
    return frames


def test_fit_shows_the_whole_picture_centred():
    view = looking().view()
    assert view.scale == (1.5, 1.5)
    assert view.size == (720, 1280)
    assert view.to_output(0, 0) == (160, 0)
    assert view.to_output(640, 480) == (1120, 720)


def test_zoom_keeps_the_point_under_the_cursor_at_every_frame():
    camera, cursor = looking(), (333.25, 517.75)
    held = camera.view().to_source(*cursor)
    for _ in range(80):
        camera.zoom(1 / 8, cursor)
        for _ in range(3):
            camera.tick(1 / 144)
            x, y = camera.view().to_output(*held)
            assert math.hypot(x - cursor[0], y - cursor[1]) < 1e-6
    settle(camera)
    assert camera.scale == pytest.approx(1.5 * 2**10)
    x, y = camera.view().to_output(*held)
    assert math.hypot(x - cursor[0], y - cursor[1]) < 1e-6


def test_zoom_reaches_a_thousand_beyond_fit_and_stops_somewhere():
    camera = looking()
    camera.zoom(10)
    settle(camera)
    assert camera.scale == pytest.approx(1.5 * 1024)
    camera.zoom(100)
    settle(camera)
    assert math.isfinite(camera.scale)
    camera.zoom(-1000)
    settle(camera)
    assert camera.scale > 0


def test_zooming_out_after_zooming_in_comes_back():
    camera, cursor = looking(), (900.0, 100.0)
    before = camera.pose
    camera.zoom(9.5, cursor)
    settle(camera)
    camera.zoom(-9.5, cursor)
    settle(camera)
    assert camera.pose.scale == pytest.approx(before.scale)
    assert camera.pose.x == pytest.approx(before.x, abs=1e-6)
    assert camera.pose.y == pytest.approx(before.y, abs=1e-6)


def test_drag_moves_the_picture_with_the_cursor_also_during_a_zoom():
    camera, cursor = looking(), (400.0, 300.0)
    camera.zoom(3, cursor)
    camera.tick(0.02)
    held = camera.view().to_source(*cursor)
    for step in range(1, 20):
        camera.pan(4, -2)
        camera.tick(1 / 60)
        x, y = camera.view().to_output(*held)
        assert x == pytest.approx(cursor[0] + 4 * step, abs=1e-6)
        assert y == pytest.approx(cursor[1] - 2 * step, abs=1e-6)


def test_one_to_one_is_aligned_with_the_pixels():
    camera = looking()
    camera.zoom(2.3, (100, 100))
    settle(camera)
    camera.one_to_one((640, 360))
    settle(camera)
    assert camera.scale == 1.0
    assert camera.pose.x == round(camera.pose.x)
    assert camera.pose.y == round(camera.pose.y)


def test_the_animation_takes_a_moment_and_does_not_depend_on_the_frame_rate():
    slow, fast = looking(), looking()
    slow.zoom(2)
    fast.zoom(2)
    slow.tick(0.1)
    for _ in range(10):
        fast.tick(0.01)
    assert slow.scale == pytest.approx(fast.scale)
    assert 1.5 < slow.scale < 6
    assert 10 < settle(fast) < 60


def test_panning_cannot_lose_the_picture():
    camera = looking()
    camera.zoom(3)
    settle(camera)
    camera.pan(1e9, -1e9)
    view = camera.view()
    x, _ = view.to_output(0, 0)
    _, y = view.to_output(640, 480)
    assert x == pytest.approx(640)
    assert y == pytest.approx(360)


def test_a_fitted_picture_stays_fitted_when_the_window_changes():
    camera = looking()
    camera.resize(640, 360)
    assert camera.scale == 0.75
    camera.zoom(1)
    settle(camera)
    center = camera.view().to_source(320, 180)
    camera.resize(1000, 500)
    assert camera.scale == 1.5
    assert camera.view().to_source(500, 250) == pytest.approx(center)


def test_a_tiny_canvas_and_a_tiny_picture_do_no_harm():
    camera = Camera()
    camera.resize(0, 0)
    camera.set_picture((1, 1))
    camera.zoom(3)
    settle(camera)
    assert camera.view().size == (1, 1)
    assert isinstance(camera.target, Pose)
