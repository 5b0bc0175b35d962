"""What the user can do, without a window: each action is one method, called by keys and menus."""

from __future__ import annotations

import os
from pathlib import Path

from gsasr.errors import GsasrError
from gsasr.view import View

from . import export, loading
from .camera import Camera
from .mipmaps import Mipmaps, mipmaps
from .painter import Painter
from .scene import Overlay, Scene
from .state import (
    CONDITION,
    LEAST_MEMORY,
    OVERLAYS,
    SIGMA,
    Document,
    Message,
    State,
)
from .streaming import Streaming
from .worker import Task, Worker

NOTE_SECONDS = 6.0
KEY_ZOOM = 0.5  # octaves per press of + or -
KEY_PAN = 0.15  # of the canvas per press of an arrow


class Session:
    """The document, the camera, the worker, and the actions on them."""

    def __init__(self, model: str, condition: float, gpu_memory: int | None = None) -> None:
        """gpu_memory: bytes of Gaussians that the GPU may hold; by default as the driver tells."""
        self.state = State(model=model, condition=condition)
        self.camera = Camera()
        self.worker = Worker(on_error=self.fail)
        self.scene: Scene | None = None
        self.painter: Painter | None = None
        self.streaming: Streaming | None = None
        self.quitting = False
        self._loader = loading.Loader()
        self._gpu_memory = gpu_memory  # state.gpu_memory is less once the GPU was full

    def start(self, scene: Scene) -> None:
        """There is an OpenGL context now."""
        from gsasr.rasterize.driver import video_memory

        self.scene, self.painter = scene, Painter(scene)
        self.streaming = Streaming(
            self.state, self.camera, self.worker, scene, self.painter, self.fail
        )
        self._gpu_memory = self._gpu_memory or video_memory(scene.ctx).budget
        self.state.gpu_memory = self._gpu_memory

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
            levels = mipmaps(document.pixels)
            self.worker.show(task, lambda: self._show(document, levels))
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

    def save_field(self, path: Path) -> None:
        """Save the Gaussians to a file that opens without the network."""
        document = self.state.document

        def work(task: Task) -> None:
            from dataclasses import replace

            from gsasr.gaussians import Gaussians
            from gsasr.memory import require_field

            tiles = document.tiles
            require_field(tiles.count)
            parts = []
            for index in range(len(tiles.cores)):
                task.check()
                parts.append(tiles.gaussians(index))
            field = Gaussians.concatenate(parts)
            task.check()
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
        self.state.gpu_memory = self._gpu_memory = max(LEAST_MEMORY, size)
        self.streaming.make_room()

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
        self.streaming.stop()
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

    def _show(self, document: Document, levels: Mipmaps) -> None:
        self.scene.show_picture(levels)
        self.camera.set_picture(document.size)
        self.painter.reset()
        self.state.message = None
        self.state.document = document
        self._stream()

    def _plan(self, task: Task, document: Document, model: str, condition: float) -> None:
        """On the worker: have the tiles of a picture predicted from now on."""
        tiles, name = self._loader.plan(task, document, model, condition)

        def begin() -> None:
            document.tiles, document.model, document.condition = tiles, name, condition
            self._stream()

        self.worker.show(task, begin)

    def _stream(self) -> None:
        """There are other tiles: fetch them, and try again all the room that the GPU may have."""
        self.state.gpu_memory = self._gpu_memory
        self.streaming.restart()
