"""What a person does with the viewer, done by Dear ImGui's test engine in the real program.

Each scenario is a function of (ui, folder); test_viewer.py runs them all, in one process:
    python tests/viewer_scenarios.py FOLDER [NAME ...]
"""

from __future__ import annotations

import json
import os
import sys
import time
import traceback
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path

import numpy as np

SIZE = (640, 460)


class Ui:
    """The hands and eyes of the test, on the test engine's thread."""

    def __init__(self, app, ctx) -> None:
        self.app, self.session, self.ctx = app, app.session, ctx

    def until(self, what: Callable[[], bool], seconds: float = 30.0) -> None:
        """Let frames pass until `what()`."""
        end = time.perf_counter() + seconds
        while not what():
            assert time.perf_counter() < end, "waited too long"
            self.ctx.yield_()

    def rest(self) -> None:
        """Until nothing moves, nothing is computed and everything is drawn."""
        session = self.session
        for _ in range(2):
            self.until(
                lambda: not (session.worker.tasks or session.camera.moving or session.painter.busy)
            )
            self.ctx.yield_(3)

    def on_window(self, action: Callable):
        """What `action()` returns on the thread that owns OpenGL."""
        result = []
        self.session.worker.show(None, lambda: result.append(action()))
        self.until(lambda: bool(result))
        return result[0]

    def pixels(self) -> np.ndarray:
        """(h, w, 3) float32 in [0, 1]: the canvas as it is on screen."""
        self.ctx.yield_()
        return self.on_window(self.session.painter.target.read).astype(np.float32) / 255

    def move(self, x: float, y: float) -> None:
        """Put the mouse on a canvas pixel."""
        low = self.ctx.item_info("//Canvas/picture").rect_full.min
        self.ctx.mouse_move_to_pos((low.x + x, low.y + y))

    def press(self, keys: str) -> None:
        """Press keys as in the table: "Ctrl+E"."""
        from viewer.menu import chord

        self.ctx.key_press(chord(keys))
        self.ctx.yield_()

    def view(self):
        return self.session.camera.view()


def make_field(size: tuple[int, int] = (30, 40), seed: int = 0):
    """A saved-field-like random picture with mild contrast, that covers itself fully."""
    import torch

    from gsasr.gaussians import Gaussians

    torch.manual_seed(seed)
    height, width = size
    # Twice as dense as the pixels, and a little beyond the edge
    y, x = torch.meshgrid(
        torch.arange(-2, height + 2, 0.5), torch.arange(-2, width + 2, 0.5), indexing="ij"
    )
    mean = torch.stack([x.flatten(), y.flatten()], 1) + 0.25
    count = len(mean)
    return Gaussians(
        mean=mean + 0.3 * (torch.rand(count, 2) - 0.5),
        std=0.3 + 0.4 * torch.rand(count, 2),
        rho=1.2 * (torch.rand(count) - 0.5),
        color=torch.rand(count, 3),
        opacity=0.1 + 0.2 * torch.rand(count),
        size=size,
        model="random",
        scale=4.0,
    )


def oracle(field, view) -> np.ndarray:
    """(h, w, 3) in [0, 1], by the reference rasterizer; NaN outside of the picture."""
    from gsasr.rasterize import reference

    image = reference.render(field, view).clamp(0, 1).numpy()
    height, width = view.size
    x = view.origin[0] + (np.arange(width) + 0.5) / view.scale[0]
    y = view.origin[1] + (np.arange(height) + 0.5) / view.scale[1]
    inside = ((x >= 0) & (x < field.size[1]))[None] & ((y >= 0) & (y < field.size[0]))[:, None]
    image[~inside] = np.nan
    return image


