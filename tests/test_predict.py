"""Pictures of any size to Gaussians, and pictures drawn tile by tile."""

import numpy as np
import pytest
import torch
from networks import TINY

from gsasr import image
from gsasr.errors import Cancelled, RequestError
from gsasr.model import GSASR, activate, load_model
from gsasr.picture import conditioning_scale, render, resample_alpha, upscale
from gsasr.prediction import plan, predict, predict_tile, predict_tiles
from gsasr.processor import PRECISIONS
from gsasr.rasterize import reference
from gsasr.view import View


def picture(height: int, width: int) -> np.ndarray:
    """A smooth coloured wave with some noise, (H, W, 3) float32 in [0, 1]."""
    y, x = np.mgrid[:height, :width].astype(np.float32)
    waves = [np.sin(x / 5 + y / 9), np.cos(x / 7), np.sin(y / 4 - x / 11)]
    noise = np.random.default_rng(0).random((height, width, 3), np.float32)
    return np.clip(0.5 + 0.3 * np.stack(waves, axis=2) + 0.1 * noise, 0, 1).astype(np.float32)


def test_a_picture_is_predicted_as_its_reflected_continuation(tiny_model):
    photo = picture(8, 12)
    field = predict(tiny_model, photo, 3.0)
    around = np.pad(photo, ((16, 16), (16, 16), (0, 0)), mode="reflect")
    with torch.inference_mode():
        raw = tiny_model(torch.from_numpy(around).permute(2, 0, 1)[None], 3.0)[0]
    # 2x2 Gaussians per pixel: rows and columns of the picture, and four pixels around it.
    rows = torch.arange(2 * 12, 2 * (16 + 8 + 4))
    columns = torch.arange(2 * 12, 2 * (16 + 12 + 4))
    expected = activate(raw, around.shape[:2])[(rows[:, None] * 2 * 44 + columns).flatten()]
    assert (field.size, field.model, field.scale) == ((8, 12), "tiny", 3.0)
    torch.testing.assert_close(field.mean, expected.mean - 16, atol=2e-5, rtol=0)
    for name in ("std", "rho", "color", "opacity"):
        torch.testing.assert_close(getattr(field, name), getattr(expected, name))


def test_a_flat_picture_stays_flat_up_to_its_corners_with_the_shipped_model():
    flat = np.full((40, 40, 3), 0.5, np.float32)
    drawn = render(predict(load_model("lite"), flat, 4.0), scale=4, backend="cpu")
    edges = np.concatenate([drawn[0], drawn[-1], drawn[:, 0], drawn[:, -1]])
    assert np.abs(edges.mean() - drawn[40:120, 40:120].mean()) < 2 / 255
    assert np.abs(drawn - 0.5).max() < 0.06


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (9, 1), (2, 3), (5, 7), (13, 30)])
def test_any_size_is_padded_by_reflection_and_covered_with_gaussians(tiny_model, size):
    field = predict(tiny_model, picture(*size), 2.0).validate()
    assert field.size == size
    assert len(field) >= 4 * size[0] * size[1]
    covered = render(field, scale=2).max()
    assert np.isfinite(covered) and covered > 0


