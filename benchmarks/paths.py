"""The recorded path: what a person looks at, one view after another, for benchmarks and tests."""

from __future__ import annotations

from gsasr.view import View
from viewer.camera import Camera, Pose, between

# Where each leg ends, and its share of the time. A leg: scale (canvas pixels per source pixel;
# 0: the whole picture fits), and the point of the picture (shares of its width and height) that
# is then in the middle of the canvas. A leg that ends where it starts is a rest.
LEGS = (
    (0.05, 0.0, (0.5, 0.5)),
    (0.25, 30.0, (0.42, 0.47)),
    (0.06, 30.0, (0.42, 0.47)),
    (0.15, 30.0, (0.53, 0.55)),
    (0.06, 30.0, (0.53, 0.55)),
    (0.15, 1000.0, (0.531, 0.551)),
    (0.06, 1000.0, (0.531, 0.551)),
    (0.16, 0.0, (0.5, 0.5)),
    (0.06, 0.0, (0.5, 0.5)),
)


def zoom_and_pan(
    source: tuple[int, int], canvas: tuple[int, int], seconds: float, fps: float
) -> list[View]:
    """Fit, in to x30, pan, in to x1000, out again; a rest after each, and one at the start.

    source, canvas: (height, width), pixels. The views follow one another at `fps` per second for
    so many seconds. Each zoom turns about one fixed point of the canvas, as the viewer's do.
    """
    count = max(1, round(seconds * fps))
    poses = [_pose(source, canvas, scale, point) for _, scale, point in LEGS]
    views, ended, leg = [], 0.0, 0
    for frame in range(count):
        share = frame / count
        while share >= ended + LEGS[leg][0] and leg + 1 < len(LEGS):
            ended += LEGS[leg][0]
            leg += 1
        left = 1 - min(1.0, (share - ended) / LEGS[leg][0])
        pose = between(poses[leg], poses[max(leg - 1, 0)], left * left * (3 - 2 * left))
        views.append(View((pose.x, pose.y), (pose.scale, pose.scale), canvas))
    return views


def _pose(
    source: tuple[int, int], canvas: tuple[int, int], scale: float, point: tuple[float, float]
) -> Pose:
    camera = Camera()
    camera.resize(canvas[1], canvas[0])
    camera.set_picture(source)
    if scale > 0:
        camera.look_at(point[0] * source[1], point[1] * source[0], scale)
    return camera.pose
