"""The metrics against known figures, and the benchmark's protocol."""

import numpy as np
import pytest
from PIL import Image

from gsasr.errors import DataError
from gsasr.evaluation.benchmark import benchmark, table
from gsasr.evaluation.metrics import luma, psnr_y, ssim_y


def test_luma_is_that_of_bt601():
    corners = np.array([[[0, 0, 0], [1, 1, 1], [1, 0, 0]]], np.float64)
    assert luma(corners)[0].tolist() == pytest.approx([16, 235, 81.481], abs=1e-3)


def test_psnr_has_the_value_of_its_definition():
    truth = np.full((20, 20, 3), 100 / 255)
    # every channel off by 10 levels: Y off by 10 * 219 / 255
    expected = 20 * np.log10(255 / (10 * 219 / 255))
    assert psnr_y(truth + 10 / 255, truth, 2) == pytest.approx(expected)
    assert psnr_y(truth, truth, 2) == float("inf")


def test_the_border_does_not_count_and_pictures_are_rounded_and_clipped():
    truth = np.random.default_rng(0).random((24, 24, 3))
    framed = truth.copy()
    framed[:4] = framed[-4:] = 0
    framed[:, :4] = framed[:, -4:] = 0
    assert psnr_y(framed, truth, 4) == float("inf")
    white = np.ones((24, 24, 3))
    assert psnr_y(white * 3, white, 2) == float("inf")
    assert ssim_y(white * 3, white, 2) == pytest.approx(1)


def test_ssim_agrees_with_a_direct_computation_at_one_window():
    random = np.random.default_rng(1)
    a, b = random.random((11, 11, 3)), random.random((11, 11, 3))
    taps = np.exp(-((np.arange(11) - 5) ** 2) / 4.5)
    weights = np.outer(taps, taps) / taps.sum() ** 2
    x, y = (luma(np.rint(p * 255) / 255) for p in (a, b))
    mx, my = (weights * x).sum(), (weights * y).sum()
    vx, vy = (weights * (x - mx) ** 2).sum(), (weights * (y - my) ** 2).sum()
    cov = (weights * (x - mx) * (y - my)).sum()
    c1, c2 = 2.55**2, 7.65**2
    expected = (2 * mx * my + c1) * (2 * cov + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2))
    assert ssim_y(a, b, 0) == pytest.approx(expected)


@pytest.fixture
def benchmark_folder(tmp_path, images):
    """Two pictures at x2, the second one pixel larger than twice its LR picture."""
    folder = tmp_path / "Two"
    (folder / "HR").mkdir(parents=True)
    (folder / "LR" / "x2").mkdir(parents=True)
    for name, extra in (("cat", 0), ("chart", 1)):
        picture = Image.open(images / f"{name}.png").convert("RGB").crop((0, 0, 64, 48))
        picture.resize((32, 24), Image.Resampling.BICUBIC).save(folder / f"LR/x2/{name}.png")
        picture.crop((0, 0, 64 + extra, 48 + extra)).save(folder / f"HR/{name}.png")
    return folder


def test_the_benchmark_scores_every_picture_and_prints_the_mean(benchmark_folder, tiny_model):
    scores = benchmark(tiny_model, benchmark_folder, (2,))
    assert [(s.name, s.scale) for s in scores] == [("cat.png", 2), ("chart.png", 2)]
    assert all(3 < s.psnr < 60 and -1 < s.ssim <= 1 for s in scores)
    lines = table(scores, per_image=True).splitlines()
    mean = (scores[0].psnr + scores[1].psnr) / 2
    assert lines[0] == "| image | x2 |" and lines[2].startswith("| cat | ")
    assert f"{mean:.2f} / " in lines[-1]


def test_the_shipped_model_beats_bicubic_on_a_photograph(images):
    # A tenth of what the benchmark command measures, as a guard against a broken checkpoint.
    from gsasr.model import load_model
    from gsasr.picture import upscale
    from gsasr.view import View

    photo = Image.open(images / "cat.png").convert("RGB").crop((60, 40, 252, 168))
    truth = np.asarray(photo, np.float32) / 255
    small = photo.resize((96, 64), Image.Resampling.BICUBIC)
    bicubic = np.asarray(small.resize((192, 128), Image.Resampling.BICUBIC), np.float32) / 255
    lr = np.asarray(small, np.float32) / 255
    ours = upscale(load_model("lite"), lr, View.at_scale((64, 96), 2), backend="cpu")
    assert psnr_y(ours, truth, 2) > psnr_y(bicubic, truth, 2) + 0.5


def test_a_folder_of_another_layout_is_refused(tmp_path, tiny_model):
    with pytest.raises(DataError, match="HR/NAME"):
        benchmark(tiny_model, tmp_path)
