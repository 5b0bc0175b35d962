"""Every picture subtracted from the oracle's: all zooms, borders of tiles included."""

import numpy as np
import pytest
import torch
from fields import random_field

from gsasr.gaussians import Gaussians
from gsasr.rasterize import gl, reference, render
from gsasr.rasterize.antialias import integrated
from gsasr.rasterize.tiles import SIDE, split_tiles
from gsasr.view import View

ZOOMS = (0.05, 0.1, 0.5, 1, 2, 3.3, 8, 30, 1000, 10000)
TOLERANCE = {"screen": 0.5 / 255, "export": 1e-4}
CORNER = (float(SIDE), float(SIDE))  # of four tiles
SIZE = (23, 32)  # of the views, pixels


@pytest.fixture(scope="module")
def field() -> Gaussians:
    """A picture of several tiles: large Gaussians all over, small ones round a corner."""
    large = random_field(3000, (300, 310), largest_std=4.0)
    small = random_field(1500, (16, 16), seed=1)
    field = Gaussians.concatenate([large, small])
    field.mean[len(large) :] += torch.tensor(CORNER) - 8
    field.opacity[:] *= 0.25  # of a sum within what a screen shows
    assert len(split_tiles(field)) >= 4
    return field


def view_at(zoom: float) -> View:
    """Round the corner, nearly centred."""
    origin = tuple(c - (0.5 * n + 0.3) / zoom for c, n in zip(CORNER, SIZE[::-1], strict=True))
    return View(origin, (zoom, zoom), SIZE)


def oracle(field: Gaussians, view: View, antialias: bool) -> np.ndarray:
    field = field.map(torch.Tensor.double)
    return reference.render(integrated(field, view) if antialias else field, view).numpy()


@pytest.mark.parametrize("antialias", [False, True], ids=["sampled", "antialiased"])
@pytest.mark.parametrize("quality", TOLERANCE)
@pytest.mark.parametrize("backend", ["cpu", "gl"])
@pytest.mark.parametrize("zoom", ZOOMS)
def test_the_sum_of_tiles_is_exact(field, zoom, backend, quality, antialias, request):
    if backend == "gl":
        request.getfixturevalue("gl_context")
    view = view_at(zoom)
    expected = oracle(field, view, antialias)
    assert 0.1 < expected.max() < 2  # there is something to see
    tiles = split_tiles(field)
    drawn = sum(render(tile, view, backend, quality, antialias).numpy() for tile in tiles)
    assert np.abs(drawn - expected).max() <= TOLERANCE[quality]
    at_once = render(field, view, backend, quality, antialias).numpy()
    assert np.abs(at_once - expected).max() <= TOLERANCE[quality]


@pytest.mark.parametrize("backend", ["cpu", "gl"])
def test_a_sum_of_hundreds_of_thousands_at_each_pixel_is_exact(backend, request):
    if backend == "gl":
        request.getfixturevalue("gl_context")
    field = random_field(1 << 19, (180, 180))  # 16 to a source pixel, as the paper's networks have
    view = View.at_scale(field.size, 0.02)
    drawn = render(field, view, backend, "export", antialias=True).numpy()
    assert np.abs(drawn - oracle(field, view, antialias=True)).max() <= TOLERANCE["export"]


@pytest.mark.parametrize("antialias", [False, True], ids=["sampled", "antialiased"])
@pytest.mark.parametrize("zoom", ZOOMS)
def test_what_the_window_draws_in_16_bits_is_exact_before_and_after_rounding_to_8(
    field, zoom, antialias, gl_context
):
    view = view_at(zoom)
    expected = oracle(field, view, antialias).clip(0, 1)
    shown = integrated(field, view) if antialias else field
    rasterizer = gl.GlRasterizer(gl_context)
    target = gl_context.texture(SIZE[::-1], 4, dtype="f2")
    tiles = [rasterizer.upload(tile, "screen") for tile in split_tiles(shown)]
    try:
        rasterizer.draw(tiles, view, target)
        drawn = np.frombuffer(target.read(), np.float16).reshape(*SIZE, 4)[..., :3]
    finally:
        for held in (*tiles, rasterizer, target):
            held.release()
    drawn = drawn.astype(np.float64).clip(0, 1)
    assert np.abs(drawn - expected).max() <= 0.5 / 255
    rounded = np.rint(drawn * 255) / 255
    assert np.abs(rounded - expected).max() <= (0.5 + 0.5) / 255
