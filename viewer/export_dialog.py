"""The export dialog: which part, how large, into which file."""

from __future__ import annotations

import math
from contextlib import suppress
from pathlib import Path

from imgui_bundle import imgui

from gsasr.errors import GsasrError
from gsasr.view import View

from . import export
from .file_dialogs import PathField
from .session import Session
from .status import ERROR


class ExportDialog:
    """Choices of an export; shows the resulting size before anything is done."""

    name = "Export"

    def __init__(self) -> None:
        self.whole = True
        self.by_scale = True
        self.scale = 4.0
        self.antialias = True
        self.width = 0
        self.height = 0
        self._document = None
        self._path = PathField(("Pictures", "*.png *.tif *.jpg *.webp"))

    def draw(self, session: Session) -> None:
        """Called each frame while it is open."""
        document = session.state.document
        if document is None:
            session.state.dialogs.discard(self.name)
            return
        if document is not self._document:
            self._document = document
            self.height, self.width = (4 * side for side in document.size)
            self.scale = 4.0
        center = imgui.get_main_viewport().get_center()
        imgui.set_next_window_pos(center, imgui.Cond_.appearing, (0.5, 0.5))
        flags = imgui.WindowFlags_.no_saved_settings | imgui.WindowFlags_.always_auto_resize
        flags |= imgui.WindowFlags_.no_collapse
        shown, stays = imgui.begin("Export picture###Export", True, flags)
        if shown:
            self._region(session)
            imgui.separator()
            self._size(session)
            imgui.separator()
            self._target(session)
        imgui.end()
        if not stays:
            session.state.dialogs.discard(self.name)

    def _region(self, session: Session) -> None:
        if imgui.radio_button("Whole picture", self.whole):
            self.whole = True
        imgui.same_line()
        if imgui.radio_button("Current view", not self.whole):
            self.whole = False
            self.scale = session.camera.target.scale
            self._follow(session)

    def _size(self, session: Session) -> None:
        em = imgui.get_font_size()
        if imgui.radio_button("By scale", self.by_scale):
            self.by_scale = True
        imgui.same_line()
        if imgui.radio_button("By size", not self.by_scale):
            self.by_scale = False
            self._follow(session)
        if self.by_scale:
            imgui.set_next_item_width(10 * em)
            _, self.scale = imgui.input_float("Scale", self.scale, 0.5, 1.0, "%.4g")
            imgui.same_line()
            imgui.begin_disabled(self.whole)
            if imgui.button("As on screen"):
                self.scale = session.camera.target.scale
            imgui.end_disabled()
            return
        # The other side follows, so that nothing is stretched; typing it last overrides.
        ratio = self._ratio(session)
        imgui.set_next_item_width(8 * em)
        changed, self.width = imgui.input_int("Width", self.width, 0)
        if changed:
            self.height = max(1, round(self.width / ratio))
        imgui.same_line()
        imgui.set_next_item_width(8 * em)
        _, self.height = imgui.input_int("Height", self.height, 0)
        imgui.same_line()
        imgui.text_disabled("pixels")

    def _target(self, session: Session) -> None:
        document = session.state.document
        label = f"x{self.scale:g}" if self.by_scale else f"{self.width}x{self.height}"
        part = "" if self.whole else "-view"
        self._path.suggest(document.path.with_name(f"{document.path.stem}{part}-{label}.png"))
        self._path.draw()
        view = None
        try:
            view = self._view(session)
            height, width = view.size
            imgui.text(f"{width} × {height} pixels, {width * height / 1e6:.1f} megapixels")
        except GsasrError as error:
            imgui.text_colored(ERROR, str(error))
        # Below 1:1 the window shows the source filtered, and so should the file by default.
        minified = view is not None and min(view.scale) < 1
        if minified:
            _, self.antialias = imgui.checkbox("Antialias", self.antialias)
            imgui.set_item_tooltip("Integrate over each pixel instead of sampling at its centre.")
        if session.worker.tasks:
            imgui.text_disabled("It begins when what is running has ended.")
        imgui.spacing()
        imgui.begin_disabled(view is None or not session.can_export or not self._path.text.strip())
        if imgui.button("Export"):
            path = Path(self._path.text.strip()).expanduser()
            session.export(view, path, antialias=minified and self.antialias)
            session.state.dialogs.discard(self.name)
        imgui.end_disabled()
        imgui.same_line()
        if imgui.button("Close"):
            session.state.dialogs.discard(self.name)

    def _view(self, session: Session) -> View:
        """What would be written. Raises RequestError if that makes no sense."""
        size = session.state.document.size
        if self.whole:
            if self.by_scale:
                return View.at_scale(size, self.scale)
            return View.to_size(size, (self.height, self.width))
        region = export.region_of(session.camera.view(), size)
        if self.by_scale:
            # The field shows fewer digits than the scale on screen has.
            if math.isclose(self.scale, region.scale[0], rel_tol=1e-4):
                return region
            return export.at_scale(region, self.scale)
        return export.to_size(region, (self.height, self.width))

    def _ratio(self, session: Session) -> float:
        height, width = session.state.document.size
        if not self.whole:
            with suppress(GsasrError):
                height, width = export.region_of(session.camera.view(), (height, width)).size
        return width / height

    def _follow(self, session: Session) -> None:
        """Put the scale's size into the size fields."""
        try:
            by_scale, self.by_scale = self.by_scale, True
            self.height, self.width = self._view(session).size
        except GsasrError:
            pass
        finally:
            self.by_scale = by_scale


class PredictDialog:
    """Predict the picture anew, told another scale."""

    name = "Predict"

    def __init__(self) -> None:
        self._condition: float | None = None

    def draw(self, session: Session) -> None:
        """Called each frame while it is open."""
        from .state import CONDITION

        if self._condition is None:
            self._condition = session.state.condition
        center = imgui.get_main_viewport().get_center()
        imgui.set_next_window_pos(center, imgui.Cond_.appearing, (0.5, 0.5))
        flags = imgui.WindowFlags_.no_saved_settings | imgui.WindowFlags_.always_auto_resize
        shown, stays = imgui.begin("Predict again###Predict", True, flags)
        if shown:
            imgui.text_disabled("The network is told the scale it should predict for.")
            imgui.set_next_item_width(14 * imgui.get_font_size())
            _, self._condition = imgui.slider_float(
                "Scale", self._condition, *CONDITION, "×%.1f", imgui.SliderFlags_.always_clamp
            )
            imgui.spacing()
            if imgui.button("Predict"):
                session.predict(self._condition)
                stays = False
        imgui.end()
        if not stays:
            session.state.dialogs.discard(self.name)
            self._condition = None
