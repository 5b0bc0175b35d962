"""Centres and ellipses of Gaussians, held against geometry."""

import math

import numpy as np
import pytest
import torch

from gsasr.errors import RequestError
from gsasr.gaussians import Gaussians
from gsasr.rasterize import gl
from gsasr.view import View
from viewer.overlays import CLOSEST, Overlays

WHITE = (1.0, 1.0, 1.0)


def one(mean=(4.3, 3.6), std=(0.9, 0.5), rho=0.6, color=(0.8, 0.2, 0.1), opacity=1.0):
    return Gaussians(
        torch.tensor([mean], dtype=torch.float32),
        torch.tensor([std]),
        torch.tensor([rho]),
        torch.tensor([color]),
        torch.tensor([opacity]),
        (8, 8),
    )


def grid(spacing, side=32):
    """Gaussians `spacing` source pixels apart."""
    steps = torch.arange(0.5 * spacing, side, spacing)
    y, x = torch.meshgrid(steps, steps, indexing="ij")
    mean = torch.stack([x.flatten(), y.flatten()], dim=1)
    n = len(mean)
    return Gaussians(
        mean,
        torch.full((n, 2), 0.3),
        torch.zeros(n),
        torch.full((n, 3), 0.5),
        torch.ones(n),
        (side, side),
    )


@pytest.fixture(scope="module")
def overlay(gl_context):
    """Draw over mid grey; (h, w, 3) float32 and what `draw` said."""
    overlays, rasterizer = Overlays(gl_context), gl.GlRasterizer(gl_context)

    def draw(gaussians, view, kind, **options):
        texture = gl_context.texture(view.size[::-1], 4, dtype="f4")
        framebuffer = gl_context.framebuffer([texture])
        framebuffer.clear(0.5, 0.5, 0.5, 1.0)
        tiles = [rasterizer.upload(part) for part in gl.split_tiles(gaussians)]
        drawn = overlays.draw(tiles, view, framebuffer, kind, **options)
        image = np.frombuffer(texture.read(), np.float32).reshape(*view.size, 4)
        framebuffer.release()
        texture.release()
        return image[..., :3], drawn

    yield draw
    overlays.release()
    rasterizer.release()


def bright(image):
    """(x, y) of the pixels of the core, in output coordinates."""
    y, x = np.nonzero(image.max(axis=2) > 0.72)
    return x + 0.5, y + 0.5


@pytest.mark.parametrize("scale", [(20.0, 20.0), (31.0, 17.0), (300.0, 300.0)])
def test_a_centre_lies_at_the_mean(overlay, scale):
    gaussian = one()
    view = View((3.1, 2.9), scale, (int(1.5 * scale[1]), int(2.5 * scale[0])))
    image, _ = overlay(gaussian, view, "centers", color=WHITE)
    x, y = bright(image)
    expected = view.to_output(4.3, 3.6)
    assert len(x) > 4
    assert abs(x.mean() - expected[0]) < 0.5
    assert abs(y.mean() - expected[1]) < 0.5
    assert np.hypot(x - expected[0], y - expected[1]).max() < 4


@pytest.mark.parametrize("sigma", [1.0, 2.0, 3.0])
@pytest.mark.parametrize(
    "gaussian",
    [one(), one(rho=-0.95, std=(0.7, 0.7)), one(rho=0.0, std=(0.3, 1.0))],
    ids=["turned", "thin", "upright"],
)
def test_the_pixels_of_an_ellipse_lie_on_it(overlay, gaussian, sigma):
    view = View((0.2, 0.1), (53.0, 47.0), (380, 430))
    image, _ = overlay(gaussian, view, "ellipses", sigma=sigma, color=WHITE)
    angle = np.linspace(0, 2 * math.pi, 20000)
    rho = float(gaussian.rho)
    u, v = np.cos(angle), np.sin(angle)
    x = 4.3 + sigma * float(gaussian.std[0, 0]) * u
    y = 3.6 + sigma * float(gaussian.std[0, 1]) * (rho * u + math.sqrt(1 - rho**2) * v)
    outline = np.stack(view.to_output(x, y), axis=1)
    pixels = np.stack(bright(image), axis=1)
    assert len(pixels) > 100
    for points, others in ((pixels, outline[::10]), (outline[::40], pixels)):
        inside = ((points > 2) & (points < np.array(view.size[::-1]) - 2)).all(axis=1)
        distance = np.linalg.norm(points[inside, None] - others[None], axis=2).min(axis=1)
        assert distance.max() < 1.3  # half a line and half a pixel


def test_a_mark_has_the_gaussians_own_colour_at_full_brightness(overlay):
    view = View((3.8, 3.1), (100.0, 100.0), (100, 100))
    image, _ = overlay(one(color=(0.3, 0.0, 0.0)), view, "centers")
    assert image[50, 50, 0] > 0.8
    assert image[50, 50, 1] < 0.5


def test_a_faint_gaussian_is_drawn_fainter(overlay):
    view = View((3.8, 3.1), (100.0, 100.0), (100, 100))
    strengths = [
        np.abs(overlay(one(opacity=opacity), view, "centers")[0] - 0.5).sum()
        for opacity in (1.0, 0.2, 0.01, 0.0)
    ]
    assert strengths == sorted(strengths, reverse=True)
    assert strengths[1] > 0.2 * strengths[0]
    assert strengths[3] < 1e-3


@pytest.mark.parametrize("kind", ["centers", "ellipses"])
def test_nothing_outside_the_view_is_drawn(overlay, kind):
    image, _ = overlay(one(mean=(200.0, -90.0)), View((0.0, 0.0), (20.0, 20.0), (99, 99)), kind)
    assert (image == 0.5).all()


@pytest.mark.parametrize("kind", ["centers", "ellipses"])
def test_crowded_marks_fade_out_and_say_so(overlay, kind):
    gaussians = grid(0.25)
    view = View((0.0, 0.0), (4 * CLOSEST * 0.9,) * 2, (100, 100))
    image, drawn = overlay(gaussians, view, kind)
    assert not drawn
    assert (image == 0.5).all()
    near, drawn = overlay(gaussians, View((8.0, 8.0), (30.0, 30.0), (100, 100)), kind)
    assert drawn
    assert (near != 0.5).any()


def test_every_visible_gaussian_has_one_centre(overlay):
    gaussians = grid(1.0)
    view = View((2.0, 3.0), (20.0, 20.0), (100, 140))
    image, _ = overlay(gaussians, view, "centers", color=WHITE)
    for row in range(5):
        for column in range(7):
            assert image[20 * row + 10, 20 * column + 10].min() > 0.9


def test_no_tiles_and_empty_tiles_draw_nothing(overlay):
    view = View((0.0, 0.0), (20.0, 20.0), (30, 30))
    assert overlay(one()[:0], view, "centers")[1] is False


def test_the_callers_framebuffer_stays_bound(gl_context, overlay):
    mine = gl_context.simple_framebuffer((4, 4))
    mine.use()
    overlay(one(), View((0.0, 0.0), (20.0, 20.0), (30, 30)), "ellipses")
    assert gl_context.fbo is mine


def test_wrong_sizes_are_refused(gl_context):
    overlays = Overlays(gl_context)
    framebuffer = gl_context.simple_framebuffer((5, 4))
    with pytest.raises(RequestError, match="6x4"):
        overlays.draw([], View((0.0, 0.0), (1.0, 1.0), (4, 6)), framebuffer, "centers")
    with pytest.raises(RequestError, match="sigma"):
        overlays.draw([], View((0.0, 0.0), (1.0, 1.0), (4, 5)), framebuffer, "ellipses", sigma=0)
    overlays.release()
