"""The real program, in a real window, used as a person would use it."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import viewer_scenarios as scenarios
from conftest import make_tiny_model

from gsasr.errors import RequestError
from gsasr.model import save_model
from gsasr.view import View
from viewer import snapshot
from viewer.scene import Scene
from viewer.store import TileStore

pytestmark = pytest.mark.ui

ROOT = Path(__file__).parent.parent
SCENARIOS = [*(scenario.__name__ for scenario in scenarios.SCENARIOS), "leaves_no_files_behind"]


def viewer(*arguments: object, environment: dict[str, str] | None = None, cwd: Path = ROOT):
    """The finished process of `python -m viewer ARGUMENTS`."""
    return subprocess.run(
        [sys.executable, "-m", "viewer", *map(str, arguments)],
        cwd=cwd,
        env=os.environ | {"PYTHONPATH": str(ROOT)} | (environment or {}),
        capture_output=True,
        text=True,
        timeout=60,
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """With a network that runs in milliseconds, at model.safetensors."""
    path = tmp_path_factory.mktemp("viewer")
    save_model(make_tiny_model(), path / "model.safetensors")
    return path


@pytest.fixture(scope="module")
def results(folder, display, tmp_path_factory) -> dict[str, str]:
    """Name -> traceback or "" of all scenarios, played in one window."""
    done = subprocess.run(
        [sys.executable, ROOT / "tests" / "viewer_scenarios.py", folder],
        cwd=tmp_path_factory.mktemp("empty"),
        env=os.environ | {"DISPLAY": display, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=300,
    )
    lines = [line for line in done.stdout.splitlines() if line.startswith("{")]
    assert lines, done.stdout + done.stderr
    return json.loads(lines[-1])


@pytest.mark.parametrize("name", SCENARIOS)
def test_scenario(results, name):
    assert name in results, f"did not run; ran {sorted(results)}"
    if results[name]:
        pytest.fail(results[name], pytrace=False)


@pytest.mark.skipif(shutil.which("xdotool") is None, reason="needs xdotool")
def test_mouse_and_keys_of_the_desktop(folder, display):
    """The same through X and GLFW: what the test engine presses does not pass through those."""
    script = ROOT / "tests" / "viewer_desktop.py"
    done = subprocess.run(
        [sys.executable, script, folder],
        cwd=folder,
        env=os.environ | {"DISPLAY": display, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_gpu_memory_is_given_in_units():
    from viewer import arguments

    assert arguments.parse(["--gpu-memory", "1.5G"]).gpu_memory == 3 << 29
    assert arguments.parse(["--gpu-memory", "512m"]).gpu_memory == 512 << 20
    assert arguments.parse([]).gpu_memory is None


@pytest.mark.parametrize("text", ["512", "3T", "2", "1M", "G", "-2G", "1e300G", ""])
def test_gpu_memory_without_a_unit_or_beyond_sense_is_refused(text):
    from viewer import arguments

    with pytest.raises(RequestError, match="gpu-memory"):
        arguments.parse([f"--gpu-memory={text}"])


def test_a_snapshot_whose_gaussians_the_gpu_may_not_hold_is_refused(gl_context):
    scene, field = Scene(gl_context), scenarios.make_field()
    scene.set_picture(np.zeros((*field.size, 4), np.uint8))
    tiles = TileStore([(0, 0, field.size[1], field.size[0])])
    tiles.keep(0, field)
    view = View.at_scale(field.size, 2.0)
    snapshot._fill(scene, tiles, view, 1 << 24)
    assert scene.covers(view)
    with pytest.raises(RequestError, match="--gpu-memory"):
        snapshot._fill(scene, tiles, view, sum(tile.nbytes for tile in scene.tiles) - 1)
    scene.release()


def test_a_reset_of_the_driver_ends_in_one_sentence(folder, display, images):
    script = (
        "import sys; from viewer import __main__, app; frames = iter(range(10**6));"
        "app.lost = lambda ctx: next(frames) > 5;"
        "app.has_native = lambda: False;"
        f"sys.exit(__main__.main([{str(images / 'cat.png')!r}]))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script],
        cwd=folder,
        env=os.environ | {"DISPLAY": display, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 2
    assert "reset" in done.stderr and done.stderr.count("\n") == 1, done.stderr


def test_without_a_display_it_names_the_way_without_one(images):
    environment = {"DISPLAY": "", "WAYLAND_DISPLAY": ""}
    done = viewer(images / "cat.png", environment=environment)
    assert done.returncode == 2
    assert "--snapshot" in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["missing.png"], "missing.png does not exist"),
        (["missing.safetensors"], "missing.safetensors does not exist"),
        (["."], "is a folder"),
        (["--size", "12"], "--size"),
        (["--gpu-memory", "512"], "--gpu-memory"),
        (["--zoom", "-1", "--snapshot", "out.png"], "--zoom"),
        (["--snapshot", "out.png"], "picture"),
        (["--no-such-option"], "--no-such-option"),
    ],
)
def test_a_mistake_on_the_command_line_is_one_sentence(arguments, part):
    done = viewer(*arguments)
    assert done.returncode == 2
    assert part in done.stderr
    assert done.stderr.count("\n") == 1, done.stderr
