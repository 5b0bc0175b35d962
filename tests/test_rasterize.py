"""The reference and CPU rasterizers: hand-computed cases, released figures, each other."""

import json
import math

import pytest
import torch
from fields import EXTREMES, one, random_field
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors import safe_open

from gsasr.errors import BackendError, RequestError
from gsasr.gaussians import Gaussians
from gsasr.model import activate
from gsasr.rasterize import footprint, reference, render
from gsasr.view import View

TOLERANCES = {"screen": 1e-3, "export": 1e-4}


def largest_difference(a: torch.Tensor, b: torch.Tensor) -> float:
    return float((a - b).abs().max()) if a.numel() else 0.0


def test_a_gaussian_has_the_values_of_the_formula():
    # mean at (1, 1), std (1, 2): one pixel to the right exp(-1/2), one down exp(-1/8);
    # with rho 0.5 the diagonal neighbour has q = (1 - 2*0.5*0.5 + 0.25) / 0.75 = 1
    field = one((1.5, 1.5), (1.0, 2.0), color=(1.0, 0.5, 0.0), opacity=0.8, size=(3, 3))
    image = reference.render(field, View.at_scale((3, 3), 1))
    assert image[1, 1].tolist() == pytest.approx([0.8, 0.4, 0.0])
    assert float(image[1, 2, 0]) == pytest.approx(0.8 * math.exp(-0.5))
    assert float(image[2, 1, 0]) == pytest.approx(0.8 * math.exp(-0.125))
    tilted = one((1.5, 1.5), (1.0, 2.0), rho=0.5, size=(3, 3))
    image = reference.render(tilted, View.at_scale((3, 3), 1))
    assert float(image[2, 2, 0]) == pytest.approx(math.exp(-0.5))


@pytest.mark.parametrize("quality", TOLERANCES)
@pytest.mark.parametrize("scale", [0.5, 1, 2.5, 4, 12, 30])
def test_cpu_agrees_with_the_oracle_at_every_scale(scale, quality):
    field = random_field(600, (9, 13))
    view = View.at_scale(field.size, scale)
    oracle = reference.render(field, view)
    assert largest_difference(render(field, view, "cpu", quality), oracle) < TOLERANCES[quality]


@pytest.mark.parametrize("quality", TOLERANCES)
@pytest.mark.parametrize("scale", [0.5, 2.5, 12])
def test_cpu_agrees_with_the_oracle_on_predicted_gaussians(golden, scale, quality):
    with safe_open(golden / "edsr_paper.safetensors", "pt") as file:
        field = activate(file.get_tensor("io.raw")[0], (12, 16))
    view = View.at_scale(field.size, scale)
    oracle = reference.render(field, view)  # up to 6: untrained, so far from a picture
    assert largest_difference(render(field, view, "cpu", quality), oracle) < TOLERANCES[quality]


@pytest.mark.parametrize(
    "view",
    [
        View((-3.3, -2.1), (3.0, 3.0), (41, 57)),
        View((5.7, 4.2), (7.9, 2.3), (33, 47)),
        View((100.0, 100.0), (4.0, 4.0), (8, 8)),
        View((4.1234, 3.777), (900.0, 900.0), (20, 30)),
        View((0.0, 0.0), (1.0, 1.0), (0, 7)),
    ],
    ids=["sticks out", "anisotropic", "outside", "deep", "empty"],
)
def test_cpu_agrees_with_the_oracle_in_any_region(view):
    field = random_field(500, (9, 13))
    difference = largest_difference(render(field, view, "cpu"), reference.render(field, view))
    assert difference < 1e-4


@pytest.mark.parametrize("field", EXTREMES.values(), ids=EXTREMES.keys())
@pytest.mark.parametrize("scale", [1, 4, 31])
def test_cpu_agrees_with_the_oracle_on_extremes(field, scale):
    view = View.at_scale((1, 1), scale)
    image = render(field, view, "cpu")
    assert bool(torch.isfinite(image).all())
    assert largest_difference(image, reference.render(field, view)) < 1e-4


