"""Fixtures shared by several test files."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest
import torch

from gsasr.errors import BackendError


@pytest.fixture(scope="session")
def gl_context():
    """One headless OpenGL context for all tests of the main thread, software or not."""
    from gsasr.rasterize.opengl import create_context

    try:
        return create_context()
    except BackendError as failure:
        pytest.skip(str(failure))


@pytest.fixture(scope="session")
def golden() -> Path:
    """Folder of tensors made by the released implementation."""
    return Path(__file__).parent / "golden"


@pytest.fixture(scope="session")
def images() -> Path:
    """Folder of the sample pictures."""
    return Path(__file__).parent.parent / "assets" / "images"


@pytest.fixture
def tiny_model():
    """See make_tiny_model."""
    return make_tiny_model()


@pytest.fixture(scope="session")
def display():
    """Name of an X display of our own, so that nobody's mouse is in the way; else of the user's."""
    if shutil.which("Xvfb") is None:
        if not os.environ.get("DISPLAY"):
            pytest.skip("There is no display, and Xvfb, which makes one, is not installed.")
        yield os.environ["DISPLAY"]
        return
    read, write = os.pipe()
    command = ["Xvfb", "-displayfd", str(write), "-screen", "0", "1280x800x24", "-nolisten", "tcp"]
    server = subprocess.Popen(command, pass_fds=[write], stderr=subprocess.DEVNULL)
    os.close(write)
    with os.fdopen(read) as number:
        name = number.readline().strip()  # written once it accepts connections
    yield f":{name}"
    server.terminate()
    server.wait()


def make_tiny_model():
    """An untrained network that runs in milliseconds, 4 Gaussians per pixel, window 4."""
    from gsasr.model import GSASR, ModelConfig
    from gsasr.model.decoder import DecoderConfig
    from gsasr.model.encoders import EDSRConfig

    torch.manual_seed(0)
    decoder = DecoderConfig(
        channels=8,
        heads=2,
        window=4,
        seeds=4,
        self_blocks=1,
        self_layers=2,
        shuffle=(2, 1),
        head_expansion=1,
    )
    return GSASR(ModelConfig(EDSRConfig(channels=8, blocks=1), decoder), "tiny").eval()
