"""The help page: the table of commands, as a window."""

from __future__ import annotations

from imgui_bundle import imgui

from .keys import COMMANDS, MOUSE
from .session import Session


def draw(session: Session) -> None:
    """All keys and what the mouse does."""
    imgui.set_next_window_pos(
        imgui.get_main_viewport().get_center(), imgui.Cond_.appearing, (0.5, 0.5)
    )
    flags = imgui.WindowFlags_.always_auto_resize | imgui.WindowFlags_.no_saved_settings
    shown, stays = imgui.begin(
        "Keys and mouse###Help", True, flags | imgui.WindowFlags_.no_collapse
    )
    if shown and imgui.begin_table("keys", 2, imgui.TableFlags_.row_bg):
        rows = [(" or ".join(c.keys), c.label.rstrip(".")) for c in COMMANDS]
        for keys, label in [*MOUSE, *rows]:
            imgui.table_next_row()
            imgui.table_next_column()
            imgui.text(f"{keys}      ")
            imgui.table_next_column()
            imgui.text_disabled(label)
        imgui.end_table()
    imgui.end()
    if not stays:
        session.toggle_dialog("Help")
