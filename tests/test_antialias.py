"""Antialiased rendering: pixels that integrate, against integration done otherwise."""

import numpy as np
import pytest
import torch
from fields import EXTREMES, one, random_field
from PIL import Image

from gsasr import cli, image, picture
from gsasr.gaussians import Gaussians
from gsasr.model import load_model, save_model
from gsasr.prediction import predict
from gsasr.rasterize import antialias, reference, render
from gsasr.rasterize.antialias import FOOTPRINT, integrated
from gsasr.view import View

SUBSAMPLES = 8  # along a side of a pixel, for its mean


def exact(field: Gaussians, view: View) -> torch.Tensor:
    """The antialiased picture by the oracle, in float64 throughout."""
    return reference.render(integrated(field.map(torch.Tensor.double), view), view)


def pixel_means(field: Gaussians, view: View) -> torch.Tensor:
    """(h, w, 3) float64: the mean of the picture over each square pixel."""
    s = SUBSAMPLES
    (height, width), (x, y) = view.size, view.scale
    fine = View(view.origin, (x * s, y * s), (height * s, width * s))
    samples = render(field, fine, "cpu").double()
    return samples.reshape(height, s, width, s, 3).mean(dim=(1, 3))


def rms(a: torch.Tensor, b: torch.Tensor) -> float:
    return float((a - b).square().mean().sqrt())


def zone_plate(side: int) -> Gaussians:
    """Rings ever finer, up to the finest that source pixels can hold, of blobs twice as dense."""
    y, x = torch.meshgrid(torch.arange(0, side, 0.5), torch.arange(0, side, 0.5), indexing="ij")
    mean = torch.stack([x.flatten(), y.flatten()], 1) + 0.25
    gray = 0.5 + 0.5 * torch.cos(torch.pi * mean.square().sum(1) / (2 * side))
    count = len(mean)
    return Gaussians(
        mean=mean,
        std=torch.full((count, 2), 0.3),
        rho=torch.zeros(count),
        color=gray[:, None].repeat(1, 3),
        opacity=torch.full((count,), 0.25 / (2 * torch.pi * 0.3**2)),
        size=(side, side),
    )


@pytest.fixture(scope="module")
def photograph(images) -> Gaussians:
    """What the shipped model makes of a part of a shipped picture."""
    color = image.read(images / "cat.png").color[40:120, 90:170]
    return predict(load_model("lite"), color)


@pytest.mark.parametrize("scale", [(0.7, 0.4), (1.0, 1.0), (2.5, 3.5)])
def test_it_equals_the_picture_convolved_with_the_pixels_footprint(scale):
    field = random_field(40, (8, 8), seed=2)
    field = Gaussians(**field.tensors() | {"std": field.std + 0.5}, size=field.size)
    field = field.map(torch.Tensor.double)
    view = View((0.3, -0.2), scale, (5, 6))
    steps, reach = 21, 2  # samples per pixel, and pixels to each side of one, of the kernel
    corner = tuple(o - reach / s for o, s in zip(view.origin, scale, strict=True))
    size = tuple((side + 2 * reach) * steps for side in view.size)
    fine = reference.render(field, View(corner, tuple(s * steps for s in scale), size))
    offset = (torch.arange((2 * reach + 1) * steps, dtype=torch.float64) + 0.5) / steps
    kernel = torch.exp(-0.5 * (offset - reach - 0.5) ** 2 / FOOTPRINT)
    kernel = kernel / kernel.sum()
    rows = fine.unfold(0, len(kernel), steps) @ kernel  # [h, w * steps, 3]
    expected = rows.unfold(1, len(kernel), steps) @ kernel
    assert float((exact(field, view) - expected).abs().max()) < 1e-8


