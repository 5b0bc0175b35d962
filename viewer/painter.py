"""Keeps the canvas up to date without ever spending much more than a frame's budget on it.

While the view moves, Gaussians are drawn as coarsely as the budget demands; once it rests, the
canvas is redrawn exactly, some rows per frame. On a GPU that is fast enough both are one step.
"""

from __future__ import annotations

import math
import time

from gsasr.view import View

from .scene import Overlay, Scene, Seconds, Target

BUDGET = 0.014  # seconds of drawing per frame
REST = 0.1  # seconds without a change of view after which the picture is made exact
COARSENESS = (1, 2, 3, 4, 6, 8)
MIN_ROWS = 16
NOTHING = Overlay()


class Painter:
    """Draws a scene into a texture of the canvas' size."""

    def __init__(self, scene: Scene) -> None:
        self.target: Target | None = None
        self.seconds = 0.0  # that the last drawing took
        self.coarseness = 1  # of what is on screen now
        self._scene = scene
        self._shown: tuple[View, Overlay] | None = None
        self._todo = (0, 0)  # rows that are not exact yet
        self._changed = -math.inf  # when the view did
        # What things cost, learned as they are drawn
        self._sample = Average(2e-8)  # seconds per sample of the Gaussians
        self._pixel = Average(2e-9)  # per pixel of the last pass
        self._marks = Average(0.0)  # per overlay

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

    def paint(self, view: View, overlay: Overlay) -> bool:
        """Bring the texture closer to the view, within the budget; True if it changed."""
        now = time.perf_counter()
        if self.target is None or self.target.size != view.size:
            if self.target is not None:
                self.target.release()
            self.target = Target(self._scene.ctx, view.size)
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
        """All rows at once, as well as the budget allows."""
        # An overlay that takes longer than a frame comes when the view rests.
        if moving and self._marks.value > BUDGET:
            overlay = NOTHING
        self.coarseness = self._affordable(view)
        self._draw(view, overlay, (0, view.size[0]), self.coarseness)
        exact = self.coarseness == 1 and overlay == self._shown[1]
        self._todo = (0, 0) if exact else (0, view.size[0])

    def _sharpen(self, view: View, overlay: Overlay) -> None:
        """Some more rows, exactly."""
        start, stop = self._todo
        row = view.size[1] * (self._pixel.value + self._gaussians(view) * self._sample.value)
        end = min(stop, start + max(MIN_ROWS, int(BUDGET / row)))
        self._draw(view, overlay, (start, end), 1)
        self._todo = (end, stop) if end < stop else (0, 0)
        if not self.busy:
            self.coarseness = 1

    def _gaussians(self, view: View) -> bool:
        return self._scene.share(min(view.scale)) > 0

    def _affordable(self, view: View) -> int:
        if not self._gaussians(view):
            return 1
        pixels = view.size[0] * view.size[1]
        left = max(BUDGET / 2, BUDGET - pixels * self._pixel.value)
        for coarseness in COARSENESS:
            if self._sample.value * pixels / coarseness**2 <= left:
                return coarseness
        return COARSENESS[-1]

    def _draw(self, view: View, overlay: Overlay, rows: tuple[int, int], coarseness: int) -> None:
        took: Seconds = self._scene.draw(self.target, view, overlay, rows, coarseness)
        self.seconds = took.field + took.picture + took.overlay
        pixels = (rows[1] - rows[0]) * view.size[1]
        if took.field:
            self._sample.learn(took.field * coarseness**2 / pixels)
        self._pixel.learn(took.picture / pixels)
        if overlay != NOTHING and rows[0] == 0:
            self._marks.learn(took.overlay)


class Average:
    """A running mean that follows a load within a few frames."""

    WEIGHT = 0.4  # of the newest value

    def __init__(self, value: float) -> None:
        self.value = max(value, 1e-12)

    def learn(self, value: float) -> None:
        """Take one more measurement."""
        self.value = max(self.value + self.WEIGHT * (value - self.value), 1e-12)
