"""The CUDA rasterizer: on a card where there is one, else its kernels built for this host."""

import sys
from pathlib import Path

import pytest
import torch
from fields import EXTREMES, one, random_field
from host_kernels import built

from gsasr.errors import BackendError, RequestError
from gsasr.gaussians import Gaussians
from gsasr.rasterize import cuda, footprint, nvrtc, operator, reference, render, render_batch
from gsasr.rasterize.batch import pictures, views_tensor
from gsasr.view import View

HERE = Path(__file__).parent
KERNELS = HERE.parent / "gsasr" / "rasterize" / "kernels.cu"
VIEWS = {
    "x1": View.at_scale((9, 13), 1),
    "x4": View.at_scale((9, 13), 4),
    "x2.5": View.at_scale((9, 13), 2.5),
    "x12": View.at_scale((9, 13), 12),
    "x30": View.at_scale((9, 13), 30),
    "sticks out": View((-3.3, -2.1), (3.0, 3.0), (41, 57)),
    "anisotropic": View((5.7, 4.2), (7.9, 2.3), (33, 47)),
    "outside": View((100.0, 100.0), (4.0, 4.0), (8, 8)),
    "deep": View((4.1234, 3.777), (900.0, 900.0), (20, 30)),
    "empty": View((0.0, 0.0), (1.0, 1.0), (0, 7)),
}


@pytest.fixture(scope="session")
def host(tmp_path_factory):
    """Launches kernels.cu on this host, thread after thread."""
    sizes = (
        'extern "C" int size_of_picture() { return sizeof(Picture); }'
        'extern "C" int size_of_splat() { return sizeof(Splat); }'
    )
    return built(KERNELS, tmp_path_factory.mktemp("host"), sizes)


@pytest.fixture(params=["host", pytest.param("card", marks=pytest.mark.cuda)])
def launch(request):
    """The same tests on both; (launch, device)."""
    if request.param == "host":
        return request.getfixturevalue("host"), torch.device("cpu")
    if not torch.cuda.is_available():
        pytest.skip("needs an NVIDIA GPU")
    return None, torch.device("cuda", 0)


def prepared(fields, views, quality):
    """The arguments of cuda.forward for these pictures."""
    fields = list(fields)
    tensors = [
        torch.cat([getattr(f, name) for f in fields]) for name in ("mean", "std", "rho", "peak")
    ]
    cut = torch.cat([footprint.cut(f, quality) for f in fields])
    counts = [len(f) for f in fields]
    heights, widths = zip(*(v.size for v in views), strict=True)
    return [*tensors, cut], pictures(views_tensor(views), counts, heights, widths)


def drawn(field, view, quality, launch):
    run, device = launch
    tensors, batch = prepared([field], [view], quality)
    pixels = cuda.forward(*(t.to(device) for t in tensors), batch, run)
    return pixels.view(*view.size, 3).cpu()


def largest_difference(a, b):
    return float((a - b).abs().max()) if a.numel() else 0.0


def test_the_tables_have_the_layout_of_the_kernels(host):
    assert host.library.size_of_picture() == cuda.PICTURE.itemsize
    assert host.library.size_of_splat() == 4 * cuda.SPLAT
    assert f"#define STRIP {cuda.STRIP} " in KERNELS.read_text()


@pytest.mark.parametrize("quality", ["screen", "export", "gradient"])
@pytest.mark.parametrize("view", VIEWS.values(), ids=VIEWS.keys())
def test_images_agree_with_the_oracle(launch, view, quality):
    field = random_field(600, (9, 13))
    tolerance = {"screen": 1e-3, "export": 1e-4, "gradient": 1e-4}[quality]
    image = drawn(field, view, quality, launch)
    assert largest_difference(image, reference.render(field, view)) < tolerance


@pytest.mark.parametrize("field", EXTREMES.values(), ids=EXTREMES.keys())
@pytest.mark.parametrize("scale", [1, 4, 31])
def test_images_agree_with_the_oracle_on_extremes(launch, field, scale):
    view = View.at_scale((1, 1), scale)
    image = drawn(field, view, "export", launch)
    assert bool(torch.isfinite(image).all())
    assert largest_difference(image, reference.render(field, view)) < 1e-4


def test_images_stay_exact_far_from_the_corner_of_a_large_picture(launch):
    field = random_field(400, (9, 13)).map(lambda tensor: tensor.clone())
    field.mean[:] += 30_000.0
    view = View((30_001.0, 30_002.0), (8.0, 8.0), (50, 60))
    image = drawn(field, view, "export", launch)
    assert largest_difference(image, reference.render(field, view)) < 1e-4