@pytest.mark.parametrize("name", [name for name in EXTREMES if name != "none"])
@pytest.mark.parametrize("scale", [0.05, 1, 30])
def test_no_gaussian_loses_or_gains_anything_in_total(name, scale):
    field = EXTREMES[name].map(torch.Tensor.double)
    wide = integrated(field, View.at_scale((100, 100), scale))

    def total(g: Gaussians) -> float:
        return float(g.opacity * g.std.prod() * ((1 - g.rho) * (1 + g.rho)).sqrt())

    assert total(wide) == pytest.approx(total(field), rel=1e-9)
    assert bool((wide.std >= FOOTPRINT**0.5 / scale).all())


def test_a_gaussian_much_larger_than_a_pixel_stays_as_it_is():
    field = random_field(50, (9, 9))
    wide = integrated(field, View.at_scale((9, 9), 1e6))
    for name, tensor in field.tensors().items():
        torch.testing.assert_close(getattr(wide, name), tensor, atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("scale", [0.1, 0.37, 0.9])
def test_a_plane_keeps_its_value(scale):
    field = zone_plate(60)
    field.color[:] = 0.6
    inner = View((20.0, 20.0), (scale, scale), (int(20 * scale), int(20 * scale)))
    drawn = render(field, inner, "cpu", antialias=True)
    assert drawn.numel() > 0
    assert float((drawn - 0.6).abs().max()) < 1e-3


@pytest.mark.parametrize("scale", [0.1, 0.25, 0.5, 0.9])
@pytest.mark.parametrize("kind", ["photograph", "zone plate"])
def test_minified_pictures_are_five_times_closer_to_the_pixels_means(kind, scale, request):
    field = zone_plate(100) if kind == "zone plate" else request.getfixturevalue(kind)
    view = View.at_scale(field.size, scale)
    means = pixel_means(field, view)
    sampled = rms(render(field, view, "cpu").double(), means)
    smooth = rms(render(field, view, "cpu", antialias=True).double(), means)
    print(f"{kind} x{scale}: rms {sampled:.4f} sampled, {smooth:.4f} antialiased")
    assert smooth < sampled / 5


def test_no_other_footprint_comes_much_closer_to_the_pixels_means(photograph, monkeypatch):
    fields, scales = (photograph, zone_plate(100)), (0.1, 0.25, 0.5, 0.75)
    error = {}
    for variance in (1 / 16, 1 / 12, FOOTPRINT, 1 / 8, 1 / 6, 1 / 4):
        monkeypatch.setattr(antialias, "FOOTPRINT", variance)
        ratios = []
        for field in fields:
            for scale in scales:
                view = View.at_scale(field.size, scale)
                means = pixel_means(field, view)
                drawn = render(field, view, "cpu", antialias=True).double()
                ratios.append(rms(drawn, means) / rms(render(field, view, "cpu").double(), means))
        error[variance] = sum(ratios) / len(ratios)
    print({f"{variance:.4f}": round(value, 4) for variance, value in error.items()})
    assert min(error, key=error.get) == FOOTPRINT


@pytest.mark.parametrize("backend", ["reference", "cpu", "gl"])
@pytest.mark.parametrize("scale", [0.05, 0.3, 0.9, 3])
def test_every_backend_draws_it(backend, scale, request):
    if backend == "gl":
        request.getfixturevalue("gl_context")
    field = random_field(1500, (50, 60))
    view = View((-3.0, -2.0), (scale, scale), (min(30, int(54 * scale)), min(40, int(66 * scale))))
    drawn = render(field, view, backend, antialias=True)
    assert float((drawn - exact(field, view)).abs().max()) < 1e-4


@pytest.mark.parametrize("name", EXTREMES)
@pytest.mark.parametrize("scale", [0.05, 1, 30])
def test_extremes_are_drawn_as_the_oracle_does(name, scale):
    view = View((0.5 - 4 / scale, 0.5 - 4.3 / scale), (scale, scale), (9, 8))
    drawn = render(EXTREMES[name], view, "cpu", antialias=True)
    assert float((drawn - exact(EXTREMES[name], view)).abs().max()) < 1e-4


@pytest.mark.parametrize("rho", [0.9, 0.999, -0.999])
@pytest.mark.parametrize("scale", [1, 30, 1000, 10000])
def test_tilted_needles_stay_exact_at_every_zoom(rho, scale):
    field = one((3.3, 2.7), (0.5, 0.4), rho, size=(6, 6))
    view = View((3.3 - 20.3 / scale, 2.7 - 20.1 / scale), (scale, scale), (41, 41))
    drawn = render(field, view, "cpu", antialias=True)
    assert float((drawn - exact(field, view)).abs().max()) < 1e-4


@pytest.mark.usefixtures("gl_context")
def test_opengl_adds_up_more_gaussians_to_a_pixel_than_a_loop_may_have_rounds():
    field = random_field(150_000, (40, 40))
    view = View.at_scale(field.size, 0.05)
    drawn = render(field, view, "gl", antialias=True)
    assert float((drawn - exact(field, view)).abs().max()) < 1e-4


def test_gradients_equal_autograd_of_the_oracle():
    field, view = random_field(60, (9, 13)), View.at_scale((9, 13), 0.7)
    upstream = torch.randn(*view.size, 3, generator=torch.Generator().manual_seed(1))
    oracle = field.map(lambda tensor: tensor.double().requires_grad_(True))
    (reference.render(integrated(oracle, view), view) * upstream).sum().backward()
    ours = field.map(lambda tensor: tensor.clone().requires_grad_(True))
    (render(ours, view, "cpu", antialias=True) * upstream).sum().backward()
    for name, tensor in oracle.tensors().items():
        error = (getattr(ours, name).grad - tensor.grad).abs().max() / tensor.grad.abs().max()
        assert float(error) < 1e-3, name


def test_sampling_stays_the_default():
    field = random_field(300, (20, 30))
    view = View.at_scale(field.size, 0.4)
    sampled = render(field, view, "cpu", antialias=False)
    assert torch.equal(render(field, view, "cpu"), sampled)
    drawn = picture.render(field, view=view, backend="cpu")
    np.testing.assert_allclose(drawn, sampled.numpy(), rtol=0, atol=1e-4)
    assert float((render(field, view, "cpu", antialias=True) - sampled).abs().max()) > 0.05


def test_pictures_made_tile_by_tile_are_those_of_the_whole_field(tiny_model):
    color = np.random.default_rng(0).random((50, 300, 3), np.float32)
    view = View.at_scale((50, 300), 0.12)
    whole = predict(tiny_model, color, 1.0)
    expected = exact(whole, view).numpy()
    drawn = picture.render(whole, view=view, backend="cpu", antialias=True)
    assert np.abs(drawn - expected).max() < 1e-4
    one_by_one = picture.upscale(
        tiny_model, color, view, 1.0, backend="cpu", tile=256, antialias=True
    )
    assert np.abs(one_by_one - expected).max() < 1e-4


def test_commands_take_it(tiny_model, images, tmp_path):
    model, small, out = (tmp_path / name for name in ("m.safetensors", "in.png", "out.png"))
    save_model(tiny_model, model)
    Image.open(images / "cat.png").convert("RGB").crop((90, 30, 150, 80)).save(small)
    field = random_field(900, (30, 40))
    field.save(tmp_path / "f.safetensors")

    def made(*arguments) -> np.ndarray:
        options = [*map(str, arguments), "-o", str(out), "--scale", "0.4", "--backend", "cpu"]
        assert cli.main(options) == 0
        return np.asarray(Image.open(out))

    def written(color: np.ndarray) -> np.ndarray:
        return np.rint(color.clip(0, 1) * 255).astype(np.uint8)

    color, view = image.read(small).color, View.at_scale((50, 60), 0.4)
    for flags in ([], ["--antialias"]):
        smooth = bool(flags)
        drawn = picture.render(field, scale=0.4, backend="cpu", antialias=smooth)
        assert np.array_equal(made("render", tmp_path / "f.safetensors", *flags), written(drawn))
        upscaled = picture.upscale(tiny_model, color, view, backend="cpu", antialias=smooth)
        assert np.array_equal(made("upscale", small, "--model", model, *flags), written(upscaled))
