"""The baseline of the rasterizer's benchmark really is the paper's algorithm."""

from ctypes import c_float, c_int
from pathlib import Path

import pytest
import torch
from fields import random_field
from host_kernels import built

from gsasr.errors import BackendError
from gsasr.rasterize import nvrtc, reference
from gsasr.view import View

PAPER = Path(__file__).parent.parent / "benchmarks" / "contestants" / "paper.cu"


@pytest.fixture(scope="module")
def launch(tmp_path_factory):
    return built(PAPER, tmp_path_factory.mktemp("paper"))


def test_the_baseline_draws_what_the_paper_draws_forward_and_backward(launch):
    field = random_field(200, (9, 13)).map(lambda tensor: tensor.clone())
    field.rho.clamp_(-0.9, 0.9)
    view = View.at_scale(field.size, 3)
    height, width = view.size
    box = (0.2 * (width - 1) / 2, 0.2 * (height - 1) / 2)
    exact = field.map(lambda tensor: tensor.double().requires_grad_(True))
    truth = reference.render(exact, view, box)
    upstream = torch.randn(height, width, 3, generator=torch.Generator().manual_seed(1))
    (truth * upstream).sum().backward()

    tensors = [t.contiguous() for t in (field.mean, field.std, field.rho, field.peak)]
    shared = (*tensors, c_float(3), *map(c_float, box), c_int(width), c_int(height))
    pixels, grads = torch.zeros(height, width, 3), torch.zeros(len(field), 8)
    launch("paper_forward", len(field), len(field), *shared, pixels)
    launch("paper_backward", len(field), len(field), *shared, upstream, grads)
    torch.testing.assert_close(pixels.double(), truth.detach(), atol=1e-4, rtol=0)
    expected = torch.cat([exact.mean.grad, exact.std.grad, exact.rho.grad[:, None]], dim=1)
    error = (grads[:, :5] - expected).abs().amax(0) / expected.abs().amax(0)
    assert float(error.max()) < 1e-3


def test_the_baseline_compiles_for_a_card(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    try:
        binary = nvrtc.compiled(90, PAPER)
    except BackendError as error:
        pytest.skip(str(error))
    assert b".text.paper_forward" in binary and b".text.paper_backward" in binary
