"""The status bar, and the message above it."""

from __future__ import annotations

from imgui_bundle import imgui

from .session import Session

ERROR = (1.0, 0.55, 0.5, 1.0)
_FLAGS = (
    imgui.WindowFlags_.no_decoration
    | imgui.WindowFlags_.no_move
    | imgui.WindowFlags_.no_saved_settings
    | imgui.WindowFlags_.no_focus_on_appearing
    | imgui.WindowFlags_.no_nav
)


def height() -> float:
    """Of the bar, units of Dear ImGui."""
    return imgui.get_frame_height() + 0.5 * imgui.get_font_size()


def draw(session: Session) -> None:
    """One line along the bottom: where, what colour, how much, how fast; and progress."""
    viewport = imgui.get_main_viewport()
    bar = height()
    imgui.set_next_window_pos(
        (viewport.work_pos.x, viewport.work_pos.y + viewport.work_size.y - bar)
    )
    imgui.set_next_window_size((viewport.work_size.x, bar))
    imgui.push_style_var(imgui.StyleVar_.window_rounding, 0)
    imgui.push_style_var(
        imgui.StyleVar_.window_padding,
        (0.7 * imgui.get_font_size(), 0.25 * imgui.get_font_size()),
    )
    imgui.begin("Status", None, _FLAGS)
    imgui.pop_style_var(2)
    imgui.align_text_to_frame_padding()
    if session.state.document is None:
        imgui.text_disabled("No picture")
    else:
        _facts(session)
    _progress(session)
    imgui.end()


def _facts(session: Session) -> None:
    state, scale, em = session.state, session.camera.scale, imgui.get_font_size()
    document = state.document
    imgui.text(f"×{scale:.2f}" if scale < 100 else f"×{scale:.0f}")
    imgui.set_item_tooltip("Framebuffer pixels per pixel of the picture")
    imgui.same_line(4 * em)
    imgui.text_disabled(f"{100 * scale:.0f} %")
    imgui.same_line(9 * em)
    if state.cursor is not None:
        x, y = session.camera.view().to_source(*state.cursor)
        imgui.text(f"{x:.2f}, {y:.2f}")
        imgui.set_item_tooltip("Under the cursor, in pixels of the picture")
    imgui.same_line(17 * em)
    if state.color is not None:
        red, green, blue = state.color
        side = 0.9 * em
        imgui.color_button(
            "##color",
            (red / 255, green / 255, blue / 255, 1.0),
            imgui.ColorEditFlags_.no_tooltip | imgui.ColorEditFlags_.no_border,
            (side, imgui.get_frame_height()),
        )
        imgui.same_line()
        imgui.text(f"{red:3d} {green:3d} {blue:3d}  #{red:02X}{green:02X}{blue:02X}")
    imgui.same_line(30 * em)
    imgui.text(f"{document.size[1]}×{document.size[0]}")
    imgui.same_line(0, 1.5 * em)
    if document.count:
        made = f"{document.model} at ×{document.condition:g}" if document.model else "no model"
        imgui.text(f"{document.count:,} Gaussians".replace(",", " "))
        imgui.set_item_tooltip(memory_line(session))
        imgui.same_line(0, 1.5 * em)
        imgui.text_disabled(made)
        imgui.set_item_tooltip("The network, and the scale it was told to predict for")
        imgui.same_line(0, 1.5 * em)
    imgui.text_disabled(f"{1000 * state.frame_seconds:.1f} ms")
    imgui.set_item_tooltip("Time of the last drawing of the picture")
    if session.painter.reduction > 1:
        imgui.same_line(0, 0.6 * em)
        imgui.text_disabled(f"1/{session.painter.reduction}")
        imgui.set_item_tooltip("Resolution in motion; it sharpens at rest")


def memory_line(session: Session) -> str:
    """What the Gaussians take, and what they may take of the GPU."""
    tiles = session.state.document.tiles
    shown, held = tiles.shown_bytes / 2**20, tiles.coded_bytes / 2**20
    most = session.state.gpu_memory / 2**20
    return f"{shown:.0f} of {most:.0f} MiB on the GPU, {held:.0f} MiB in main memory"


def _progress(session: Session) -> None:
    """What runs, right-aligned, with a button that stops it."""
    tasks = session.worker.tasks
    if not tasks:
        return
    task, em = tasks[0], imgui.get_font_size()
    button = imgui.calc_text_size("Cancel").x + 2 * imgui.get_style().frame_padding.x
    width = 16 * em
    left = imgui.get_window_width() - button - width - 1.4 * em
    imgui.same_line(max(left, 0.0))
    if task.share is None:
        share, title = -float(imgui.get_time()), f"{task.title}..."
    else:
        share, title = task.share, f"{task.title}  {100 * task.share:.0f} %"
    imgui.progress_bar(share, (width, 0), "")
    low, high = imgui.get_item_rect_min(), imgui.get_item_rect_max()
    draw_list = imgui.get_window_draw_list()
    draw_list.push_clip_rect(low, high, True)
    draw_list.add_text(
        low + imgui.get_style().frame_padding, imgui.get_color_u32(imgui.Col_.text), title
    )
    draw_list.pop_clip_rect()
    imgui.same_line()
    if imgui.button("Cancel"):
        session.cancel()


def draw_message(session: Session) -> None:
    """The present message, at the top of the canvas; errors until they are closed."""
    message = session.state.message
    if message is None:
        return
    message.seconds -= imgui.get_io().delta_time
    if message.seconds <= 0:
        session.state.message = None
        return
    viewport, em = imgui.get_main_viewport(), imgui.get_font_size()
    imgui.set_next_window_pos(
        (viewport.work_pos.x + viewport.work_size.x / 2, viewport.work_pos.y + em),
        imgui.Cond_.always,
        (0.5, 0.0),
    )
    imgui.set_next_window_size_constraints((0, 0), (0.8 * viewport.work_size.x, 20 * em))
    flags = _FLAGS | imgui.WindowFlags_.always_auto_resize
    imgui.begin("Message", None, flags)
    imgui.push_text_wrap_pos(min(40 * em, 0.7 * viewport.work_size.x))
    if message.error:
        imgui.text_colored(ERROR, message.text)
    else:
        imgui.text(message.text)
    imgui.pop_text_wrap_pos()
    if message.error:
        imgui.spacing()
        if imgui.button("Close"):
            session.state.message = None
    imgui.end()
