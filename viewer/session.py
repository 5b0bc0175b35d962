"""What the user can do, without a window: each action is one method, called by keys and menus."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from gsasr.errors import BackendError, Cancelled, GsasrError
from gsasr.view import View

from . import export, loading
from .camera import Camera
from .coverage import REACH
from .painter import Painter
from .scene import Overlay, Scene
from .state import (
    CONDITION,
    LEAST_MEMORY,
    OVERLAYS,
    SIGMA,
    Document,
    Message,
    Rectangle,
    State,
)
from .store import TileStore
from .worker import Task, Worker

NOTE_SECONDS = 6.0
KEY_ZOOM = 0.5  # octaves per press of + or -
KEY_PAN = 0.15  # of the canvas per press of an arrow
ROOM = 0.9  # of what the GPU held when it was full that it may hold from then on


class Session:
    """The document, the camera, the worker, and the actions on them."""

    def __init__(self, model: str, condition: float, gpu_memory: int | None = None) -> None:
        """gpu_memory: bytes of Gaussians that the GPU may hold; by default as the driver tells."""
        self.state = State(model=model, condition=condition)
        self.camera = Camera()
        self.worker = Worker(on_error=self.fail)
        self.scene: Scene | None = None
        self.painter: Painter | None = None
        self.quitting = False
        self._loader = loading.Loader()
        self._gpu_memory = gpu_memory
        self._stopped: View | None = None  # the view at which fetching tiles was cancelled

    def start(self, scene: Scene) -> None:
        """There is an OpenGL context now."""
        from gsasr.rasterize.driver import video_memory

        self.scene, self.painter = scene, Painter(scene)
        self.state.gpu_memory = self._gpu_memory or video_memory(scene.ctx).budget

    # Documents

    def open(self, path: str | os.PathLike) -> None:
        """Open a picture or a saved field instead of the present one."""
        path = Path(path).expanduser()
        try:
            loading.check_path(path)
        except GsasrError as error:
            self.fail(str(error))
            return
        self.worker.cancel_all()
        model, condition = self.state.model, self.state.condition

        def work(task: Task) -> None:
            document = self._loader.open(task, path)
            self.worker.show(task, lambda: self._show(document))
            if document.picture is not None:
                self._plan(task, document, model, condition)

        self.worker.post(f"Opening {path.name}", work)

    def predict(self, condition: float) -> None:
        """Predict the picture anew, conditioned at a scale."""
        document = self.state.document
        if document is None or document.picture is None:
            return
        condition = min(max(condition, CONDITION[0]), CONDITION[1])
        self.state.condition = condition
        self.worker.cancel_all()
        model = self.state.model
        self.worker.post(
            f"Predicting {document.path.name}",
            lambda task: self._plan(task, document, model, condition),
        )

    def follow(self) -> None:
        """Once per frame: have the worker fetch tiles if there is something for it to do."""
        tiles = self.state.document.tiles if self.state.document is not None else None
        if tiles is None:
            return
        view = self.camera.view()
        tiles.touch(view)
        if self.worker.tasks or view == self._stopped or self._next_tile(tiles) is None:
            return
        document = self.state.document
        self.worker.post(
            f"Loading {document.path.name}", lambda task: self._fetch(task, document, tiles)
        )

    def save_field(self, path: Path) -> None:
        """Save the Gaussians to a file that opens without the network."""
        document = self.state.document

        def work(task: Task) -> None:
            from dataclasses import replace

            from gsasr.gaussians import Gaussians
            from gsasr.memory import require_field

            tiles = document.tiles
            require_field(tiles.count)
            parts = [tiles.gaussians(index) for index in range(len(tiles.cores))]
            field = Gaussians.concatenate(parts)
            replace(field, source=document.path.name).save(path)
            self.worker.show(task, lambda: self.note(f"Saved {path}"))

        if self.ready:
            self.worker.post(f"Saving {path.name}", work)

    def export(self, view: View, path: Path, antialias: bool) -> None:
        """Write the Gaussians through a view to a picture file; antialias: see gsasr.render."""
        document = self.state.document

        def work(task: Task) -> None:
            export.export(task, document, view, path, antialias)
            size = f"{view.size[1]}×{view.size[0]}"
            self.worker.show(task, lambda: self.note(f"Exported {size} pixels to {path}"))

        if self.can_export:
            self.worker.post(f"Exporting {path.name}", work)

    @property
    def ready(self) -> bool:
        """Is there a document whose Gaussians are all held?"""
        return self.state.document is not None and self.state.document.complete

    @property
    def can_export(self) -> bool:
        """Is there a document, and what makes its Gaussians?"""
        return self.state.document is not None and self.state.document.tiles is not None

    # The view

    def fit(self) -> None:
        self.camera.fit()

    def one_to_one(self) -> None:
        self.camera.one_to_one(self.state.cursor)

    def zoom_in(self) -> None:
        self.camera.zoom(KEY_ZOOM)

    def zoom_out(self) -> None:
        self.camera.zoom(-KEY_ZOOM)

    def pan(self, x: float, y: float) -> None:
        """Move the view by shares of KEY_PAN of the canvas: (1, 0) shows more of the right."""
        height, width = self.camera.view().size
        step = KEY_PAN * min(width, height)
        self.camera.pan(-x * step, -y * step, smooth=True)

    # Settings

    def set_overlay(self, kind: str) -> None:
        """Show "none", "centers" or "ellipses"."""
        assert kind in OVERLAYS
        self.state.overlay = kind

    def toggle_overlay(self, kind: str) -> None:
        """Show an overlay, or none if it is on."""
        self.set_overlay("none" if self.state.overlay == kind else kind)

    def set_sigma(self, sigma: float) -> None:
        """Draw ellipses at so many standard deviations."""
        self.state.sigma = min(max(sigma, SIGMA[0]), SIGMA[1])

    def set_gpu_memory(self, size: int) -> None:
        """Let the GPU hold so many bytes of Gaussians."""
        self.state.gpu_memory = max(LEAST_MEMORY, size)
        self._make_room()

    def toggle_dialog(self, name: str) -> None:
        """Open or close the dialog of that name."""
        self.state.dialogs ^= {name}

    def overlay(self) -> Overlay:
        """What to draw over the picture now."""
        return Overlay(self.state.overlay, self.state.sigma)

    def escape(self) -> None:
        """Close what is open; if nothing is, stop what is running."""
        if self.state.dialogs:
            self.state.dialogs.clear()
        elif self.state.message is not None:
            self.state.message = None
        else:
            self.cancel()

    def cancel(self) -> None:
        """Stop what is running; from now on only tiles that one goes to are predicted."""
        self._stop()
        self.worker.cancel_all()

    def quit(self) -> None:
        self.quitting = True

    def note(self, text: str) -> None:
        """Tell the user something good."""
        self.state.message = Message(text, error=False, seconds=NOTE_SECONDS)

    def fail(self, sentence: str) -> None:
        """Tell the user what went wrong."""
        self.state.message = Message(sentence, error=True, seconds=float("inf"))

    # From the worker

    def _show(self, document: Document) -> None:
        self.state.document = document
        self.state.message = None
        self._stopped = None
        self.scene.set_picture(document.pixels)
        self.camera.set_picture(document.size)
        self.painter.reset()

    def _plan(self, task: Task, document: Document, model: str, condition: float) -> None:
        """On the worker: have the tiles of a picture predicted from now on."""
        tiles = self._loader.plan(task, document, model, condition)

        def begin() -> None:
            document.tiles, self._stopped = tiles, None

        self.worker.show(task, begin)

    def _next_tile(self, tiles: TileStore) -> tuple[int, bool] | None:
        """What to fetch; once cancelled, no more than what one looks at."""
        eager = self._stopped is None
        return tiles.next(self.camera.view(), self.state.gpu_memory, eager)

    def _fetch(self, task: Task, document: Document, tiles: TileStore) -> None:
        """On the worker: one tile after another, until there are no more or another task waits."""
        from gsasr.rasterize.gl import pack, split_tiles

        try:
            while self.worker.tasks == [task] and (wanted := self._next_tile(tiles)) is not None:
                index, shown = wanted
                what = "Loading" if tiles.holds(index) else "Predicting"
                task.progress(tiles.share, f"{what} {document.path.name}")
                gaussians = tiles.gaussians(index)
                if not tiles.holds(index):
                    tiles.keep(index, gaussians, self.camera.view())
                task.check()
                if shown:
                    pieces = [pack(piece) for piece in split_tiles(gaussians)]
                    self.worker.carry_out(task, self._arrive(tiles, index, pieces))
        except Cancelled:
            raise
        except Exception:
            self.worker.show(None, self._stop)  # else it would begin again at once
            raise

    def _stop(self) -> None:
        self._stopped = self.camera.view()

    def _arrive(self, tiles: TileStore, index: int, pieces: list) -> Iterator[None]:
        """On the window's thread, over several frames: show a tile, and make room for it."""
        core = tiles.cores[index]
        if not tiles.any_shown:  # what is there is of an earlier prediction
            self.scene.clear_tiles()
            self.painter.invalidate()
        try:
            for piece in pieces:
                self.scene.add_tile(piece)
                yield
            tiles.show(index, self.scene.cover(core))
            self._repaint(core)
        except BackendError:
            held = tiles.shown_bytes
            self.state.gpu_memory = int(ROOM * held)
            self.fail(
                f"The GPU has no room for more than {held / 2**20:.0f} MiB of Gaussians; "
                "what does not fit shows as the source picture."
            )
        finally:
            self.scene.drop_arriving()
        self._make_room()

    def _make_room(self) -> None:
        """Take off the GPU what is beyond its budget."""
        document = self.state.document
        if document is None or document.tiles is None:
            return
        for index in document.tiles.evict(self.camera.view(), self.state.gpu_memory):
            self.scene.uncover(document.tiles.cores[index])
            self._repaint(document.tiles.cores[index])

    def _repaint(self, core: Rectangle) -> None:
        """The Gaussians of a rectangle have come or gone."""
        view = self.camera.view()
        left, top = view.to_output(core[0] - REACH, core[1] - REACH)
        right, bottom = view.to_output(core[2] + REACH, core[3] + REACH)
        if left < view.size[1] and right > 0:
            self.painter.invalidate((top, bottom))
