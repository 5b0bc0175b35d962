"""Choosing files: the desktop's own dialog where there is one, else a small one of ours."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

from imgui_bundle import imgui
from imgui_bundle import portable_file_dialogs as native

from .loading import FIELD_SUFFIX
from .session import Session

PICTURES = (
    ".png",
    ".jpg",
    ".jpeg",
    ".webp",
    ".tif",
    ".tiff",
    ".avif",
    ".bmp",
    ".gif",
    ".ppm",
    ".tga",
)
MOST_ENTRIES = 2000  # listed of a folder


def has_native() -> bool:
    """On Linux the dialogs are programs; without one, asking silently gives no answer."""
    programs = ("zenity", "kdialog", "matedialog", "qarma")
    return not sys.platform.startswith("linux") or any(map(shutil.which, programs))


class OpenDialog:
    """Choose a picture or a saved field."""

    name = "Open"

    def __init__(self) -> None:
        self.text = ""
        self._native = None
        self._folder: Path | None = None
        self._listed: tuple[Path | None, list[Path]] = (None, [])

    def draw(self, session: Session) -> None:
        """Called each frame while it is open."""
        if has_native():
            self._draw_native(session)
            return
        if self._folder is None:
            document = session.state.document
            self._folder = document.path.absolute().parent if document else Path.cwd()
        em = imgui.get_font_size()
        center = imgui.get_main_viewport().get_center()
        imgui.set_next_window_pos(center, imgui.Cond_.appearing, (0.5, 0.5))
        imgui.set_next_window_size((38 * em, 26 * em), imgui.Cond_.appearing)
        flags = imgui.WindowFlags_.no_saved_settings | imgui.WindowFlags_.no_collapse
        shown, stays = imgui.begin("Open a picture or Gaussians###Open", True, flags)
        if shown:
            self._path(session)
            self._list(session)
        imgui.end()
        if not stays:
            session.state.dialogs.discard(self.name)

    def _path(self, session: Session) -> None:
        if imgui.is_window_appearing():
            imgui.set_keyboard_focus_here()
        button = imgui.calc_text_size("Open").x + 2 * imgui.get_style().frame_padding.x
        imgui.set_next_item_width(-button - imgui.get_style().item_spacing.x)
        entered, self.text = imgui.input_text_with_hint(
            "##path",
            "Path of a file or folder",
            self.text,
            imgui.InputTextFlags_.enter_returns_true,
        )
        imgui.same_line()
        if (imgui.button("Open") or entered) and self.text.strip():
            self._choose(session, self._folder / Path(self.text.strip()).expanduser())

    def _list(self, session: Session) -> None:
        imgui.text_disabled(str(self._folder))
        if imgui.begin_child("files", (0, 0), imgui.ChildFlags_.borders):
            if imgui.selectable("../", False)[0]:
                self._choose(session, self._folder.parent)
            for entry in self._entries():
                label = f"{entry.name}/" if entry.is_dir() else entry.name
                if imgui.selectable(label, False)[0]:
                    self._choose(session, entry)
        imgui.end_child()

    def _entries(self) -> list[Path]:
        if self._listed[0] != self._folder:
            try:
                found = [
                    entry
                    for entry in self._folder.iterdir()
                    if not entry.name.startswith(".")
                    and (entry.is_dir() or entry.suffix.lower() in (*PICTURES, FIELD_SUFFIX))
                ]
            except OSError:
                found = []
            found.sort(key=lambda entry: (not entry.is_dir(), entry.name.lower()))
            self._listed = self._folder, found[:MOST_ENTRIES]
        return self._listed[1]

    def _choose(self, session: Session, path: Path) -> None:
        if path.is_dir():
            self._folder, self.text = path.resolve(), ""
            return
        session.open(path)
        self._listed = (None, [])
        session.state.dialogs.discard(self.name)

    def _draw_native(self, session: Session) -> None:
        if self._native is None:
            patterns = " ".join(f"*{suffix}" for suffix in (*PICTURES, FIELD_SUFFIX))
            self._native = native.open_file("Open", "", ["Pictures and Gaussians", patterns])
        if not self._native.ready(0):
            return
        chosen, self._native = self._native.result(), None
        session.state.dialogs.discard(self.name)
        if chosen:
            session.open(chosen[0])


class SaveDialog:
    """Save the Gaussians of the document."""

    name = "Save"

    def __init__(self) -> None:
        self._path = PathField((f"Gaussians *{FIELD_SUFFIX}", f"*{FIELD_SUFFIX}"))

    def draw(self, session: Session) -> None:
        """Called each frame while it is open."""
        document = session.state.document
        if document is None:
            session.state.dialogs.discard(self.name)
            return
        self._path.suggest(document.path.with_suffix(FIELD_SUFFIX))
        center = imgui.get_main_viewport().get_center()
        imgui.set_next_window_pos(center, imgui.Cond_.appearing, (0.5, 0.5))
        flags = imgui.WindowFlags_.no_saved_settings | imgui.WindowFlags_.always_auto_resize
        shown, stays = imgui.begin("Save Gaussians###Save", True, flags)
        if shown:
            imgui.text_disabled("The file opens again at once, without the network.")
            self._path.draw()
            imgui.spacing()
            imgui.begin_disabled(not self._path.text.strip() or not session.ready)
            if imgui.button("Save"):
                session.save_field(Path(self._path.text.strip()).expanduser())
                stays = False
            imgui.end_disabled()
        imgui.end()
        if not stays:
            session.state.dialogs.discard(self.name)


class PathField:
    """A path to write to, as text, with a native dialog where there is one."""

    def __init__(self, filters: tuple[str, str]) -> None:
        self.text = ""
        self._filters = list(filters)
        self._suggested: Path | None = None
        self._native = None

    def suggest(self, path: Path) -> None:
        """Fill in `path`, unless the user has typed another one since the last suggestion."""
        if self.text == str(self._suggested or ""):
            self.text = str(path)
        self._suggested = path

    def draw(self) -> None:
        """The field, and a button where a native dialog exists."""
        imgui.set_next_item_width(30 * imgui.get_font_size())
        _, self.text = imgui.input_text("File", self.text)
        if self._native is None and has_native():
            imgui.same_line()
            if imgui.button("..."):
                self._native = native.save_file("Save as", self.text, self._filters)
        if self._native is not None and self._native.ready(0):
            self.text, self._native = self._native.result() or self.text, None
