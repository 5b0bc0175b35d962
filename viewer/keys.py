"""One table of commands: it handles the keys, fills the menus and is the help page."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from .session import Session


@dataclass(frozen=True)
class Command:
    """label: as in the menu and the help; keys: "Ctrl+O"; the first one is shown in the menu.

    menu: where it stands, or "" for a key that is in no menu. repeat: again while held.
    """

    label: str
    keys: tuple[str, ...]
    menu: str
    act: Callable[[Session], None]
    checked: Callable[[Session], bool] = lambda session: False
    enabled: Callable[[Session], bool] = lambda session: True
    repeat: bool = False


def _open_picture(session: Session) -> bool:
    document = session.state.document
    return document is not None and document.picture is not None


def _busy(session: Session) -> bool:
    return bool(session.worker.tasks)


COMMANDS = (
    Command("Open...", ("Ctrl+O",), "File", lambda s: s.toggle_dialog("Open")),
    Command(
        "Export picture...",
        ("Ctrl+E",),
        "File",
        lambda s: s.toggle_dialog("Export"),
        enabled=lambda s: s.can_export,
    ),
    Command(
        "Save Gaussians...",
        ("Ctrl+S",),
        "File",
        lambda s: s.toggle_dialog("Save"),
        enabled=lambda s: s.ready,
    ),
    Command(
        "Predict again...",
        ("Ctrl+R",),
        "File",
        lambda s: s.toggle_dialog("Predict"),
        enabled=_open_picture,
    ),
    Command(
        "Cancel what is running",
        ("Ctrl+.",),
        "File",
        Session.cancel,
        enabled=_busy,
    ),
    Command("GPU memory...", ("Ctrl+G",), "File", lambda s: s.toggle_dialog("Memory")),
    Command("Quit", ("Ctrl+Q",), "File", Session.quit),
    Command("Fit", ("F", "Home"), "View", Session.fit),
    Command("1:1", ("1", "Keypad 1"), "View", Session.one_to_one),
    Command("Zoom in", ("+", "=", "Keypad +"), "View", Session.zoom_in, repeat=True),
    Command("Zoom out", ("-", "Keypad -"), "View", Session.zoom_out, repeat=True),
    Command("Pan left", ("Left",), "", lambda s: s.pan(-1, 0), repeat=True),
    Command("Pan right", ("Right",), "", lambda s: s.pan(1, 0), repeat=True),
    Command("Pan up", ("Up",), "", lambda s: s.pan(0, -1), repeat=True),
    Command("Pan down", ("Down",), "", lambda s: s.pan(0, 1), repeat=True),
    Command(
        "Centers",
        ("C", "M"),
        "Overlays",
        lambda s: s.toggle_overlay("centers"),
        checked=lambda s: s.state.overlay == "centers",
    ),
    Command(
        "Ellipses",
        ("E",),
        "Overlays",
        lambda s: s.toggle_overlay("ellipses"),
        checked=lambda s: s.state.overlay == "ellipses",
    ),
    Command(
        "Keys and mouse",
        ("F1", "?"),
        "Help",
        lambda s: s.toggle_dialog("Help"),
        checked=lambda s: "Help" in s.state.dialogs,
    ),
    Command("Close what is open, or cancel", ("Escape",), "", Session.escape),
)

MENUS = ("File", "View", "Overlays", "Help")

MOUSE = (
    ("Wheel", "Zoom about the cursor"),
    ("Drag", "Pan"),
    ("Shift+wheel", "Pan; with a touchpad in any direction"),
    ("Double-click", "Fit"),
    ("Drop a file", "Open it"),
)