def test_a_gaussian_that_is_not_finite_is_not_drawn(launch):
    nan = float("nan")
    for broken in (
        one((nan, 0.5), (1, 1)),
        one((0.5, 0.5), (nan, 1)),
        one((0.5, 0.5), (1, 1), nan),
    ):
        image = drawn(broken, View.at_scale((1, 1), 4), "gradient", launch)
        assert float(image.abs().max()) == 0.0


@pytest.mark.parametrize("scale", [1.0, 4.0, 13.0])
def test_gradients_equal_autograd_of_the_oracle(launch, scale):
    run, device = launch
    field, view = random_field(300, (9, 13)), View((-1.3, 2.2), (scale, 0.8 * scale), (31, 47))
    upstream = torch.randn(*view.size, 3, generator=torch.Generator().manual_seed(1))
    exact = field.map(lambda tensor: tensor.double().requires_grad_(True))
    peak = exact.peak
    peak.retain_grad()
    g = exact.map(lambda tensor: tensor)
    weights = reference.render(g, view)
    (weights * upstream).sum().backward()
    tensors, batch = prepared([field], [view], "gradient")
    grads = cuda.backward(
        upstream.view(-1, 3).to(device), *(t.to(device) for t in tensors), batch, run
    ).cpu()
    expected = {
        "mean": (grads[:, 0:2], exact.mean.grad),
        "std": (grads[:, 2:4], exact.std.grad),
        "rho": (grads[:, 4], exact.rho.grad),
        "color": (grads[:, 5:8] * field.opacity[:, None], exact.color.grad),
        "opacity": ((grads[:, 5:8] * field.color).sum(1), exact.opacity.grad),
    }
    for name, (ours, truth) in expected.items():
        assert largest_difference(ours, truth) < 1e-3 * float(truth.abs().max()), name


def test_a_batch_of_different_pictures_equals_each_alone(launch):
    run, device = launch
    fields = [random_field(n, (9, 13), seed=n) for n in (300, 0, 200, 50)]
    views = [View.at_scale((9, 13), 3.3), VIEWS["empty"], VIEWS["outside"], VIEWS["x1"]]
    tensors, batch = prepared(fields, views, "gradient")
    tensors = [t.to(device) for t in tensors]
    pixels = cuda.forward(*tensors, batch, run)
    upstream = torch.randn(pixels.shape, generator=torch.Generator().manual_seed(2)).to(device)
    grads = cuda.backward(upstream, *tensors, batch, run)
    for field, view, picture in zip(fields, views, batch, strict=True):
        alone, single = prepared([field], [view], "gradient")
        alone = [t.to(device) for t in alone]
        assert torch.equal(cuda.forward(*alone, single, run), pixels[picture.pixels])
        expected = cuda.backward(upstream[picture.pixels], *alone, single, run)
        assert torch.equal(expected, grads[picture.gaussians])


def test_work_that_does_not_fit_at_once_is_done_in_portions(launch, monkeypatch):
    field, view = random_field(500, (9, 13)), VIEWS["x4"]
    whole = drawn(field, view, "export", launch)
    monkeypatch.setattr(cuda, "ENTRIES", 100)
    assert largest_difference(drawn(field, view, "export", launch), whole) < 1e-6


def test_results_are_bit_equal_from_run_to_run(launch):
    field, view = random_field(3000, (24, 24)), View.at_scale((24, 24), 3)
    first, second = (drawn(field, view, "gradient", launch) for _ in range(2))
    assert torch.equal(first, second)


@pytest.fixture(scope="session")
def architectures():
    try:
        return nvrtc.supported()
    except BackendError as error:
        pytest.skip(str(error))


