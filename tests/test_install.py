"""The wheel alone is enough: built, installed in a clean environment, and put to work there."""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent

PROGRAM = """
from pathlib import Path

import torch
import gsasr
from gsasr.files import shipped
from gsasr.gaussians import Gaussians
from gsasr.rasterize import render

field = Gaussians(
    mean=torch.tensor([[2.5, 1.5]]),
    std=torch.tensor([[1.0, 1.0]]),
    rho=torch.zeros(1),
    color=torch.tensor([[1.0, 0.5, 0.25]]),
    opacity=torch.ones(1),
    size=(3, 5),
)
picture = render(field, gsasr.View.at_scale(field.size, 1), backend="cpu")
assert picture.shape == (3, 5, 3)
assert torch.allclose(picture[1, 2], field.color[0])  # the peak lies on that pixel's centre
for name in ("shaders/gaussian.glsl", "assets/images/astronaut.png"):
    assert shipped(name).is_file(), shipped(name)
assert (Path(gsasr.__file__).parent / "rasterize" / "kernels.cu").is_file()
print(gsasr.__file__)
print(shipped("shaders"))
"""


def run(*command: str | Path, cwd: Path) -> str:
    environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    done = subprocess.run(
        [str(part) for part in command], cwd=cwd, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> Path:
    """A new environment that holds the wheel, and sees the installed dependencies."""
    folder = tmp_path_factory.mktemp("install")
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check")
    build = ("wheel", "--quiet", "--no-deps", "--no-build-isolation", "--wheel-dir", folder, ROOT)
    run(*pip, *build, cwd=folder)
    (wheel,) = folder.glob("gsasr-*.whl")
    environment = folder / "venv"
    run(sys.executable, "-m", "venv", "--without-pip", environment, cwd=folder)
    python = environment / "bin" / "python"
    run(*pip, "--python", python, "install", "--no-deps", "--no-index", wheel, cwd=folder)
    # The line of a .pth file adds that folder alone, not the .pth files in it: the dependencies
    # are found, an editable install of the checkout is not.
    purelib = sysconfig.get_path("purelib", vars={"base": str(environment)})
    Path(purelib, "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return environment


def test_renders_with_what_the_wheel_carries(installed, tmp_path):
    output = run(installed / "bin" / "python", "-I", "-c", PROGRAM, cwd=tmp_path)
    for line in output.splitlines():
        assert Path(line).is_relative_to(installed), line


@pytest.mark.parametrize("name", ["gsasr", "gsasr-viewer"])
def test_commands(installed, tmp_path, name):
    assert "usage" in run(installed / "bin" / name, "--help", cwd=tmp_path).lower()
