"""Tiles of Gaussians come and go: what one looks at, then the rest, as long as there is room.

Each frame `follow` sees whether there is something to fetch, and has the worker do it. The worker
takes one tile after another from the store, which looks at the present view each time; the
window's thread uploads it, and takes off the GPU what is beyond its budget.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Generator

from gsasr.errors import BackendError, Cancelled, GsasrError
from gsasr.view import View

from .camera import Camera
from .coverage import REACH, Rectangle
from .painter import Painter
from .scene import Scene
from .state import Document, State
from .store import TileStore
from .worker import Task, Worker

RESULTS = 0.006  # seconds per frame for what the worker has sent, and for uploading the picture
ROOM = 0.9  # of what the GPU held when it was full that it may hold from then on


def deliver(worker: Worker, scene: Scene, painter: Painter) -> bool:
    """At the start of a frame: take what the worker has sent, then upload more of the picture.

    True if another frame should follow at once.
    """
    start = time.perf_counter()
    ran, loading = worker.deliver(RESULTS), scene.loading
    if loading and scene.load(start + RESULTS - time.perf_counter()):
        painter.invalidate()
    return ran or loading


class Streaming:
    """Keeps what the scene draws in step with the view, for one document after another."""

    def __init__(
        self,
        state: State,
        camera: Camera,
        worker: Worker,
        scene: Scene,
        painter: Painter,
        fail: Callable[[str], None],
    ) -> None:
        """fail: tells the user one sentence."""
        self._state, self._camera, self._worker = state, camera, worker
        self._scene, self._painter, self._fail = scene, painter, fail
        self._stopped: View | None = None  # the view at which fetching was stopped

    def restart(self) -> None:
        """Fetch all there is room for."""
        self._stopped = None

    def stop(self) -> None:
        """Fetch nothing until the view moves, and from then on only what it needs. Any thread."""
        self._stopped = self._camera.view()

    def follow(self) -> None:
        """Once per frame: have the worker fetch tiles if there is something for it to do."""
        document = self._state.document
        if document is None or document.tiles is None:
            return
        view, tiles = self._camera.view(), document.tiles
        tiles.touch(view)
        if self._worker.tasks or view == self._stopped or self._next(tiles) is None:
            return
        self._worker.post(
            f"Loading {document.path.name}", lambda task: self._fetch(task, document, tiles)
        )

    def make_room(self) -> None:
        """Take off the GPU what is beyond its budget."""
        document = self._state.document
        if document is None or document.tiles is None:
            return
        tiles = document.tiles
        for index in tiles.evict(self._camera.view(), self._state.gpu_memory):
            self._scene.uncover(tiles.cores[index])
            self._repaint(tiles.cores[index])

    def shrink(self) -> None:
        """The GPU is full: hold less from now on, and say so."""
        document = self._state.document
        held = document.tiles.shown_bytes if document and document.tiles else 0
        self._state.gpu_memory = int(ROOM * held)
        most = f"more than {held / 2**20:.1f} MiB of" if held else "any"
        self._fail(
            f"The GPU has no room for {most} Gaussians; "
            "what does not fit shows as the source picture."
        )
        self.make_room()

    def _next(self, tiles: TileStore) -> tuple[int, bool] | None:
        eager = self._stopped is None
        return tiles.next(self._camera.view(), self._state.gpu_memory, eager)

    def _fetch(self, task: Task, document: Document, tiles: TileStore) -> None:
        """On the worker: one tile after another, until there are no more or another task waits."""
        from gsasr.rasterize.gl import pack, split_tiles

        self._worker.carry_out(task, self._prepare())
        try:
            while self._worker.tasks == [task] and (wanted := self._next(tiles)) is not None:
                index, shown = wanted
                held = tiles.holds(index)
                what = "Loading" if held else "Predicting"
                task.progress(tiles.share, f"{what} {document.path.name}")
                gaussians = tiles.gaussians(index)
                task.check()
                if not held:
                    tiles.keep(index, gaussians, self._camera.view())
                if shown:
                    pieces = split_tiles(gaussians, most=self._scene.most)
                    if self._scene.packs:
                        pieces = [pack(piece) for piece in pieces]
                    self._worker.carry_out(task, self._arrive(tiles, index, pieces))
        except Cancelled:
            raise
        except Exception:
            self.stop()  # before the task is gone, else the next frame would begin it again
            raise

    def _prepare(self) -> Generator[None, None, None]:
        self._scene.prepare()
        yield

    def _arrive(self, tiles: TileStore, index: int, pieces: list) -> Generator[None, None, None]:
        """On the window's thread, over several frames: show a tile, and make room for it."""
        core = tiles.cores[index]
        if not tiles.any_shown:  # what is there is of an earlier prediction
            self._scene.clear_tiles()
            self._painter.invalidate()
        try:
            for piece in pieces:
                yield from self._scene.adding(piece)
            tiles.show(index, self._scene.cover(core))
            self._repaint(core)
        except BackendError:
            self.shrink()
        except GsasrError:  # malformed Gaussians; the worker tells, and ends the task
            self.stop()
            raise
        finally:
            self._scene.drop_arriving()
        self.make_room()

    def _repaint(self, core: Rectangle) -> None:
        """The Gaussians of a rectangle have come or gone."""
        view = self._camera.view()
        left, top = view.to_output(core[0] - REACH, core[1] - REACH)
        right, bottom = view.to_output(core[2] + REACH, core[3] + REACH)
        if left < view.size[1] and right > 0:
            self._painter.invalidate((top, bottom))
