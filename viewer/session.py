"""What the user can do, without a window: each action is one method, called by keys and menus."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from gsasr.errors import GsasrError
from gsasr.view import View

from . import export, loading
from .camera import Camera
from .coverage import REACH
from .mipmaps import Mipmaps, mipmaps
from .painter import Painter
from .scene import Overlay, Scene
from .state import CONDITION, OVERLAYS, SIGMA, Document, Message, Rectangle, State
from .worker import Task, Worker

NOTE_SECONDS = 6.0
KEY_ZOOM = 0.5  # octaves per press of + or -
KEY_PAN = 0.15  # of the canvas per press of an arrow


class Session:
    """The document, the camera, the worker, and the actions on them."""

    def __init__(self, model: str, condition: float) -> None:
        self.state = State(model=model, condition=condition)
        self.camera = Camera()
        self.worker = Worker(on_error=self.fail)
        self.scene: Scene | None = None
        self.painter: Painter | None = None
        self.quitting = False
        self._loader = loading.Loader()

    def start(self, scene: Scene) -> None:
        """There is an OpenGL context now."""
        self.scene, self.painter = scene, Painter(scene)

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
            document, tiles = self._loader.open(task, path)
            levels = mipmaps(document.pixels)
            self.worker.show(task, lambda: self._show(document, levels))
            if document.picture is not None:
                tiles = self._loader.predict(task, document, model, condition, self._center)
            self._arrive(task, document, tiles)

        self.worker.post(f"Opening {path.name}", work)

    def predict(self, condition: float) -> None:
        """Predict the picture anew, conditioned at a scale."""
        document = self.state.document
        if document is None or document.picture is None:
            return
        condition = min(max(condition, CONDITION[0]), CONDITION[1])
        self.state.condition = condition
        self.worker.cancel_all()
        document.complete = False
        model = self.state.model

        def forget() -> None:
            document.parts = []
            self.scene.clear_tiles()
            self.painter.invalidate()

        def work(task: Task) -> None:
            tiles = self._loader.predict(task, document, model, condition, self._center)
            for number, tile in enumerate(tiles):
                if number == 0:  # until then the old Gaussians stay on screen
                    self.worker.show(task, forget)
                self._arrive(task, document, [tile], last=False)
            self.worker.show(task, lambda: self._complete(document))

        self.worker.post(f"Predicting {document.path.name}", work)

    def follow(self) -> None:
        """Of a picture too large to hold all Gaussians, have those that one looks at."""
        document, camera = self.state.document, self.camera
        if document is None or not document.partial or camera.moving or self.worker.tasks:
            return
        view = camera.view()
        center = View(self._center(), view.scale, (1, 1))
        if view.scale[0] > 1 and not self.scene.covers(center):
            self.predict(self.state.condition)

    def save_field(self, path: Path) -> None:
        """Save the Gaussians to a file that opens without the network."""
        document = self.state.document

        def work(task: Task) -> None:
            from dataclasses import replace

            from gsasr.gaussians import Gaussians

            field = Gaussians.concatenate(document.parts)
            replace(field, source=document.path.name).save(path)
            self.worker.show(task, lambda: self.note(f"Saved {path}"))

        if self.ready:
            self.worker.post(f"Saving {path.name}", work)

    def export(self, view: View, path: Path, antialias: bool) -> None:
        """Write the Gaussians through a view to a picture file; antialias: see gsasr.render."""
        document = self.state.document
        model, condition = self.state.model, self.state.condition

        def upscale(task: Task, view: View) -> np.ndarray:
            return self._loader.upscale(task, document, model, condition, view, antialias)

        def work(task: Task) -> None:
            export.export(task, document, view, path, antialias, upscale)
            size = f"{view.size[1]}×{view.size[0]}"
            self.worker.show(task, lambda: self.note(f"Exported {size} pixels to {path}"))

        if document is not None:
            self.worker.post(f"Exporting {path.name}", work)

    @property
    def ready(self) -> bool:
        """Is there a document whose Gaussians have all arrived?"""
        return self.state.document is not None and self.state.document.complete

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

    def _center(self) -> tuple[float, float]:
        """The source point in the middle of the canvas; also asked by the worker."""
        view = self.camera.view()
        return view.to_source(view.size[1] / 2, view.size[0] / 2)

    def _show(self, document: Document, levels: Mipmaps) -> None:
        self.state.document = document
        self.state.message = None
        self.scene.show_picture(levels)
        self.camera.set_picture(document.size)
        self.painter.reset()

    def _arrive(self, task: Task, document: Document, tiles, last: bool = True) -> None:
        """On the worker: pack each tile and hand it to the window."""
        from gsasr.rasterize.gl import pack, split_tiles

        self.worker.show(task, self.scene.prepare)
        for part, core in tiles:
            for piece in split_tiles(part):
                task.check()
                packed = pack(piece)
                self.worker.show(task, lambda packed=packed: self._add(document, packed))
            self.worker.show(task, lambda part=part, core=core: self._cover(document, part, core))
        if last:
            self.worker.show(task, lambda: self._complete(document))

    def _add(self, document: Document, packed) -> None:
        if document is self.state.document:
            self.scene.add_tile(packed)

    def _cover(self, document: Document, part, core: Rectangle) -> None:
        if document is not self.state.document:
            return
        document.parts.append(part)
        self.scene.cover(core)
        view = self.camera.view()
        left, top = view.to_output(core[0] - REACH, core[1] - REACH)
        right, bottom = view.to_output(core[2] + REACH, core[3] + REACH)
        if left < view.size[1] and right > 0:
            self.painter.invalidate((top, bottom))

    def _complete(self, document: Document) -> None:
        document.complete = not document.partial
