"""Fixtures shared by several test files."""

from pathlib import Path

import pytest
import torch

from gsasr.errors import BackendError


@pytest.fixture(scope="session")
def gl_context():
    """One headless OpenGL context for all tests of the main thread, software or not."""
    from gsasr.rasterize import gl

    try:
        return gl.create_context()
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