@pytest.mark.parametrize("family", TINY)
@pytest.mark.parametrize("size", [(1, 1), (1, 9), (13, 30)])
def test_every_family_predicts_every_size(family, size):
    model = GSASR(TINY[family], family).eval()
    field = predict(model, picture(*size), 2.0, tile=12).validate()
    # Every pixel has its Gaussians, and so have the four around the picture and those of padding.
    rows, columns = (-(-side // model.multiple) * model.multiple + 8 for side in size)
    per_pixel = model.config.decoder.gaussians_per_pixel
    assert per_pixel * size[0] * size[1] <= len(field) <= per_pixel * rows * columns


def test_tiles_cover_the_picture_once(tiny_model):
    covered = np.zeros((44, 60), int)
    for tile in plan(tiny_model, (41, 58), tile=16):
        covered[tile.y0 : tile.y1, tile.x0 : tile.x1] += 1
    assert (covered == 1).all()


def test_tiles_nearest_to_the_point_of_interest_come_first(tiny_model):
    tiles = plan(tiny_model, (64, 64), tile=16, near=(60, 5))
    assert (tiles[0].x0, tiles[0].y0) == (48, 0)
    assert (tiles[-1].x0, tiles[-1].y0) == (0, 48)


@pytest.mark.parametrize("tile", [48, 64, 96])
def test_tiled_prediction_shows_no_seams_with_the_shipped_model(images, tile):
    model = load_model("lite")
    photo = image.read(images / "cat.png").color[40:200, 60:220]
    view = View.at_scale(photo.shape[:2], 2)
    whole = render(predict(model, photo, 2.0, tile=1024), view=view, backend="cpu")
    tiled = render(predict(model, photo, 2.0, tile=tile), view=view, backend="cpu")
    assert np.quantile(np.abs(whole - tiled), 0.999) < 0.2 / 255
    # A seam would be a jump across a tile border that the whole prediction does not have.
    jumps = np.abs(np.diff(tiled - whole, axis=1)).mean(axis=(0, 2))
    borders = np.arange(2 * tile, 2 * photo.shape[1] - 1, 2 * tile) - 1
    assert jumps[borders].mean() < 0.05 / 255


def test_progress_reaches_the_end_and_cancel_stops_between_tiles(tiny_model):
    photo, shares = picture(40, 40), []
    predict(tiny_model, photo, 2.0, tile=16, progress=shares.append)
    assert shares == sorted(shares) and shares[-1] == 1.0 and len(shares) == 9
    tiles = predict_tiles(tiny_model, photo, tile=16, cancelled=lambda: len(shares) > 10)
    next(tiles)
    shares += [0, 0]
    with pytest.raises(Cancelled):
        next(tiles)


def starved(monkeypatch, largest: int, error: Exception) -> list[int]:
    """Let predict_tile fail for tiles above `largest` pixels; returns the sides it is asked for."""
    sides, whole = [], predict_tile

    def limited(model, image, tile, *arguments):
        sides.append(max(tile.x1 - tile.x0, tile.y1 - tile.y0))
        if sides[-1] > largest:
            raise error
        return whole(model, image, tile, *arguments)

    monkeypatch.setattr("gsasr.prediction.predict_tile", limited)
    return sides


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        torch.OutOfMemoryError("CUDA out of memory"),
        RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 9 bytes"),
    ],
    ids=["python", "card", "cpu"],
)
def test_tiles_are_halved_where_memory_runs_out(tiny_model, monkeypatch, error):
    photo, shares = picture(70, 90), []
    expected = render(predict(tiny_model, photo, 2.0, tile=16), scale=2, backend="cpu")
    sides = starved(monkeypatch, 16, error)
    with pytest.warns(UserWarning, match="Out of memory: going on with tiles of") as told:
        field = predict(tiny_model, photo, 2.0, tile=64, progress=shares.append)
    assert [str(w.message).split()[-2] for w in told] == ["32", "16"]
    assert sides.count(64) == 1 and sides.count(32) == 1
    assert shares == sorted(shares) and shares[-1] == 1.0
    assert np.abs(render(field, scale=2, backend="cpu") - expected).max() < 1e-4


@pytest.mark.filterwarnings("ignore:Out of memory")
def test_too_little_memory_for_any_tile_is_one_sentence(tiny_model, monkeypatch):
    starved(monkeypatch, 0, MemoryError())
    with pytest.raises(RequestError, match="close other programs"):
        predict(tiny_model, picture(40, 40), 2.0)