def relative_gradient_errors(field: Gaussians, view: View) -> dict[str, float]:
    """Largest error of each CPU gradient against float64 autograd, relative to its largest."""
    upstream = torch.randn(*view.size, 3, generator=torch.Generator().manual_seed(1))
    exact = field.map(lambda tensor: tensor.double().requires_grad_(True))
    (reference.render(exact, view) * upstream).sum().backward()
    ours = field.map(lambda tensor: tensor.clone().requires_grad_(True))
    (render(ours, view, backend="cpu") * upstream).sum().backward()
    errors = {}
    for name, tensor in exact.tensors().items():
        gradient = getattr(ours, name).grad
        errors[name] = float((gradient - tensor.grad).abs().max() / tensor.grad.abs().max())
    return errors


@pytest.mark.parametrize(
    "view",
    [
        View.at_scale((9, 13), 1),
        View.at_scale((9, 13), 4),
        View((-1.3, 2.2), (3.3, 2.1), (31, 47)),
    ],
    ids=["x1", "x4", "region"],
)
def test_cpu_gradients_equal_autograd_of_the_oracle(view):
    for name, error in relative_gradient_errors(random_field(300, (9, 13)), view).items():
        assert error < 1e-3, name


def test_gradients_equal_those_of_the_released_code(golden):
    # The released code renders 39x52 at 3.3 of 12x16: its spread is 3.3 / 3.25 of ours.
    with safe_open(golden / "raster.safetensors", "pt") as file:
        weights = file.get_tensor("synthetic.case4.weights").permute(1, 2, 0)
        expected = file.get_tensor("synthetic.case4.grad_raw")
        raw = file.get_tensor("synthetic.raw").double().requires_grad_(True)
    size, view = (10, 14), View.to_size((10, 14), (33, 46))
    field = activate(raw, size)
    ratio = torch.tensor([3.3 / s for s in view.scale], dtype=torch.float64)
    stretched = Gaussians(**field.tensors() | {"std": field.std * ratio}, size=size)
    (reference.render(stretched, view) * weights).sum().backward()
    torch.testing.assert_close(raw.grad, expected, atol=1e-9, rtol=1e-7)


def test_the_reference_reproduces_the_papers_rasterization_ratio(golden):
    with safe_open(golden / "raster.safetensors", "pt") as file:
        cases = [
            case
            for case in json.loads(file.metadata()["cases"])
            if case["source"] == "synthetic" and case["scale"] in (2.0, 4.0) and case["dmax"] < 1
        ]
        raw = file.get_tensor("synthetic.raw").double()
        assert len(cases) == 2
        for case in cases:
            view = View.at_scale((case["lr_h"], case["lr_w"]), case["scale"])
            box = [case["dmax"] * (side - 1) / 2 for side in (case["sr_w"], case["sr_h"])]
            image = reference.render(activate(raw, (case["lr_h"], case["lr_w"])), view, tuple(box))
            expected = file.get_tensor(case["key"]).permute(1, 2, 0)
            torch.testing.assert_close(image, expected, atol=1e-4, rtol=0)


def test_cpu_gradients_are_bit_equal_from_run_to_run():
    def gradients():
        field = random_field(6000, (24, 24)).map(lambda t: t.clone().requires_grad_(True))
        render(field, View.at_scale((24, 24), 3), "cpu", "gradient").square().sum().backward()
        return [tensor.grad for tensor in field.tensors().values()]

    for first, second in zip(gradients(), gradients(), strict=True):
        assert torch.equal(first, second)


def test_a_faint_gaussian_still_receives_its_gradient():
    field = one((0.5, 0.5), (0.5, 0.5), opacity=1e-7).map(lambda t: t.requires_grad_(True))
    render(field, View.at_scale((1, 1), 9)).sum().backward()
    assert float(field.opacity.grad) > 1


