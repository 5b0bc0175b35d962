"""Where each tile of a document is: nowhere yet, coded in main memory, or shown by the GPU.

Bookkeeping only, no OpenGL: `next` says what to fetch, `evict` what has to go, and both keep to
budgets. The worker's thread writes what is coded, the window's thread what is shown; each only
reads what the other writes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from gsasr.view import View

from .coverage import REACH, Rectangle

if TYPE_CHECKING:
    from gsasr.coded import CodedGaussians
    from gsasr.gaussians import Gaussians


class TileStore:
    """The tiles of one picture, by their number.

    A tile is a rectangle of the picture and the Gaussians predicted for it. A view needs those
    that reach into it; below 1:1, where the source is shown, it needs none.
    """

    def __init__(
        self,
        cores: list[Rectangle],
        predict: Callable[[int], Gaussians] | None = None,
        memory: int | None = None,
    ) -> None:
        """cores: of all tiles, source pixels; together they cover the picture.

        predict: makes the Gaussians of a tile; None where they are all kept by `keep` at once and
        could not be made again. memory: bytes of coded copies to hold; by default half of what
        is free. Without `predict` there is no limit.
        """
        from gsasr.memory import available

        self.cores = cores
        self._predict = predict
        self._memory = available() // 2 if memory is None else memory
        corners = np.array(cores, float).reshape(-1, 4)
        self._middle = (corners[:, :2] + corners[:, 2:]) / 2
        self._area = np.prod(corners[:, 2:] - corners[:, :2], axis=1)
        self._reach = corners + np.array([-REACH, -REACH, REACH, REACH])
        self._coded: list[CodedGaussians | None] = [None] * len(cores)
        self._held = np.zeros(len(cores), bool)  # coded
        self._count = np.zeros(len(cores), np.int64)  # Gaussians, where coded
        self._coded_size = Sizes(self._area)
        self._shown = np.zeros(len(cores), bool)
        self._shown_size = Sizes(self._area)
        self._seen = np.zeros(len(cores), np.int64)  # when a view last showed it; 0: never
        self._clock = 0

    # What there is

    @property
    def count(self) -> int:
        """How many Gaussians are held."""
        return int(self._count.sum())

    @property
    def share(self) -> float:
        """Of the tiles, how many are held, in [0, 1]."""
        return float(self._held.mean())

    @property
    def complete(self) -> bool:
        """Are all tiles held?"""
        return bool(self._held.all())

    @property
    def coded_bytes(self) -> int:
        """Of main memory, for coded copies."""
        return int(self._coded_size.bytes[self._held].sum())

    @property
    def shown_bytes(self) -> int:
        """Of video memory, for what is shown."""
        return int(self._shown_size.bytes[self._shown].sum())

    @property
    def any_shown(self) -> bool:
        """Is a tile on the GPU?"""
        return bool(self._shown.any())

    def holds(self, index: int) -> bool:
        """Is there a coded copy?"""
        return bool(self._held[index])

    def visible(self, view: View) -> list[int]:
        """The tiles that reach into a view, at any scale, the nearest to its middle first."""
        inside, distance = self._meets(view), self._distance(view)
        return [int(i) for i in np.lexsort((distance, ~inside))[: inside.sum()]]

    # What to do

    def next(self, view: View, budget: int, eager: bool = True) -> tuple[int, bool] | None:
        """The tile to fetch now, and whether to show it; None if there is nothing to do.

        First those that the view needs, the nearest to its middle first, as many as fit into
        `budget` bytes on the GPU; what else is there makes room for them. Then, if `eager`, the
        rest, as long as there is room left: in main memory, and perhaps on the GPU.
        """
        needed, distance = self._needed(view), self._distance(view)
        order = np.lexsort((distance, ~needed))
        size = self._shown_size.expected()
        first, rest = order[: needed.sum()], order[needed.sum() :]
        fits = (np.cumsum(size[first]) <= budget) & (budget > 0)
        missing = first[fits & ~self._shown[first]]
        if len(missing):
            return int(missing[0]), True
        if not eager:
            return None
        room = budget - self.shown_bytes
        can_show = ~needed & (size <= room) & (room > 0)
        can_code = self.coded_bytes + self._coded_size.expected() <= self._memory
        held = self._held
        worth = ~self._shown & ((held & can_show) | (~held & can_code))
        rest = order[worth[order]]
        return (int(rest[0]), bool(can_show[rest[0]])) if len(rest) else None

    def gaussians(self, index: int) -> Gaussians:
        """Of a tile: from its coded copy, else predicted."""
        coded = self._coded[index]
        return self._predict(index) if coded is None else coded.decode()

    def keep(self, index: int, gaussians: Gaussians, view: View | None = None) -> None:
        """Hold a coded copy of a tile; where memory is short, those far from the view go."""
        from gsasr.coded import encode
        from gsasr.rasterize import footprint

        coded = encode(gaussians)
        bounds = np.array(footprint.bounds(gaussians, "export"))
        reach = self._reach[index]
        if bounds.any():  # else nothing is drawn
            reach[:2], reach[2:] = np.fmin(reach[:2], bounds[:2]), np.fmax(reach[2:], bounds[2:])
        self._coded_size.learn(index, coded.nbytes)
        self._coded[index], self._held[index], self._count[index] = coded, True, len(coded)
        while self._predict is not None and self.coded_bytes > self._memory:
            farthest = int(np.argmax(np.where(self._held, self._distance(view), -1.0)))
            self._coded[farthest], self._held[farthest], self._count[farthest] = None, False, 0

    def show(self, index: int, size: int) -> None:
        """A tile is on the GPU now, with so many bytes."""
        self._shown_size.learn(index, size)
        self._shown[index] = True

    def touch(self, view: View) -> None:
        """The view is on the screen: the tiles that it needs are in use."""
        self._clock += 1
        self._seen[self._needed(view) & self._shown] = self._clock

    def evict(self, view: View, budget: int) -> list[int]:
        """What must leave the GPU for the rest to fit: it counts as not shown from now on.

        First what the view does not need, the least recently seen first, then the farthest.
        """
        needed, distance = self._needed(view), self._distance(view)
        seen = np.where(needed, 0, self._seen)
        gone, total = [], self.shown_bytes
        for index in np.lexsort((-distance, seen, needed)):
            if total <= budget:
                break
            if self._shown[index]:
                self._shown[index] = False
                total -= int(self._shown_size.bytes[index])
                gone.append(int(index))
        return gone

    def _needed(self, view: View) -> np.ndarray:
        return self._meets(view) & (min(view.scale) > 1)

    def _meets(self, view: View) -> np.ndarray:
        x0, y0 = view.origin
        x1, y1 = view.to_source(view.size[1], view.size[0])
        left, top, right, bottom = self._reach.T
        return (left < x1) & (x0 < right) & (top < y1) & (y0 < bottom)

    def _distance(self, view: View) -> np.ndarray:
        middle = view.to_source(view.size[1] / 2, view.size[0] / 2)
        return ((self._middle - middle) ** 2).sum(axis=1)


class Sizes:
    """Bytes of each tile, once known; of the others, what is likely from their area."""

    def __init__(self, area: np.ndarray) -> None:
        self.bytes = np.zeros(len(area), np.int64)
        self._known = np.zeros(len(area), bool)
        self._area = area

    def learn(self, index: int, size: int) -> None:
        """A tile takes so many bytes."""
        self.bytes[index], self._known[index] = size, True

    def expected(self) -> np.ndarray:
        """Of all tiles; 0 as long as none is known."""
        known = self._known
        density = self.bytes[known].sum() / max(1.0, self._area[known].sum())
        return np.where(known, self.bytes, density * self._area)
