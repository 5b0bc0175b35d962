"""Moves the real mouse over the real window (xdotool) and watches where the camera goes.

python tests/viewer_desktop.py FOLDER
"""

from __future__ import annotations

import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable
from pathlib import Path

from viewer_scenarios import SIZE, make_field

from viewer import app


def xdotool(*arguments: object) -> None:
    subprocess.run(["xdotool", *map(str, arguments)], check=True)


def until(what: Callable[[], bool], seconds: float = 20.0) -> None:
    end = time.perf_counter() + seconds
    while not what():
        assert time.perf_counter() < end, "waited too long"
        time.sleep(0.02)


def play(application) -> None:
    """What the person does; runs beside the window's thread and only reads its state."""
    session = application.session
    camera = session.camera
    until(lambda: session.ready and not camera.moving)
    until(lambda: camera.view().size[1] == SIZE[0])
    start = camera.view()

    xdotool("mousemove", 300, 250)
    until(lambda: session.state.cursor is not None and session.state.cursor[0] == 300)
    at = session.state.cursor
    held = start.to_source(*at)
    for _ in range(8):
        xdotool("click", 4)  # wheel up
    until(lambda: camera.scale > 3 * start.scale[0] and not camera.moving)
    x, y = camera.view().to_output(*held)
    assert abs(x - at[0]) < 0.5 and abs(y - at[1]) < 0.5, (x, y, at)

    xdotool("mousedown", 1, "mousemove_relative", "--sync", 60, 30, "mouseup", 1)
    until(lambda: abs(camera.view().to_output(*held)[0] - at[0] - 60) < 0.5)
    assert abs(camera.view().to_output(*held)[1] - at[1] - 30) < 0.5

    xdotool("key", "f")
    until(lambda: camera.view() == start)
    xdotool("key", "e")
    until(lambda: session.state.overlay == "ellipses")
    xdotool("key", "plus")
    until(lambda: camera.scale > 1.3 * start.scale[0])
    xdotool("key", "question")
    until(lambda: "Help" in session.state.dialogs)
    xdotool("key", "Escape")
    until(lambda: not session.state.dialogs)
    xdotool("keydown", "ctrl", "key", "q", "keyup", "ctrl")  # as fingers do: Ctrl leaves last
    until(lambda: session.quitting)


def main(folder: Path) -> int:
    path = folder / "desktop.safetensors"
    make_field().save(path)
    failures: list[str] = []

    class Watched(app.App):
        def setup(self) -> None:
            super().setup()
            threading.Thread(target=self.watch, daemon=True).start()

        def watch(self) -> None:
            try:
                play(self)
            except BaseException:
                failures.append(traceback.format_exc())
                self.session.quitting = True

    app.App = Watched
    app.run(str(path), "lite", 4.0, SIZE)
    print("\n".join(failures))
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
