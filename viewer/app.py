"""The window: Hello ImGui runs it, moderngl draws into its context, the panels fill it."""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

# First: it chooses the GLFW library that glfw, below, has to share with it.
from imgui_bundle import hello_imgui  # isort: skip
import glfw
import moderngl
from imgui_bundle import portable_file_dialogs as native
from imgui_bundle.glfw_utils import glfw_window_hello_imgui

from gsasr.errors import BackendError
from gsasr.rasterize.driver import lost

from . import canvas, help, menu, overlay_panel, status, theme
from .export_dialog import ExportDialog, PredictDialog
from .file_dialogs import OpenDialog, SaveDialog, has_native
from .memory_dialog import MemoryDialog
from .scene import Scene
from .session import Session
from .streaming import deliver

TITLE = "GSASR"
# Frames per second without input, which is handled at once in any case, as are results of the
# worker. Hello ImGui waits for so long; 0 would mean that it does not wait at all.
BUSY_FPS, IDLE_FPS = 10.0, 0.001
LOST = (
    "The graphics driver was reset, and all that was on the GPU is gone; "
    "nothing unsaved is lost, so open the picture again."
)
WITHOUT = "render without a window by --snapshot OUT.png."


class App:
    """Draws one frame after another of a session."""

    def __init__(self, session: Session, path: str | None) -> None:
        self.session = session
        self.dialogs = {
            dialog.name: dialog
            for dialog in (
                OpenDialog(),
                SaveDialog(),
                ExportDialog(),
                PredictDialog(),
                MemoryDialog(),
            )
        }
        self.lost = False
        self._path = path  # opened after the first frame, so that the window is there at once
        self._frames = 0
        self._title = TITLE

    def setup(self) -> None:
        """Hello ImGui has made the window and its context."""
        ctx = moderngl.create_context(require=430)
        self.session.start(Scene(ctx))
        window = glfw_window_hello_imgui()
        self.session.worker.wake = hello_imgui.request_refresh
        glfw.set_drop_callback(window, lambda _, paths: self.drop(paths))

    def drop(self, paths: list[str]) -> None:
        """Files were dropped on the window: open the first."""
        if paths:
            self.session.open(paths[0])
            glfw.focus_window(glfw_window_hello_imgui())

    def frame(self) -> None:
        """One frame."""
        session = self.session
        start = time.perf_counter()
        if self.lost or lost(session.scene.ctx):
            self.lost = True  # there is nothing left to draw with, not even a message
            hello_imgui.get_runner_params().app_shall_exit = True
            return
        try:
            if deliver(session.worker, session.scene, session.painter):
                hello_imgui.request_refresh()
        except BackendError as error:  # the picture stays as coarse as it is
            session.fail(str(error))
        spent = time.perf_counter() - start
        menu.handle_keys(session)
        menu.draw(session)
        canvas.draw(session, status.height(), spent)
        overlay_panel.draw(session)
        status.draw(session)
        for name in sorted(session.state.dialogs):
            if name == "Help":
                help.draw(session)
            else:
                self.dialogs[name].draw(session)
        status.draw_message(session)
        session.streaming.follow()
        self._set_title()
        if session.camera.moving or session.painter.busy:
            hello_imgui.request_refresh()
        state = session.state
        waiting = session.worker.tasks or state.message or state.dialogs
        hello_imgui.get_runner_params().fps_idling.fps_idle = BUSY_FPS if waiting else IDLE_FPS
        if session.quitting:
            hello_imgui.get_runner_params().app_shall_exit = True
        self._frames += 1
        if self._frames == 2 and self._path is not None:
            session.open(self._path)

    def _set_title(self) -> None:
        document = self.session.state.document
        title = f"{document.path.name} - {TITLE}" if document else TITLE
        if title != self._title:
            self._title = title
            glfw.set_window_title(glfw_window_hello_imgui(), title)


def run(
    path: str | None,
    model: str,
    condition: float,
    size: tuple[int, int],
    tests: Callable[[App], None] | None = None,
    gpu_memory: int | None = None,
) -> None:
    """Show the window until it is closed.

    path: what to open; size: of the window (width, height). tests: registers tests of Dear
    ImGui's test engine. gpu_memory: see Session. Raises BackendError where no window can be
    opened, and where the driver was reset while it was open.
    """
    require_window()
    glfw.window_hint(glfw.CONTEXT_ROBUSTNESS, glfw.LOSE_CONTEXT_ON_RESET)  # so that `lost` tells
    session = Session(model, condition, gpu_memory)
    app = App(session, path)
    params = hello_imgui.RunnerParams()
    params.app_window_params.window_title = TITLE
    params.app_window_params.window_geometry.size = size
    params.app_window_params.restore_previous_geometry = False
    params.imgui_window_params.default_imgui_window_type = (
        hello_imgui.DefaultImGuiWindowType.no_default_window
    )
    params.platform_backend_type = hello_imgui.PlatformBackendType.glfw
    params.renderer_backend_options.open_gl_options = hello_imgui.OpenGlOptions(
        glsl_version="#version 430",
        major_version=4,
        minor_version=3,
        use_core_profile=True,
        use_forward_compat=True,
        anti_aliasing_samples=0,
    )
    params.fps_idling.time_active_after_last_event = 0.5
    params.ini_disable = True
    params.callbacks.setup_imgui_style = theme.apply
    params.callbacks.load_additional_fonts = theme.load_font
    params.callbacks.post_init = app.setup
    params.callbacks.show_gui = app.frame
    if tests is not None:
        params.use_imgui_test_engine = True
        params.callbacks.register_tests = lambda: tests(app)
    try:
        with _waking_on_signals():
            hello_imgui.run(params)
    finally:
        session.worker.stop()
    if app.lost:
        raise BackendError(_tell(LOST))


def _tell(sentence: str) -> str:
    """The sentence, shown by the desktop where it can, as our window is no more."""
    if has_native():
        native.message(TITLE, sentence, native.choice.ok, native.icon.error).result()
    return sentence


@contextmanager
def _waking_on_signals() -> Iterator[None]:
    """Let Ctrl+C in the terminal end a window that waits for events, in which no Python runs."""
    read, write = socket.socketpair()
    write.setblocking(False)

    def wake() -> None:
        while read.recv(1):
            hello_imgui.request_refresh()

    threading.Thread(target=wake, name="signals", daemon=True).start()
    before = signal.set_wakeup_fd(write.fileno())
    try:
        yield
    finally:
        signal.set_wakeup_fd(before)
        write.close()  # which ends the thread


def require_window() -> None:
    """Raise BackendError unless a window with OpenGL 4.3 can be opened here."""
    if sys.platform.startswith("linux") and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    ):
        raise BackendError(f"There is no display to open a window on; {WITHOUT}")
    reasons: list[str] = []
    glfw.set_error_callback(lambda code, text: reasons.append(text.decode()))
    try:
        if not glfw.init():
            raise BackendError(f"The display cannot be used ({reasons[-1:]}); {WITHOUT}")
        glfw.window_hint(glfw.VISIBLE, glfw.FALSE)
        glfw.window_hint(glfw.CONTEXT_VERSION_MAJOR, 4)
        glfw.window_hint(glfw.CONTEXT_VERSION_MINOR, 3)
        glfw.window_hint(glfw.OPENGL_PROFILE, glfw.OPENGL_CORE_PROFILE)
        window = glfw.create_window(16, 16, TITLE, None, None)
        if not window:
            raise BackendError(f"The display has no OpenGL 4.3; update its driver, or {WITHOUT}")
        glfw.destroy_window(window)
        glfw.default_window_hints()
    finally:
        glfw.set_error_callback(None)
