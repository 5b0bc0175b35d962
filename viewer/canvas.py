"""The canvas: the picture itself, and the mouse on it."""

from __future__ import annotations

from imgui_bundle import imgui

from gsasr.errors import BackendError

from .session import Session

WHEEL_ZOOM = 0.25  # octaves per notch
WHEEL_PAN = 60.0  # framebuffer pixels per notch

_FLAGS = (
    imgui.WindowFlags_.no_decoration
    | imgui.WindowFlags_.no_move
    | imgui.WindowFlags_.no_saved_settings
    | imgui.WindowFlags_.no_bring_to_front_on_focus
    | imgui.WindowFlags_.no_nav
    | imgui.WindowFlags_.no_scroll_with_mouse
)


def draw(session: Session, bottom: float, spent: float) -> None:
    """Fill the work area above a strip of height `bottom` with the picture.

    spent: seconds of this frame that other work has taken already.
    """
    viewport = imgui.get_main_viewport()
    size = imgui.ImVec2(viewport.work_size.x, max(1.0, viewport.work_size.y - bottom))
    imgui.set_next_window_pos(viewport.work_pos)
    imgui.set_next_window_size(size)
    imgui.push_style_var(imgui.StyleVar_.window_padding, (0, 0))
    imgui.push_style_var(imgui.StyleVar_.window_border_size, 0)
    imgui.push_style_var(imgui.StyleVar_.window_rounding, 0)
    imgui.begin("Canvas", None, _FLAGS)
    imgui.pop_style_var(3)

    io = imgui.get_io()
    density = io.display_framebuffer_scale  # framebuffer pixels per unit of Dear ImGui
    session.camera.resize(round(size.x * density.x), round(size.y * density.y))
    corner = imgui.get_cursor_screen_pos()
    imgui.invisible_button("picture", size)
    _mouse(session, corner, density.x)
    session.camera.tick(io.delta_time)
    try:
        if session.painter.paint(session.camera.view(), session.overlay(), spent):
            session.state.frame_seconds = session.painter.seconds
            session.state.color = None
        _read_color(session)
    except BackendError:
        session.painter.reset()
        session.streaming.shrink()
        imgui.end()
        return
    session.scene.ctx.screen.use()  # what Dear ImGui draws into next
    draw_list = imgui.get_window_draw_list()
    for layer in session.painter.layers():
        draw_list.add_image(
            imgui.ImTextureRef(layer.texture.glo),
            (corner.x, corner.y + layer.y0 / density.y),
            (corner.x + size.x, corner.y + layer.y1 / density.y),
            (0, layer.v0),
            (layer.u1, layer.v1),
        )
    if session.state.document is None and not session.worker.tasks:
        _hint(corner, size)
    imgui.end()


def _mouse(session: Session, corner: imgui.ImVec2, density: float) -> None:
    io, camera = imgui.get_io(), session.camera
    hovered = imgui.is_item_hovered()
    # A quick release comes in the same frame as the last move.
    dragged = imgui.is_item_active() or imgui.is_item_deactivated()
    before = session.state.cursor
    if not (hovered or dragged) or not imgui.is_mouse_pos_valid():
        session.state.cursor = session.state.color = None
        return
    at = ((io.mouse_pos.x - corner.x) * density, (io.mouse_pos.y - corner.y) * density)
    session.state.cursor = at
    if at != before:
        session.state.color = None
    if hovered and (io.mouse_wheel or io.mouse_wheel_h):
        if io.key_shift or not io.mouse_wheel:
            camera.pan(io.mouse_wheel_h * WHEEL_PAN, io.mouse_wheel * WHEEL_PAN)
        else:
            camera.zoom(io.mouse_wheel * WHEEL_ZOOM, at)
    if dragged and (io.mouse_delta.x or io.mouse_delta.y):
        camera.pan(io.mouse_delta.x * density, io.mouse_delta.y * density)
    if hovered and imgui.is_mouse_double_clicked(imgui.MouseButton_.left):
        session.fit()


def _read_color(session: Session) -> None:
    """The colour under the cursor, once per change of cursor or picture.

    Reading waits for the GPU, so not while there is something to draw.
    """
    state = session.state
    busy = session.camera.moving or session.painter.busy
    if state.cursor is not None and state.color is None and not busy:
        x, y = (int(value) for value in state.cursor)
        state.color = session.scene.color_at(session.camera.view(), x, y)


def _hint(corner: imgui.ImVec2, size: imgui.ImVec2) -> None:
    draw_list = imgui.get_window_draw_list()
    lines = (("Drop a picture here", 1.6, 0.9), ("or press Ctrl+O to open one", 1.0, 0.55))
    y = corner.y + size.y / 2 - 1.5 * imgui.get_font_size()
    for text, scale, light in lines:
        font_size = scale * imgui.get_font_size()
        width = scale * imgui.calc_text_size(text).x
        position = imgui.ImVec2(corner.x + (size.x - width) / 2, y)
        color = imgui.get_color_u32((light, light, light, 1.0))
        draw_list.add_text(imgui.get_font(), font_size, position, color, text)
        y += 1.5 * font_size
