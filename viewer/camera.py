"""The camera: which part of the picture the canvas shows, and how it moves there smoothly.

Everything is in float64: canvas coordinates are framebuffer pixels from the canvas' top left
corner, source coordinates are pixels of the picture, as in gsasr.View.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from gsasr.view import View

TIME_CONSTANT = 0.075  # seconds in which an animation covers 63 % of the rest of its way
SETTLED = 1e-3  # of the way left at which an animation snaps to its end
MAX_ZOOM = 4096.0  # beyond fit and beyond 1:1
MARGIN = 0.5  # of the canvas that may lie past the picture's edge


@dataclass(frozen=True)
class Pose:
    """x, y: of the canvas' top left corner, source pixels; scale: canvas per source pixels."""

    x: float
    y: float
    scale: float

    def to_source(self, px: float, py: float) -> tuple[float, float]:
        """Canvas pixels to source pixels."""
        return self.x + px / self.scale, self.y + py / self.scale

    def holding(self, source: tuple[float, float], at: tuple[float, float]) -> Pose:
        """The same scale, moved such that a source point lies at a canvas point."""
        return Pose(source[0] - at[0] / self.scale, source[1] - at[1] / self.scale, self.scale)


class Camera:
    """A pose on its way to a target.

    Between two poses the inverse scale moves the origin linearly, so every animation turns about
    one fixed point of the canvas; for a zoom that is the cursor, exactly, at every frame.
    """

    def __init__(self) -> None:
        self._picture = (1.0, 1.0)  # width, height
        self._canvas = (1.0, 1.0)
        self._start = self._target = self.pose = Pose(0.0, 0.0, 1.0)
        self._left = 0.0  # share of the way from start to target that is left
        self._fitted = True  # follow the canvas when it is resized

    @property
    def moving(self) -> bool:
        """Is an animation under way?"""
        return self._left > 0.0

    @property
    def target(self) -> Pose:
        """Where the animation ends."""
        return self._target

    @property
    def scale(self) -> float:
        """Canvas pixels per source pixel, now."""
        return self.pose.scale

    def view(self) -> View:
        """What the canvas shows now."""
        width, height = (max(1, round(side)) for side in self._canvas)
        pose = self.pose
        return View((pose.x, pose.y), (pose.scale, pose.scale), (height, width))

    def set_picture(self, size: tuple[int, int]) -> None:
        """Look at a new picture (height, width), fitted."""
        self._picture = (float(size[1]), float(size[0]))
        self.fit(smooth=False)

    def resize(self, width: float, height: float) -> None:
        """The canvas changed; a fitted picture stays fitted, else its centre stays put."""
        if (width, height) == self._canvas:
            return
        dx, dy = (self._canvas[0] - width) / 2, (self._canvas[1] - height) / 2
        self._canvas = (max(1.0, width), max(1.0, height))
        if self._fitted:
            self.fit(smooth=False)
        else:
            self._jump(self._clamped(_moved(self._target, -dx, -dy)))

    def tick(self, seconds: float) -> bool:
        """Advance the animation; True if the view changed."""
        if not self.moving:
            return False
        self._left *= math.exp(-max(0.0, seconds) / TIME_CONSTANT)
        if self._left < SETTLED:
            self._left = 0.0
            self.pose = self._target
        else:
            self.pose = between(self._target, self._start, self._left)
        return True

    def zoom(self, octaves: float, at: tuple[float, float] | None = None) -> None:
        """Zoom in by a power of two about a canvas point (default: the centre), smoothly."""
        at = at or (self._canvas[0] / 2, self._canvas[1] / 2)
        self._zoom_to(self._target.scale * 2.0**octaves, at)

    def one_to_one(self, at: tuple[float, float] | None = None) -> None:
        """One source pixel per framebuffer pixel, aligned, about a canvas point."""
        at = at or (self._canvas[0] / 2, self._canvas[1] / 2)
        x, y = self.pose.to_source(*at)
        self._fly(self._clamped(Pose(round(x - at[0]), round(y - at[1]), 1.0)))

    def fit(self, smooth: bool = True) -> None:
        """The whole picture, centred on whole pixels."""
        scale = self.fit_scale
        left, top = (
            math.floor((canvas - side * scale) / 2)
            for canvas, side in zip(self._canvas, self._picture, strict=True)
        )
        target = Pose(-left / scale, -top / scale, scale)
        self._fly(target) if smooth else self._jump(target)
        self._fitted = True

    @property
    def fit_scale(self) -> float:
        """The scale at which the whole picture just fits."""
        return min(c / p for c, p in zip(self._canvas, self._picture, strict=True))

    def pan(self, dx: float, dy: float, smooth: bool = False) -> None:
        """Move the picture by canvas pixels, at once (a drag) or smoothly (a key)."""
        target = self._clamped(_moved(self._target, dx, dy))
        if smooth:
            self._fly(target)
        else:
            # What is left of a zoom goes on, about the same canvas point.
            self._start = _moved(self._start, dx, dy)
            self._target = target
            self.pose = between(target, self._start, self._left) if self.moving else target
            self._fitted = False

    def look_at(self, x: float, y: float, scale: float) -> None:
        """Put a source point in the middle of the canvas at a scale, at once."""
        middle = (self._canvas[0] / 2, self._canvas[1] / 2)
        self._jump(Pose(0.0, 0.0, self._limited(scale)).holding((x, y), middle))
        self._fitted = False

    def _zoom_to(self, scale: float, at: tuple[float, float]) -> None:
        pose = Pose(0.0, 0.0, self._limited(scale))
        self._fly(pose.holding(self.pose.to_source(*at), at))

    def _limited(self, scale: float) -> float:
        fit = self.fit_scale
        return min(max(scale, min(fit, 1.0) / 4), max(fit, 1.0) * MAX_ZOOM)

    def _clamped(self, pose: Pose) -> Pose:
        """Keep the picture in reach: half a canvas past its edge, no further."""
        x, y = (
            min(
                max(origin, -MARGIN * canvas / pose.scale),
                side - (1 - MARGIN) * canvas / pose.scale,
            )
            for origin, canvas, side in zip(
                (pose.x, pose.y), self._canvas, self._picture, strict=True
            )
        )
        return Pose(x, y, pose.scale)

    def _fly(self, target: Pose) -> None:
        self._start, self._target, self._left = self.pose, target, 1.0
        self._fitted = False

    def _jump(self, target: Pose) -> None:
        self._start = self._target = self.pose = target
        self._left = 0.0


def _moved(pose: Pose, dx: float, dy: float) -> Pose:
    return Pose(pose.x - dx / pose.scale, pose.y - dy / pose.scale, pose.scale)


def between(end: Pose, start: Pose, left: float) -> Pose:
    """The pose with share `left` of the way to go: log-scale linear, origin linear in 1/scale."""
    way = math.log(end.scale / start.scale)
    # (1/k - 1/k1) / (1/k0 - 1/k1), written so that it is exact for small and no zooms
    share = left if abs(way) < 1e-9 else math.expm1(left * way) / math.expm1(way)
    scale = end.scale * math.exp(-way * left)
    return Pose(
        end.x + (start.x - end.x) * share,
        end.y + (start.y - end.y) * share,
        scale,
    )