@pytest.mark.parametrize("capability", [75, 80, 90, 100])
def test_the_kernels_compile_for_every_generation(architectures, capability, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    binary = nvrtc.compiled(capability)
    assert binary.startswith(b"\x7fELF")
    for name in (b"project", b"fill", b"gather", b"backward"):
        assert b".text." + name in binary


def test_compiled_kernels_are_kept_on_disk(architectures, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    binary = nvrtc.compiled(90)
    (kept,) = (tmp_path / "gsasr").iterdir()
    kept.write_bytes(b"kept")
    assert nvrtc.compiled(90) == b"kept" != binary


def test_a_cache_that_cannot_be_written_only_costs_time(architectures, tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert nvrtc.compiled(90).startswith(b"\x7fELF")


def test_cards_get_code_that_they_can_run(architectures):
    assert nvrtc._target(86, [75, 80, 86, 90]) == "sm_86"
    assert nvrtc._target(89, [75, 80, 86, 90]) == "sm_86"
    assert nvrtc._target(120, [75, 80, 86, 90]) == "compute_90"
    assert nvrtc._target(100, [75, 80, 90, 120]) == "compute_90"
    with pytest.raises(BackendError, match=r"capability 7.0, but the kernel needs 7.5"):
        nvrtc._target(70, [75, 80])


def test_a_kernel_that_does_not_compile_says_what_the_compiler_says(architectures, tmp_path):
    (tmp_path / "broken.cu").write_text("this is no C++")
    with pytest.raises(BackendError, match=r"cannot compile broken.cu: .*error"):
        nvrtc.compiled(90, tmp_path / "broken.cu")


def test_without_a_card_the_backend_says_so():
    if torch.cuda.is_available():
        pytest.skip("there is one")
    with pytest.raises(BackendError, match=r"cuda backend cannot run: .*; use --backend gl or cpu"):
        render(random_field(1, (1, 1)), View.at_scale((1, 1), 1), backend="cuda")


def test_a_pytorch_for_cards_of_another_maker_has_no_such_backend(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.version, "cuda", None)
    with pytest.raises(BackendError, match="built without CUDA; use --backend gl or cpu"):
        cuda.require()


def test_without_nvrtc_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "cuda.bindings", None)
    with pytest.raises(BackendError, match=r"pip install 'gsasr\[cuda\]'"):
        nvrtc.supported()


def test_without_the_library_of_nvrtc_the_error_says_what_to_install(architectures, monkeypatch):
    def not_found():
        raise RuntimeError("Failure finding libnvrtc.so")

    monkeypatch.setattr("cuda.bindings.nvrtc.nvrtcGetSupportedArchs", not_found)
    with pytest.raises(BackendError, match=r"libnvrtc.*pip install 'gsasr\[cuda\]'"):
        nvrtc.supported()


class TestTheOperator:
    """torch.ops.gsasr.rasterize, on the CPU."""

    def arguments(self, grad: bool):
        fields = [random_field(40, (5, 7), seed=seed) for seed in (1, 2)]
        views = [View.at_scale((5, 7), 2), View.at_scale((5, 7), 3.3)]
        names = ("mean", "std", "rho", "peak")
        tensors = [torch.cat([getattr(f, name) for f in fields]) for name in names]
        cut = torch.cat([footprint.cut(f, "gradient") for f in fields])
        heights, widths = ([view.size[axis] for view in views] for axis in (0, 1))
        tensors = [tensor.requires_grad_(grad) for tensor in tensors]
        return (*tensors, cut, views_tensor(views), [40, 40], heights, widths)

    @pytest.mark.parametrize("grad", [False, True])
    def test_passes_the_checks_of_pytorch(self, grad):
        torch.library.opcheck(operator.rasterize, self.arguments(grad))

    def test_compiles_without_a_graph_break(self):
        def loss(*arguments):
            return operator.rasterize(*arguments).square().sum()

        compiled = torch.compile(loss, backend="aot_eager", fullgraph=True)
        ours, expected = self.arguments(True), self.arguments(True)
        compiled(*ours).backward()
        loss(*expected).backward()
        for a, b in zip(ours[:4], expected[:4], strict=True):
            torch.testing.assert_close(a.grad, b.grad)


def test_a_batch_is_drawn_by_the_public_function_with_gradients():
    fields = [random_field(n, (5, 7), seed=n).map(lambda t: t.requires_grad_(True)) for n in (9, 4)]
    views = [View.at_scale((5, 7), 2), View.at_scale((5, 7), 3.3)]
    together = render_batch(Gaussians.concatenate(fields), [9, 4], views)
    for image, field, view in zip(together, fields, views, strict=True):
        assert torch.equal(image, render(field, view, backend="cpu"))
    sum(image.sum() for image in together).backward()
    assert all(float(field.mean.grad.abs().sum()) > 0 for field in fields)


def test_a_batch_whose_counts_do_not_add_up_is_refused():
    with pytest.raises(RequestError, match="one count per picture"):
        render_batch(random_field(5, (1, 1)), [2, 2], [VIEWS["x1"], VIEWS["x1"]])
