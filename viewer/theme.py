"""How the window looks: dark and flat, so that the picture is what one sees."""

from __future__ import annotations

from imgui_bundle import hello_imgui, imgui

FONT = "fonts/Roboto/Roboto-Regular.ttf"
FONT_SIZE = 15.5

_ACCENT = (0.36, 0.62, 0.95)
_COLORS = {
    imgui.Col_.text: (0.90, 0.91, 0.93, 1.0),
    imgui.Col_.text_disabled: (0.56, 0.58, 0.62, 1.0),
    imgui.Col_.window_bg: (0.125, 0.13, 0.145, 1.0),
    imgui.Col_.popup_bg: (0.125, 0.13, 0.145, 1.0),
    imgui.Col_.menu_bar_bg: (0.125, 0.13, 0.145, 1.0),
    imgui.Col_.border: (0.26, 0.27, 0.30, 0.7),
    imgui.Col_.title_bg: (0.125, 0.13, 0.145, 1.0),
    imgui.Col_.title_bg_active: (0.16, 0.17, 0.19, 1.0),
    imgui.Col_.frame_bg: (0.20, 0.21, 0.235, 1.0),
    imgui.Col_.frame_bg_hovered: (0.25, 0.26, 0.29, 1.0),
    imgui.Col_.frame_bg_active: (0.28, 0.30, 0.34, 1.0),
    imgui.Col_.button: (0.235, 0.25, 0.28, 1.0),
    imgui.Col_.button_hovered: (0.29, 0.31, 0.36, 1.0),
    imgui.Col_.button_active: (*_ACCENT, 0.8),
    imgui.Col_.header: (*_ACCENT, 0.30),
    imgui.Col_.header_hovered: (*_ACCENT, 0.35),
    imgui.Col_.header_active: (*_ACCENT, 0.55),
    imgui.Col_.check_mark: (*_ACCENT, 1.0),
    imgui.Col_.slider_grab: (*_ACCENT, 0.8),
    imgui.Col_.slider_grab_active: (*_ACCENT, 1.0),
    imgui.Col_.plot_histogram: (0.22, 0.40, 0.64, 1.0),
    imgui.Col_.separator: (0.26, 0.27, 0.30, 0.7),
    imgui.Col_.table_row_bg_alt: (1.0, 1.0, 1.0, 0.025),
}


def load_font() -> None:
    """One font, crisp at any density of the display."""
    hello_imgui.load_font(FONT, FONT_SIZE)


def apply() -> None:
    """Colours and spacing."""
    style = imgui.get_style()
    imgui.style_colors_dark()
    for index, color in _COLORS.items():
        style.set_color_(index, color)
    style.window_padding = (12, 10)
    style.frame_padding = (8, 4)
    style.item_spacing = (8, 7)
    style.window_rounding = 6
    style.popup_rounding = 6
    style.frame_rounding = 4
    style.grab_rounding = 4
    style.window_title_align = (0.5, 0.5)
    style.frame_border_size = 0
