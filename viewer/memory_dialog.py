"""The dialog of how much of the GPU the Gaussians may fill."""

from __future__ import annotations

from imgui_bundle import imgui

from .session import Session
from .status import memory_line

MEBIBYTE = 1 << 20


class MemoryDialog:
    """What is used now, and the most that may be."""

    name = "Memory"

    def draw(self, session: Session) -> None:
        """Called each frame while it is open."""
        state = session.state
        center = imgui.get_main_viewport().get_center()
        imgui.set_next_window_pos(center, imgui.Cond_.appearing, (0.5, 0.5))
        flags = imgui.WindowFlags_.no_saved_settings | imgui.WindowFlags_.always_auto_resize
        flags |= imgui.WindowFlags_.no_collapse
        shown, stays = imgui.begin("GPU memory###Memory", True, flags)
        if shown:
            imgui.text_disabled("Tiles not seen for longest make room for those that are seen.")
            if state.document is not None and state.document.tiles is not None:
                imgui.text(memory_line(session))
            imgui.set_next_item_width(10 * imgui.get_font_size())
            flags = imgui.InputTextFlags_.enter_returns_true
            changed, most = imgui.input_int(
                "MiB for Gaussians", state.gpu_memory // MEBIBYTE, 256, 1024, flags
            )
            if changed:
                session.set_gpu_memory(most * MEBIBYTE)
        imgui.end()
        if not stays:
            session.state.dialogs.discard(self.name)
