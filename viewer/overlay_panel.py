"""A small panel on the canvas while an overlay is on."""

from __future__ import annotations

from imgui_bundle import imgui

from .session import Session
from .state import SIGMA

_FLAGS = (
    imgui.WindowFlags_.no_decoration
    | imgui.WindowFlags_.no_move
    | imgui.WindowFlags_.no_saved_settings
    | imgui.WindowFlags_.no_focus_on_appearing
    | imgui.WindowFlags_.always_auto_resize
)


def draw(session: Session) -> None:
    """The size of the ellipses; and why nothing is drawn, if nothing is."""
    state = session.state
    if state.document is None or state.overlay == "none":
        return
    hint = not session.scene.overlay_drawn
    if state.overlay != "ellipses" and not hint:
        return
    viewport, em = imgui.get_main_viewport(), imgui.get_font_size()
    imgui.set_next_window_pos(
        (viewport.work_pos.x + 0.7 * em, viewport.work_pos.y + 0.7 * em), imgui.Cond_.always
    )
    imgui.set_next_window_bg_alpha(0.85)
    imgui.begin("Overlay", None, _FLAGS)
    if state.overlay == "ellipses":
        imgui.set_next_item_width(9 * em)
        changed, sigma = imgui.slider_float("Ellipse size", state.sigma, *SIGMA, "%.1f σ")
        if changed:
            session.set_sigma(sigma)
        imgui.set_item_tooltip("At k σ a Gaussian has fallen to exp(-k²/2) of its peak")
    if hint:
        imgui.text_disabled("Zoom in to see single Gaussians")
    imgui.end()
