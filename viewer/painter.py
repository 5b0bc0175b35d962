"""Keeps the canvas up to date without ever spending more than a frame's budget on it.

While the view moves, Gaussians are drawn as coarsely as the budget demands; once it rests, the
canvas is redrawn exactly, some rows per frame. On a GPU that is fast enough both are one step.
"""

from __future__ import annotations

import math
import time

from gsasr.view import View

from .scene import Overlay, Scene, Target

BUDGET = 0.014  # seconds of drawing per frame
REST = 0.1  # seconds without a change of view after which the picture is made exact
COARSENESS = (1, 2, 3, 4, 6, 8)
LEARNING = 0.4  # weight of the newest measurement of the cost of a pixel
MIN_ROWS = 8


class Painter:
    """Draws a scene into a texture of the canvas' size."""

    def __init__(self, scene: Scene) -> None:
        self.target: Target | None = None
        self.seconds = 0.0  # that the last drawing took
        self.coarseness = 1  # of what is on screen now
        self.overlay_drawn = True  # False where Gaussians lie too close together on screen
        self._scene = scene
        self._cost = 2e-7  # seconds per sample of Gaussians; learned
        self._shown: tuple[View, Overlay] | None = None
        self._todo = (0, 0)  # rows that are not exact yet
        self._changed = 0.0  # when the view did

    def invalidate(self, rows: tuple[float, float] = (-math.inf, math.inf)) -> None:
        """Draw these output rows of the present view again: what they show has changed."""
        if self._shown is None:
            return
        height = self._shown[0].size[0]
        start, stop = max(0, rows[0]), min(height, rows[1])
        if start < stop:
            first, last = self._todo if self._todo[0] < self._todo[1] else (height, 0)
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
            moved = self._shown is not None and self._shown[0] != view
            self._changed = now if moved else -math.inf
            self._shown = view, overlay
            coarseness = self._affordable(view)
            self._draw(view, overlay, (0, view.size[0]), coarseness)
            self._todo = (0, view.size[0]) if coarseness > 1 else (0, 0)
            self.coarseness = coarseness
            return True
        if self.busy and now - self._changed > REST:
            start, stop = self._todo
            rows = BUDGET / (self._cost * view.size[1]) if self._gaussians(view) else math.inf
            end = int(min(stop, start + max(MIN_ROWS, rows)))
            self._draw(view, overlay, (start, end), 1)
            self._todo = (end, stop) if end < stop else (0, 0)
            if not self.busy:
                self.coarseness = 1
            return True
        return False

    def _gaussians(self, view: View) -> bool:
        return self._scene.share(min(view.scale)) > 0

    def _affordable(self, view: View) -> int:
        if not self._gaussians(view):
            return 1
        for coarseness in COARSENESS:
            if self._cost * view.size[0] * view.size[1] / coarseness**2 <= BUDGET:
                return coarseness
        return COARSENESS[-1]

    def _draw(self, view: View, overlay: Overlay, rows: tuple[int, int], coarseness: int) -> None:
        start = time.perf_counter()
        self.overlay_drawn = self._scene.draw(self.target, view, overlay, rows, coarseness)
        self._scene.ctx.finish()
        self.seconds = time.perf_counter() - start
        if self._gaussians(view):
            samples = (rows[1] - rows[0]) * view.size[1] / coarseness**2
            self._cost += LEARNING * (self.seconds / max(1.0, samples) - self._cost)