@settings(max_examples=40, deadline=None)
@given(
    opacity=st.floats(1e-4, 1),
    std=st.floats(1e-3, 3),
    rho=st.floats(-0.99, 0.99),
    quality=st.sampled_from(sorted(TOLERANCES)),
)
def test_what_a_cut_drops_stays_below_the_tolerance(opacity, std, rho, quality):
    field = one((4, 4), (std, std), rho, opacity=opacity, size=(8, 8))
    kept = float(footprint.cut(field, quality)[0])
    dropped = opacity if kept < 0 else opacity * math.exp(-kept / 2)
    assert dropped <= footprint.TOLERANCE[quality] * 1.001


def test_bounds_hold_everything_that_is_drawn():
    field = random_field(50, (8, 8), seed=3)
    x0, y0, x1, y1 = footprint.bounds(field, "export")
    around = View((x0 - 5, y0 - 5), (4.0, 4.0), (int(y1 - y0 + 10) * 4, int(x1 - x0 + 10) * 4))
    image = reference.render(field, around).amax(dim=2)
    rows = torch.arange(image.shape[0]) / 4 + around.origin[1]
    columns = torch.arange(image.shape[1]) / 4 + around.origin[0]
    outside = (
        (rows < y0 - 0.25)[:, None]
        | (rows > y1)[:, None]
        | (columns < x0 - 0.25)[None, :]
        | (columns > x1)[None, :]
    )
    assert float(image[outside].max()) < 1e-4


def test_unknown_backends_and_qualities_are_refused():
    field, view = random_field(1, (1, 1)), View.at_scale((1, 1), 1)
    with pytest.raises(RequestError, match="Unknown backend 'metal'"):
        render(field, view, backend="metal")
    with pytest.raises(RequestError, match="Unknown quality 'best'"):
        render(field, view, quality="best")


@pytest.mark.parametrize("quality", TOLERANCES)
def test_many_tiny_gaussians_at_one_place_stay_within_the_tolerance(quality):
    field = random_field(1000, (1, 1), seed=5).map(lambda tensor: tensor.clone())
    field.mean[:], field.std[:], field.rho[:] = 0.5, 0.1, 0.0
    field.opacity[:], field.color[:] = 1e-3, 1.0
    view = View.at_scale((1, 1), 40)
    difference = largest_difference(
        render(field, view, "cpu", quality), reference.render(field, view)
    )
    assert difference < TOLERANCES[quality]


def test_an_enormous_gaussian_is_drawn():
    field = one((0.5, 0.5), (1e18, 1e18), opacity=0.5)
    assert render(field, View.at_scale((1, 1), 3), "cpu").mean() == pytest.approx(0.5)


@pytest.mark.parametrize("quality", ["export", "gradient"])
def test_the_cpu_draws_nothing_of_a_gaussian_that_is_none_and_gives_it_no_gradient(quality):
    nan, inf = float("nan"), float("inf")
    for broken in (
        one((nan, 0.5), (1, 1)),
        one((0.5, nan), (1, 1)),
        one((0.5, 0.5), (nan, 1)),
        one((0.5, 0.5), (1, nan)),
        one((0.5, 0.5), (1, inf)),
        one((0.5, 0.5), (1, 0)),
        one((0.5, 0.5), (0, 1)),
        one((0.5, 0.5), (1, 1), nan),
        one((0.5, 0.5), (1, 1), 1.0),
        one((0.5, 0.5), (1, 1), -1.5),
    ):
        field = broken.map(lambda tensor: tensor.requires_grad_(True))
        image = render(field, View.at_scale((1, 1), 5), "cpu", quality)
        assert float(image.detach().abs().max()) == 0.0
        image.sum().backward()
        assert float(field.mean.grad.abs().max()) == 0.0


def test_auto_draws_by_the_cpu_where_the_kernels_for_a_card_cannot_run(monkeypatch):
    from gsasr.rasterize import backends, cuda, default_backend, opengl

    def too_old():
        raise BackendError("This card has compute capability 5.0.")

    monkeypatch.setattr(opengl, "hardware", lambda: False)
    monkeypatch.setattr(cuda, "require", lambda: None)
    assert default_backend() == "cuda"
    monkeypatch.setattr(cuda, "require", too_old)
    assert default_backend() == "cpu"
    assert backends._chosen(random_field(1, (1, 1)), "auto", None) == ("cpu", "export")
