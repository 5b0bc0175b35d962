"""Keeps the canvas up to date without ever spending much more than a frame's budget on it.

While the view moves it is drawn as small as the budget demands, and shown enlarged; once it
rests, it is drawn exactly, some rows per frame. On a fast GPU every frame is exact.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import moderngl
import numpy as np

from gsasr.view import View

from .clock import Clock
from .rates import Rates
from .scene import Overlay, Scene, Target

BUDGET = 0.008  # seconds of drawing per frame: leaves half of a frame at 60 Hz to all the rest
# Where the CPU draws, there is nothing beside it to wait for, and 30 frames a second have to do.
SOFTWARE_BUDGET = 0.016
PATIENCE = 1.75  # times the budget for a frame at rest, when nothing on the screen moves
REST = 0.05  # seconds without a change of view after which the picture is made exact
REDUCTIONS = (1, 2, 3, 4, 6, 8)
MIN_ROWS = 4  # of a slice
LEAST = 0.25  # of the budget that drawing has even if other work has used up the frame
NOTHING = Overlay()
# First guesses for a small GPU: seconds per pixel at 1:1 of the Gaussians and of what shows them
GAUSSIANS, PASS = 4e-8, 1e-9
SLOWER = 30  # times, where the CPU draws


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
        self.target: Target | None = None  # rows [0, self._drawn) show the present view
        self.seconds = 0.0  # that the last drawing measured took
        self.reduction = 1  # canvas pixels per drawn pixel of the rows below
        self._scene = scene
        self._clock = Clock(scene.ctx)
        self.budget = SOFTWARE_BUDGET if self._clock.software else BUDGET
        self._small: Target | None = None
        self._shown: tuple[View, Overlay] | None = None
        self._drawn = 0  # rows of the target, from its top
        self._stale = (0, 0)  # of those, the rows [first, last) not exact or out of date
        self._changed = -math.inf  # when the view did
        slower = SLOWER if self._clock.software else 1
        self._gaussians = Rates(GAUSSIANS * slower)  # per pixel and tile that lies there
        self._passes = Rates(PASS * slower)  # per pixel of the pass that puts all together
        self._marks = 0.0  # seconds that the overlay took

    def invalidate(self, rows: tuple[float, float] = (-math.inf, math.inf)) -> None:
        """Draw these output rows of the present view again: what they show has changed."""
        start, stop = math.floor(max(rows[0], 0)), math.ceil(min(rows[1], self._drawn))
        if start < stop:
            first, last = self._stale if self._stale[0] < self._stale[1] else (start, stop)
            self._stale = min(first, start), max(last, stop)

    def reset(self) -> None:
        """Forget what is on screen: the document is another one."""
        self._shown, self._drawn, self._stale = None, 0, (0, 0)

    @property
    def busy(self) -> bool:
        """Is there something left to draw?"""
        unfinished = self._shown is not None and self._drawn < self._shown[0].size[0]
        return unfinished or self._stale[0] < self._stale[1]

    def layers(self) -> list[Layer]:
        """What to show, the lowest first."""
        height, width = self.target.size
        exact = Layer(self.target.texture, 0, self._drawn, 1, 0, self._drawn / height)
        if self._drawn == height:
            return [exact]
        rows, columns = (side * self.reduction for side in self._small.size)
        small = Layer(self._small.texture, 0, height, width / columns, 0, height / rows)
        return [small, exact]

    def paint(self, view: View, overlay: Overlay, spent: float = 0.0) -> bool:
        """Bring what is shown closer to the view, within the budget; True if it changed.

        spent: seconds of this frame that other work has taken already.
        """
        self._clock.tick()
        now = time.perf_counter()
        budget = max(self.budget - spent, LEAST * self.budget)
        if self.target is None or self.target.size != view.size:
            self.target = self._resized(self.target, view.size)
            self.reset()
        if self._shown is None or self._shown[0] != view:
            if self._shown is not None:
                self._changed = now
            self._shown = view, overlay
            self._draw_all(view, overlay, budget)
            return True
        if self._shown[1] != overlay:
            self._shown = view, overlay
            self.invalidate()
        if self.busy and now - self._changed > REST:
            self._refine(view, overlay, PATIENCE * budget)
            return True
        return False

    def _draw_all(self, view: View, overlay: Overlay, budget: float) -> None:
        """The whole view at once, as well as the budget allows."""
        wanted = self._scene.share(min(view.scale)), overlay
        # An overlay that takes too long comes when the view rests.
        if overlay != NOTHING and self._marks > budget / 2:
            overlay = NOTHING
        marks = self._marks if overlay != NOTHING else 0.0
        self.reduction, share = self._affordable(view, budget - marks)
        rows = view.size[0]
        if self.reduction == 1:
            self._draw(self.target, view, overlay, (0, rows), share)
            exact = (share, overlay) == wanted
            self._drawn, self._stale = rows, (0, 0) if exact else (0, rows)
            return
        small = _reduced(view, self.reduction)
        if self._small is None or self._small.size != small.size:
            self._small = self._resized(self._small, small.size)
            self._small.texture.filter = (moderngl.LINEAR, moderngl.LINEAR)
        self._draw(self._small, small, overlay, (0, small.size[0]), share)
        self._drawn, self._stale = 0, (0, 0)

    def _refine(self, view: View, overlay: Overlay, budget: float) -> None:
        """A slice; more of them if the budget allows, which is known at once of software only."""
        left, deadline = budget, time.perf_counter() + budget
        while self.busy and left > budget / 3:
            self._sharpen(view, overlay, left)
            left = deadline - time.perf_counter() if self._clock.software else 0.0

    def _sharpen(self, view: View, overlay: Overlay, budget: float) -> None:
        """Some more rows, exactly: first those never drawn, then those out of date."""
        if not self._scene.marked(view, overlay):
            self._mark(view, overlay)  # that is enough for one frame
            return
        height = view.size[0]
        start, stop = (self._drawn, height) if self._drawn < height else self._stale
        scale = min(view.scale)
        share = self._scene.share(scale)
        covered = self._covered(view, share)[start:stop]
        seconds = np.cumsum(self._seconds(scale, view.size[1], covered))
        affordable = int(np.searchsorted(seconds, budget))
        stop = min(stop, start + max(MIN_ROWS, affordable))
        self._draw(self.target, view, overlay, (start, stop), share)
        if self._drawn < height:
            self._drawn = stop
        else:
            self._stale = stop, self._stale[1]
        if self._drawn == height:
            self.reduction = 1

    def _affordable(self, view: View, budget: float) -> tuple[int, float]:
        """How small to draw a view, and with what share of Gaussians.

        Gaussians at least as finely as the picture has pixels; if that takes too long, the source.
        """
        scale = min(view.scale)
        share = self._scene.share(scale)
        pixels, covered = view.size[0] * view.size[1], self._covered(view, share).sum()
        for shown in (share, 0.0):
            for reduction in REDUCTIONS:
                if shown > 0 and scale / reduction < 1:
                    break
                area = reduction**2
                work = pixels / area, covered / area if shown > 0 else 0.0
                if self._seconds(scale / reduction, *work) <= budget:
                    return reduction, shown
        return REDUCTIONS[-1], 0.0

    def _covered(self, view: View, share: float) -> np.ndarray:
        """(h,) pixels of each row that Gaussians are drawn on."""
        return self._scene.work(view) if share > 0 else np.zeros(view.size[0])

    def _seconds(
        self, scale: float, pixels: float, covered: float | np.ndarray
    ) -> float | np.ndarray:
        """What so many pixels are expected to take, so many of them covered by Gaussians."""
        return pixels * self._passes.predict(scale) + covered * self._gaussians.predict(scale)

    def _draw(
        self, target: Target, view: View, overlay: Overlay, rows: tuple[int, int], share: float
    ) -> None:
        if not self._scene.marked(view, overlay):
            self._mark(view, overlay)
        scale = min(view.scale)
        pixels = (rows[1] - rows[0]) * view.size[1]
        covered = self._covered(view, share)[slice(*rows)].sum()

        def learn(seconds: float) -> None:
            """What took the most is held to be what was misjudged."""
            self.seconds = seconds
            ratio = seconds / self._seconds(scale, pixels, covered)
            most = self._gaussians
            if covered * most.predict(scale) < pixels * self._passes.predict(scale):
                most = self._passes
            most.learn(scale, ratio * most.predict(scale))

        with self._clock.measure(learn):
            self._scene.draw(target, view, overlay, rows, share)

    def _mark(self, view: View, overlay: Overlay) -> None:
        def learn(seconds: float) -> None:
            self._marks = seconds

        with self._clock.measure(learn):
            self._scene.mark(view, overlay)

    def _resized(self, target: Target | None, size: tuple[int, int]) -> Target:
        made = Target(self._scene.ctx, size)  # first: if there is no room, the old one stays
        if target is not None:
            target.release()
        return made


def _reduced(view: View, reduction: int) -> View:
    """The same part of the picture in fewer pixels."""
    size = tuple(-(-side // reduction) for side in view.size)
    return View(view.origin, tuple(side / reduction for side in view.scale), size)