def every(view, step: int):
    """The view of every `step`-th pixel in both directions: the oracle is slow."""
    from gsasr.view import View

    origin = tuple(o + (0.5 - 0.5 * step) / s for o, s in zip(view.origin, view.scale, strict=True))
    size = tuple(-(-side // step) for side in view.size)
    return View(origin, tuple(s / step for s in view.scale), size)


def assert_shows(pixels: np.ndarray, field, view, step: int = 7) -> None:
    """The canvas shows the field exactly: half a step of rounding, and the screen's tolerance."""
    from viewer.scene import BACKGROUND

    expected = oracle(field, every(view, step))
    pixels = pixels[::step, ::step]
    outside = np.isnan(expected)
    assert not outside.all()
    error = np.abs(pixels - expected)[~outside]
    assert error.max() <= (0.5 + 0.75) / 255, error.max() * 255
    background = np.broadcast_to(np.float32(BACKGROUND), pixels.shape)
    assert np.abs(pixels - background)[outside].max(initial=0) <= 0.51 / 255


def open_field(ui: Ui, folder: Path):
    field = make_field()
    path = folder / "field.safetensors"
    field.save(path)
    ui.session.open(path)
    ui.rest()
    assert ui.session.ready
    return field


# Scenarios


def zoom_at_the_cursor(ui: Ui, folder: Path) -> None:
    field = open_field(ui, folder)
    assert_shows(ui.pixels(), field, ui.view())  # fitted: the edges are sharp
    at = (380.0, 171.0)
    ui.move(*at)
    held = ui.view().to_source(*at)
    worst = 0.0
    start = ui.session.camera.scale
    for _ in range(12):
        ui.ctx.mouse_wheel_y(1.0)
        for _ in range(3):
            ui.ctx.yield_()
            x, y = ui.view().to_output(*held)
            worst = max(worst, abs(x - at[0]), abs(y - at[1]))
    ui.rest()
    x, y = ui.view().to_output(*held)
    worst = max(worst, abs(x - at[0]), abs(y - at[1]))
    assert worst < 0.5, worst
    assert abs(ui.session.camera.scale / start - 2**3) < 1e-6
    assert_shows(ui.pixels(), field, ui.view())
    for _ in range(40):
        ui.ctx.mouse_wheel_y(1.0)
    ui.rest()
    assert ui.session.camera.scale > 1000 * start
    x, y = ui.view().to_output(*held)
    assert max(abs(x - at[0]), abs(y - at[1])) < 0.5
    assert_shows(ui.pixels(), field, ui.view())


def pan_fit_and_one_to_one(ui: Ui, folder: Path) -> None:
    field = open_field(ui, folder)
    fitted = ui.view()
    ui.move(300, 200)
    for _ in range(4):
        ui.ctx.mouse_wheel_y(1.0)
    ui.rest()
    before = ui.view()
    held = before.to_source(300, 200)
    ui.ctx.mouse_drag_with_delta((75, -40))
    ui.rest()
    x, y = ui.view().to_output(*held)
    # Dear ImGui takes a press for a drag only after some pixels; the picture follows from there.
    assert abs(x - 375) < 1 and abs(y - 160) < 1, (x, y)
    assert ui.view().scale == before.scale
    assert_shows(ui.pixels(), field, ui.view())
    ui.press("1")
    ui.rest()
    assert ui.session.camera.scale == 1.0
    assert all(value == round(value) for value in ui.view().origin)
    # At 1:1 one sees the source, pixel for pixel.
    x, y = (round(-value) for value in ui.view().origin)
    height, width = field.size
    shown = ui.pixels()[y : y + height, x : x + width]
    source = ui.session.state.document.pixels[..., :3] / 255
    assert np.array_equal(shown, source.astype(np.float32))
    ui.press("F")
    ui.rest()
    assert ui.view() == fitted
    ui.press("+")
    ui.rest()
    assert abs(ui.session.camera.scale / fitted.scale[0] - 2**0.5) < 1e-6
    corner = ui.view().origin
    ui.press("Right")
    ui.rest()
    assert ui.view().origin[0] > corner[0]
    ui.move(320, 200)
    ui.ctx.mouse_double_click()
    ui.rest()
    assert ui.view() == fitted


def overlays(ui: Ui, folder: Path) -> None:
    open_field(ui, folder)
    plain = ui.pixels()
    ui.press("C")
    ui.rest()
    centers = ui.pixels()
    assert ui.session.state.overlay == "centers"
    changed = (np.abs(centers - plain).max(2) > 0.02).mean()
    assert 0.005 < changed < 0.9, changed
    ui.press("E")
    ui.rest()
    ellipses = ui.pixels()
    assert (np.abs(ellipses - centers).max(2) > 0.02).mean() > 0.005
    ui.ctx.item_input_value("//Overlay/Ellipse size", 1.0)
    ui.rest()
    assert ui.session.state.sigma == 1.0
    assert (np.abs(ui.pixels() - ellipses).max(2) > 0.02).mean() > 0.005
    ui.press("E")
    ui.rest()
    assert np.abs(ui.pixels() - plain).max() <= 1.01 / 255


def export_the_whole(ui: Ui, folder: Path) -> None:
    from gsasr import image
    from gsasr.view import View

    field = open_field(ui, folder)
    target = folder / "out.png"
    ui.press("Ctrl+E")
    ui.ctx.item_input_value("//###Export/Scale", 2.5)
    ui.ctx.item_input_value("//###Export/File", str(target))
    ui.ctx.yield_()
    ui.ctx.item_click("//###Export/Export")
    ui.rest()
    assert "100×75" in ui.session.state.message.text, ui.session.state.message
    written = image.read(target).color
    assert written.shape == (75, 100, 3)
    expected = oracle(field, View.at_scale(field.size, 2.5))
    assert np.abs(written - expected).max() <= 0.5 / 255 + 1e-4


def export_the_view(ui: Ui, folder: Path) -> None:
    from gsasr import image
    from gsasr.view import View

    field = open_field(ui, folder)
    ui.move(40, 100)
    for _ in range(8):
        ui.ctx.mouse_wheel_y(1.0)
    ui.rest()
    target = folder / "view.png"
    ui.press("Ctrl+E")
    ui.ctx.item_click("//###Export/Current view")
    ui.ctx.item_input_value("//###Export/File", str(target))
    ui.ctx.yield_()
    ui.ctx.item_click("//###Export/Export")
    ui.rest()
    written = image.read(target).color
    # Exactly the pixels of the canvas that lie on the picture
    view, shown = ui.view(), ui.pixels()
    left, top = (max(0, round(np.ceil(side.round(6)))) for side in np.array(view.to_output(0, 0)))
    right, bottom = np.array(view.to_output(*field.size[::-1])).round(6)
    assert left > 0 and right > view.size[1]  # the view cuts the picture
    part = np.s_[top : min(view.size[0], int(bottom)), left : min(view.size[1], int(right))]
    assert written.shape == shown[part].shape, (written.shape, shown[part].shape, view)
    assert np.abs(written - shown[part]).max() <= 1.01 / 255
    corner = View(view.to_source(left, top), view.scale, written.shape[:2])
    expected = oracle(field, every(corner, 5))
    assert np.abs(written[::5, ::5] - expected).max() <= 0.5 / 255 + 1e-4


def export_below_one_to_one(ui: Ui, folder: Path) -> None:
    from gsasr import image
    from gsasr.rasterize.antialias import integrated
    from gsasr.view import View

    field = open_field(ui, folder)
    view = View.at_scale(field.size, 0.5)
    smooth, sampled = oracle(integrated(field, view), view), oracle(field, view)
    assert np.abs(smooth - sampled).max() > 3 / 255
    for name, expected in (("smooth.png", smooth), ("sampled.png", sampled)):
        ui.press("Ctrl+E")
        ui.ctx.item_click("//###Export/Whole picture")
        ui.ctx.item_input_value("//###Export/Scale", 0.5)
        ui.ctx.item_input_value("//###Export/File", str(folder / name))
        ui.ctx.yield_()
        if name == "sampled.png":  # antialiased unless one chooses otherwise
            ui.ctx.item_click("//###Export/Antialias")
        ui.ctx.item_click("//###Export/Export")
        ui.rest()
        assert np.abs(image.read(folder / name).color - expected).max() <= 0.5 / 255 + 1e-4
    # From 1:1 on there is no such choice.
    ui.press("Ctrl+E")
    ui.ctx.item_input_value("//###Export/Scale", 1.0)
    ui.ctx.yield_()
    assert not ui.ctx.item_exists("//###Export/Antialias")


def export_errors_are_shown(ui: Ui, folder: Path) -> None:
    open_field(ui, folder)
    ui.press("Ctrl+E")
    ui.ctx.item_input_value("//###Export/File", str(folder / "missing" / "out.png"))
    ui.ctx.yield_()
    ui.ctx.item_click("//###Export/Export")
    ui.rest()
    message = ui.session.state.message
    assert message.error and "missing does not exist" in message.text
    ui.ctx.item_click("//Message/Close")
    assert ui.session.state.message is None


def open_another_by_drop(ui: Ui, folder: Path) -> None:
    from PIL import Image

    open_field(ui, folder)
    colors = np.zeros((20, 30, 4), np.uint8)
    colors[..., 0], colors[..., 3] = 200, 255
    colors[:10, :, 3] = 0
    path = folder / "red.png"
    Image.fromarray(colors).save(path)
    ui.on_window(lambda: ui.app.drop([str(path)]))
    ui.until(lambda: ui.session.state.document.path == path)
    assert ui.session.state.document.size == (20, 30)
    ui.rest()
    assert ui.session.ready, ui.session.state.message
    assert ui.session.state.document.model == "model"
    assert ui.session.state.document.count > 0
    ui.press("1")
    ui.rest()
    x, y = (round(-value) for value in ui.view().origin)
    shown = ui.pixels()[y : y + 20, x : x + 30] * 255
    assert (shown[10:] == (200, 0, 0)).all()
    assert set(np.unique(shown[:10]).round()) == {158, 199}  # a checkerboard


def cancel_prediction(ui: Ui, folder: Path) -> None:
    from PIL import Image

    path = folder / "large.png"
    rng = np.random.default_rng(0)
    Image.fromarray(rng.integers(0, 255, (900, 1200, 3), dtype=np.uint8)).save(path)
    ui.session.open(path)
    ui.until(lambda: ui.session.state.document is not None and ui.session.state.document.count > 0)
    assert ui.session.worker.tasks
    ui.ctx.item_click("//Status/Cancel")
    ui.rest()
    assert not ui.session.ready
    assert ui.session.state.message is None
    count = ui.session.state.document.count
    ui.ctx.yield_(10)
    assert ui.session.state.document.count == count < 900 * 1200 * 4
    # The picture can still be looked at, and what has arrived is drawn.
    ui.move(320, 200)
    for _ in range(12):
        ui.ctx.mouse_wheel_y(1.0)
    ui.rest()
    assert ui.pixels().std() > 0.05


def a_large_picture_comes_and_goes_by_tiles(ui: Ui, folder: Path) -> None:
    from PIL import Image

    from gsasr import image, load_model
    from gsasr.prediction import predict

    path, target = folder / "wide.png", folder / "wide-view.png"
    rng = np.random.default_rng(0)
    Image.fromarray(rng.integers(0, 255, (90, 900, 3), dtype=np.uint8)).save(path)
    model = load_model(str(folder / "model.safetensors"))
    field = predict(model, image.read(path).color, 4.0, tile=192)
    most = ui.session.state.gpu_memory
    try:
        with counted_predictions() as predicted:
            ui.session.open(path)
            ui.until(lambda: showing(ui.session, path))
            ui.rest()
            assert ui.session.ready and len(predicted) == 5
            tiles = ui.session.state.document.tiles
            assert tiles.shown_bytes < most  # all five fit; now two do
            ui.on_window(lambda: ui.session.set_gpu_memory(tiles.shown_bytes // 2))
            assert 0 < tiles.shown_bytes <= ui.session.state.gpu_memory
            for x in (30, 870, 450, 30):
                ui.on_window(lambda x=x: ui.session.camera.look_at(x, 40, 16.0))
                ui.until(lambda: ui.session.scene.covers(ui.view()))
                ui.rest()
                assert tiles.shown_bytes <= ui.session.state.gpu_memory
                near = (field.mean[:, 0] - x).abs() < 30
                assert_shows(ui.pixels(), field[near], ui.view(), step=13)
            assert len(predicted) == 5  # what came back came from memory
        shown, view = ui.pixels(), ui.view()
        # An export has the same pixels.
        ui.press("Ctrl+E")
        ui.ctx.item_click("//###Export/Current view")
        ui.ctx.item_input_value("//###Export/File", str(target))
        ui.ctx.yield_()
        ui.ctx.item_click("//###Export/Export")
        ui.rest()
        written = image.read(target).color
        left, top = (max(0, round(side)) for side in view.to_output(0, 0))
        part = shown[top : top + written.shape[0], left : left + written.shape[1]]
        assert np.abs(part - written).max() <= 1.51 / 255
    finally:
        ui.on_window(lambda: ui.session.set_gpu_memory(most))


def showing(session, path: Path) -> bool:
    return session.state.document is not None and session.state.document.path == path


@contextmanager
def counted_predictions():
    """A list that grows by one with each tile that is predicted."""
    from gsasr import prediction

    predicted, predict_tile = [], prediction.predict_tile

    def counted(model, picture, tile, *options):
        predicted.append(tile)
        return predict_tile(model, picture, tile, *options)

    prediction.predict_tile = counted
    try:
        yield predicted
    finally:
        prediction.predict_tile = predict_tile


def a_full_gpu_is_a_message_and_a_smaller_budget(ui: Ui, folder: Path) -> None:
    from PIL import Image

    from gsasr.errors import BackendError

    path = folder / "wide.png"
    rng = np.random.default_rng(0)
    Image.fromarray(rng.integers(0, 255, (40, 900, 3), dtype=np.uint8)).save(path)
    session, most = ui.session, ui.session.state.gpu_memory
    upload = type(session.scene).adding

    def full(scene, packed):
        if len(scene.tiles) >= 3:
            raise BackendError("full")
        yield from upload(scene, packed)

    type(session.scene).adding = full
    try:
        session.open(path)
        ui.until(lambda: showing(session, path))
        ui.rest()
        message = session.state.message
        assert message.error and "room" in message.text and message.text.count(". ") == 0
        assert session.ready and not session.worker.tasks
        tiles = session.state.document.tiles
        assert 0 < tiles.shown_bytes <= session.state.gpu_memory < most
        # It goes on: what one looks at comes all the same.
        ui.on_window(lambda: session.camera.look_at(20, 20, 16.0))
        ui.until(lambda: session.scene.covers(ui.view()))
        ui.on_window(lambda: session.camera.look_at(880, 20, 16.0))
        ui.until(lambda: session.scene.covers(ui.view()))
        ui.rest()
    finally:
        type(session.scene).adding = upload
        session.state.message = None


def errors_are_shown(ui: Ui, folder: Path) -> None:
    field = open_field(ui, folder)
    damaged = folder / "damaged.png"
    damaged.write_bytes(b"\x89PNG\r\n\x1a\n" + b"no picture" * 20)
    for path in (damaged, folder / "nowhere.png", folder):
        ui.on_window(lambda path=path: ui.app.drop([str(path)]))
        ui.until(lambda: ui.session.state.message is not None)
        message = ui.session.state.message
        assert message.error and str(path) in message.text and message.text.count(". ") == 0
        ui.press("Escape")
        assert ui.session.state.message is None
    ui.rest()
    assert_shows(ui.pixels(), field, ui.view())  # the document before is untouched


def typing_is_not_taken_for_keys(ui: Ui, folder: Path) -> None:
    open_field(ui, folder)
    scale = ui.session.camera.scale
    ui.press("Ctrl+E")
    ui.ctx.item_click("//###Export/File")
    ui.ctx.key_chars_replace("fec1")
    for keys in ("F", "E", "C", "1"):
        ui.press(keys)
    ui.rest()
    assert ui.session.state.overlay == "none"
    assert ui.session.camera.scale == scale
    ui.press("Escape")  # leaves the text field
    ui.press("Escape")  # closes the dialog
    assert not ui.session.state.dialogs
    ui.press("?")
    assert ui.session.state.dialogs == {"Help"}
    ui.press("F1")
    assert not ui.session.state.dialogs


SCENARIOS = (
    zoom_at_the_cursor,
    pan_fit_and_one_to_one,
    overlays,
    export_the_whole,
    export_the_view,
    export_below_one_to_one,
    export_errors_are_shown,
    open_another_by_drop,
    cancel_prediction,
    a_large_picture_comes_and_goes_by_tiles,
    a_full_gpu_is_a_message_and_a_smaller_budget,
    errors_are_shown,
    typing_is_not_taken_for_keys,
)


def main(folder: Path, names: list[str]) -> int:
    """Run the scenarios (default: all) in one window; print a JSON of name -> traceback or ""."""
    from imgui_bundle import hello_imgui, imgui

    from viewer import app

    results: dict[str, str] = {}

    def run(ctx, application, scenario: Callable) -> None:
        ui = Ui(application, ctx)
        session = ui.session
        try:
            session.worker.cancel_all()
            ui.until(lambda: not session.worker.tasks)
            session.state.dialogs.clear()
            session.set_overlay("none")
            scenario(ui, folder)
            results[scenario.__name__] = ""
        except BaseException:
            results[scenario.__name__] = traceback.format_exc()

    def tests(application) -> None:
        engine = hello_imgui.get_imgui_test_engine()
        hello_imgui.get_runner_params().fps_idling.enable_idling = False
        chosen = [s for s in SCENARIOS if not names or s.__name__ in names]
        for scenario in chosen:
            test = imgui.test_engine.register_test(engine, "viewer", scenario.__name__)

            def function(ctx, scenario=scenario) -> None:
                run(ctx, application, scenario)
                application.session.quitting = scenario is chosen[-1]

            test.test_func = function
            imgui.test_engine.queue_test(engine, test)

    before = set(os.listdir())
    app.run(None, str(folder / "model.safetensors"), 4.0, SIZE, tests)
    new = sorted(set(os.listdir()) - before)
    results["leaves_no_files_behind"] = f"left in the working directory: {new}" if new else ""
    print(json.dumps(results))
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), sys.argv[2:]))
