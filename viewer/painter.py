"""Keeps the canvas up to date without ever spending much more than a frame's budget on it.

While the view moves it is drawn as small as the budget demands, and shown enlarged; once it
rests, it is drawn exactly, some rows per frame. On a fast GPU every frame is exact.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import moderngl

from gsasr.view import View

from .scene import Overlay, Scene, Target

BUDGET = 0.014  # seconds of drawing per frame while the view moves
PATIENCE = 2.0  # as much of it per frame at rest, when nobody waits for the next one
REST = 0.1  # seconds without a change of view after which the picture is made exact
REDUCTIONS = (1, 2, 3, 4, 6, 8)
MIN_ROWS = 16
NOTHING = Overlay()


@dataclass(frozen=True)
class Layer:
    """A texture's rectangle from (0, v0) to (u1, v1), shown over canvas rows [y0, y1)."""

    texture: moderngl.Texture
    y0: float
    y1: float
    u1: float
    v0: float
    v1: float


class Painter:
    """Draws a scene for a canvas."""

    def __init__(self, scene: Scene) -> None:
        self.target: Target | None = None  # exact where it is not to be done yet
        self.seconds = 0.0  # that the last drawing took
        self.reduction = 1  # canvas pixels per drawn pixel of what is not exact
        self._scene = scene
        self._small: Target | None = None
        self._shown: tuple[View, Overlay] | None = None
        self._todo = (0, 0)  # rows of the target that are not exact yet
        self._changed = -math.inf  # when the view did
        # Learned: seconds per pixel, without and with Gaussians, and per overlay
        self._rate = {False: Average(5e-9), True: Average(3e-8)}
        self._marks = Average(0.0)

    def invalidate(self, rows: tuple[float, float] = (-math.inf, math.inf)) -> None:
        """Draw these output rows of the present view again: what they show has changed."""
        if self._shown is None:
            return
        height = self._shown[0].size[0]
        start, stop = max(0, rows[0]), min(height, rows[1])
        if start < stop:
            first, last = self._todo if self.busy else (height, 0)
            self._todo = min(first, math.floor(start)), max(last, math.ceil(stop))

    def reset(self) -> None:
        """Forget what is on screen: the document is another one."""
        self._shown = None

    @property
    def busy(self) -> bool:
        """Is there something left to draw?"""
        return self._todo[0] < self._todo[1]

    def layers(self) -> list[Layer]:
        """What to show, the lowest first."""
        height, width = self.target.size
        if self.reduction == 1:
            return [Layer(self.target.texture, 0, height, 1, 0, 1)]
        rows, columns = (side * self.reduction for side in self._small.size)
        small = Layer(self._small.texture, 0, height, width / columns, 0, height / rows)
        done = self._todo[0]
        return [small, Layer(self.target.texture, 0, done, 1, 0, done / height)]

    def paint(self, view: View, overlay: Overlay) -> bool:
        """Bring what is shown closer to the view, within the budget; True if it changed."""
        now = time.perf_counter()
        if self.target is None or self.target.size != view.size:
            self.target = self._resized(self.target, view.size)
            self._shown = None
        if self._shown != (view, overlay):
            if self._shown is not None and self._shown[0] != view:
                self._changed = now
            self._shown = view, overlay
            self._draw_all(view, overlay, moving=now - self._changed < REST)
            return True
        if self.busy and now - self._changed > REST:
            self._sharpen(view, overlay)
            return True
        return False

    def _draw_all(self, view: View, overlay: Overlay, moving: bool) -> None:
        """The whole view at once, as well as the budget allows."""
        # An overlay that takes longer than a frame comes when the view rests.
        if moving and self._marks.value > BUDGET:
            overlay = NOTHING
        self.reduction = self._affordable(view, overlay)
        if self.reduction == 1:
            self._draw(self.target, view, overlay, (0, view.size[0]))
        else:
            size = tuple(-(-side // self.reduction) for side in view.size)
            scale = tuple(side / self.reduction for side in view.scale)
            if self._small is None or self._small.size != size:
                self._small = self._resized(self._small, size)
                self._small.texture.filter = (moderngl.LINEAR, moderngl.LINEAR)
            small = View(view.origin, scale, size)
            self._draw(self._small, small, overlay, (0, size[0]), min(view.scale))
        exact = self.reduction == 1 and overlay == self._shown[1]
        self._todo = (0, 0) if exact else (0, view.size[0])

    def _sharpen(self, view: View, overlay: Overlay) -> None:
        """Some more rows, exactly."""
        start, stop = self._todo
        rate = self._rate[self._scene.share(min(view.scale)) > 0].value
        end = min(stop, start + max(MIN_ROWS, int(PATIENCE * BUDGET / (rate * view.size[1]))))
        self._draw(self.target, view, overlay, (start, end))
        self._todo = (end, stop) if end < stop else (0, 0)
        if not self.busy:
            self.reduction = 1

    def _affordable(self, view: View, overlay: Overlay) -> int:
        pixels = view.size[0] * view.size[1]
        left = BUDGET if overlay == NOTHING else max(BUDGET / 2, BUDGET - self._marks.value)
        rate = self._rate[self._scene.share(min(view.scale)) > 0].value
        for reduction in REDUCTIONS:
            if rate * pixels / reduction**2 <= left:
                return reduction
        return REDUCTIONS[-1]

    def _draw(
        self,
        target: Target,
        view: View,
        overlay: Overlay,
        rows: tuple[int, int],
        zoom: float | None = None,
    ) -> None:
        zoom = zoom or min(view.scale)
        took = self._scene.draw(target, view, overlay, rows, zoom)
        self.seconds = took.picture + took.overlay
        pixels = (rows[1] - rows[0]) * view.size[1]
        self._rate[self._scene.share(zoom) > 0].learn(took.picture / pixels)
        if overlay != NOTHING and rows[0] == 0:
            self._marks.learn(took.overlay)

    def _resized(self, target: Target | None, size: tuple[int, int]) -> Target:
        if target is not None:
            target.release()
        return Target(self._scene.ctx, size)


class Average:
    """A running mean that follows a load within a few frames."""

    WEIGHT = 0.4  # of the newest value

    def __init__(self, value: float) -> None:
        self.value = max(value, 1e-12)

    def learn(self, value: float) -> None:
        """Take one more measurement."""
        self.value = max(self.value + self.WEIGHT * (value - self.value), 1e-12)
