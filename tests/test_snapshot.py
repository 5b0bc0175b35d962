"""viewer --snapshot: the window's view without a window."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import make_tiny_model
from test_viewer import viewer
from viewer_scenarios import assert_shows, make_field

from gsasr import image
from gsasr.model import save_model
from gsasr.prediction import predict
from gsasr.view import View


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("snapshot")
    save_model(make_tiny_model(), path / "model.safetensors")
    make_field().save(path / "field.safetensors")
    return path


def test_a_saved_field_is_what_the_oracle_says(gl_context, folder):
    out = folder / "out.png"
    field = folder / "field.safetensors"
    done = viewer(field, "--snapshot", out, "--size", "320x240", "--zoom", "8", "--center", "20,15")
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""  # no progress bar, as nobody watches
    view = View((0.0, 0.0), (8.0, 8.0), (240, 320))
    assert_shows(image.read(out).color, make_field(), view, step=3)


def test_a_picture_shows_the_gaussians_of_its_network(gl_context, folder):
    pixels = np.random.default_rng(0).random((50, 70, 3), dtype=np.float32)
    image.write(folder / "picture.png", pixels)
    pixels = image.read(folder / "picture.png").color
    out = folder / "tile.png"
    done = viewer(
        folder / "picture.png",
        *("--model", folder / "model.safetensors", "--condition", "3"),
        *("--snapshot", out, "--size", "200x100", "--zoom", "4", "--center", "60,40"),
    )
    assert done.returncode == 0, done.stderr
    field = predict(make_tiny_model(), pixels, 3.0)
    view = View((35.0, 27.5), (4.0, 4.0), (100, 200))
    assert_shows(image.read(out).color, field, view, step=3)


def test_overlays_and_fit(gl_context, folder):
    field = folder / "field.safetensors"
    shown = {}
    for name in ("none", "centers", "ellipses"):
        out = folder / f"{name}.png"
        done = viewer(field, "--snapshot", out, "--size", "400x300", "--overlay", name)
        assert done.returncode == 0, done.stderr
        shown[name] = image.read(out).color
        assert shown[name].shape == (300, 400, 3)
    assert np.abs(shown["centers"] - shown["none"]).max() > 0.2
    assert np.abs(shown["ellipses"] - shown["centers"]).max() > 0.2


@pytest.mark.parametrize(
    ("options", "part"),
    [
        (["--center", "500,2"], "outside"),
        (["--sigma", "9"], "--sigma"),
        (["--condition", "0"], "--condition"),
        (["--overlay", "stars"], "--overlay"),
    ],
)
def test_a_mistake_is_one_sentence(folder, options, part):
    out = folder / "never.png"
    done = viewer(folder / "field.safetensors", "--snapshot", out, *options)
    assert done.returncode == 2
    assert part in done.stderr
    assert done.stderr.count("\n") == 1
    assert not out.exists()


def test_a_suffix_that_cannot_be_written_is_refused(folder):
    done = viewer(folder / "field.safetensors", "--snapshot", folder / "out.xyz")
    assert done.returncode == 2
    assert "out.xyz" in done.stderr


def test_a_damaged_file_leaves_nothing(folder):
    (folder / "damaged.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    done = viewer(folder / "damaged.png", "--snapshot", folder / "none.png")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert not (folder / "none.png").exists() or (folder / "none.png").stat().st_size > 0


def test_without_opengl_it_says_what_to_do(folder):
    done = viewer(
        folder / "field.safetensors",
        *("--snapshot", folder / "gl.png"),
        environment={"MESA_GL_VERSION_OVERRIDE": "3.3", "MESA_LOADER_DRIVER_OVERRIDE": "none"},
    )
    assert done.returncode == 2, done.stderr
    assert "OpenGL 4.3" in done.stderr
    assert done.stderr.rstrip().count("\n") == 0