def test_other_failures_are_not_taken_for_a_lack_of_memory(tiny_model, monkeypatch):
    starved(monkeypatch, 0, RuntimeError("shapes do not match"))
    with pytest.raises(RuntimeError, match="shapes do not match"):
        predict(tiny_model, picture(40, 40), 2.0)


def test_bfloat16_costs_less_than_an_8_bit_level_with_the_shipped_model(images):
    photo = image.read(images / "cat.png").color[40:136, 60:156]
    exact, rough = (
        render(predict(load_model("lite"), photo, 2.0, precision=p), scale=2, backend="cpu")
        for p in PRECISIONS
    )
    assert 0 < np.abs(exact - rough).mean() < 1 / 255


def test_what_cannot_be_predicted_is_refused(tiny_model):
    for wrong, scale in (
        (np.zeros((4, 4)), 2.0),
        (np.zeros((0, 4, 3)), 2.0),
        (picture(4, 4), 0.0),
        (picture(4, 4), float("nan")),
        (picture(4, 4), 1e-42),
        (np.full((4, 4, 3), np.nan), 2.0),
        (np.full((4, 4, 3), 128, np.uint8), 2.0),
    ):
        with pytest.raises(RequestError):
            predict(tiny_model, wrong, scale)
    with pytest.raises(RequestError, match="Unknown precision 'half'; use float32 or bfloat16"):
        predict(tiny_model, picture(4, 4), precision="half")


def test_drawing_tile_by_tile_equals_drawing_the_whole_field(tiny_model):
    photo = picture(40, 52)
    for view in (View.at_scale((40, 52), 2.7), View((-3.0, 20.5), (3.0, 3.0), (90, 60))):
        streamed = upscale(tiny_model, photo, view, condition=2.0, backend="cpu")
        oracle = reference.render(predict(tiny_model, photo, 2.0), view).numpy()
        assert np.abs(streamed - oracle).max() < 2e-4


def test_the_network_is_told_a_scale_that_it_knows():
    assert [conditioning_scale(s) for s in (0.3, 2.5, 30)] == [1.0, 2.5, 4.0]


def test_exactly_one_size_must_be_given(tiny_model):
    field = predict(tiny_model, picture(4, 4), 2.0)
    assert render(field, scale=1.5).shape == (6, 6, 3)
    assert render(field, size=(3, 5)).shape == (3, 5, 3)
    for choice in ({}, {"scale": 2, "size": (3, 3)}):
        with pytest.raises(RequestError, match="exactly one"):
            render(field, **choice)


def test_alpha_keeps_its_place_when_resampled():
    alpha = np.zeros((6, 8), np.float32)
    alpha[2:4, 3:6] = 1
    whole = resample_alpha(alpha, View.at_scale((6, 8), 4))
    assert whole.shape == (24, 32)
    assert whole[10:14, 14:22].min() > 0.9 and whole[:4].max() < 0.05
    ys, xs = np.mgrid[:24, :32]
    center = (whole * xs).sum() / whole.sum(), (whole * ys).sum() / whole.sum()
    assert center == pytest.approx((4.5 * 4 - 0.5, 3 * 4 - 0.5), abs=0.01)
    for scale in (2.3, 3.7, 4.6):  # 230 / 2.3 is a little more than 100
        opaque = resample_alpha(np.ones((100, 100), np.float32), View.at_scale((100, 100), scale))
        assert opaque.min() > 0.999
    beyond = resample_alpha(np.ones((6, 8), np.float32), View((-8.0, -6.0), (1.0, 1.0), (18, 24)))
    assert beyond[6:12, 8:16].mean() > 0.95 and beyond[:4].max() < 0.05


def test_a_network_can_be_trained_after_it_has_predicted(golden):
    model = load_model(golden / "edsr_paper.safetensors")
    predict(model, np.zeros((4, 4, 3), np.float32), 2.0)
    model(torch.rand(1, 3, 8, 8), 2.0).sum().backward()
    assert any(parameter.grad is not None for parameter in model.parameters())
