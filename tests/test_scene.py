"""What the scene draws, against the oracle, the source, and itself drawn in other ways."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
from viewer_scenarios import assert_shows, make_field

from gsasr.rasterize.gl import pack, split_tiles
from gsasr.view import View
from viewer.coverage import BLOCK, EDGE
from viewer.loading import split, to_rgba
from viewer.mipmaps import mipmaps
from viewer.scene import BACKGROUND, Overlay, Scene, Target
from viewer.source import Source

STEP = 1 / 255


@pytest.fixture
def scene(gl_context):
    made = Scene(gl_context)
    yield made
    made.release()


def random_picture(size=(30, 40), seed=0) -> np.ndarray:
    pixels = np.random.default_rng(seed).integers(0, 256, (*size, 4), dtype=np.uint8)
    pixels[..., 3] = 255
    return pixels


def show(scene: Scene, view: View, **options) -> np.ndarray:
    """(h, w, 3) in [0, 1]."""
    target = Target(scene.ctx, view.size)
    scene.draw(target, view, options.pop("overlay", Overlay()), **options)
    pixels = target.read() / 255
    target.release()
    return pixels


def add(scene: Scene, field) -> None:
    for part, core in split(field):
        for piece in split_tiles(part):
            scene.add_tile(pack(piece))
        scene.cover(core)


def test_at_one_to_one_the_source_is_shown_as_it_is(scene):
    pixels = random_picture()
    scene.set_picture(pixels)
    add(scene, make_field())
    shown = show(scene, View((-5, -7), (1.0, 1.0), (50, 60)))
    assert np.array_equal(shown[7:37, 5:45], pixels[..., :3] / 255)
    outside = np.ones((50, 60), bool)
    outside[7:37, 5:45] = False
    assert np.abs(shown[outside] - BACKGROUND).max() <= 0.51 * STEP


def test_below_one_to_one_source_pixels_are_averaged(scene):
    pixels = random_picture((32, 64))
    scene.set_picture(pixels)
    shown = show(scene, View((0, 0), (0.5, 0.5), (16, 32)))
    expected = pixels[..., :3].reshape(16, 2, 32, 2, 3).mean((1, 3)) / 255
    assert np.abs(shown - expected).max() <= 1.01 * STEP


def test_above_one_to_one_without_gaussians_the_source_is_interpolated(scene):
    ramp = np.zeros((8, 40, 4), np.uint8)
    ramp[..., :3] = 3 * np.arange(40)[None, :, None] + 50
    ramp[..., 3] = 255
    scene.set_picture(ramp)
    shown = show(scene, View((0, 0), (8.0, 8.0), (64, 320)))
    x = (np.arange(320) + 0.5) / 8 - 0.5  # a cubic through a straight line is that line
    inner = (x > 2) & (x < 37)
    expected = (3 * x + 50) / 255
    assert np.abs(shown - expected[None, :, None])[:, inner].max() <= 0.6 * STEP
    # In the middle of each pixel it is that pixel, up to the very edge.
    odd = show(scene, View((0, 0), (9.0, 9.0), (72, 360)))
    assert np.array_equal(odd[4::9, 4::9], ramp[..., :3] / 255)


@pytest.mark.parametrize("scale", [2.0, 3.7, 20.0, 3000.0])
def test_the_field_is_shown_exactly_and_cut_at_the_edge(scene, scale):
    field = make_field()
    scene.set_picture(random_picture())
    add(scene, field)
    width, height = 120, 100
    view = View((20 - width / 2 / scale, -0.4 * height / scale), (scale, scale), (height, width))
    assert_shows(show(scene, view).astype(np.float32), field, view, step=1)


def test_between_one_and_two_the_source_fades_into_the_field(scene):
    pixels, field = random_picture(), make_field()
    scene.set_picture(pixels)
    source = {s: show(scene, View((3, 3), (s, s), (20, 30))) for s in (1.0, 1.2, 1.6, 2.0)}
    add(scene, field)
    differences = [
        np.abs(show(scene, View((3, 3), (s, s), (20, 30))) - source[s]).mean() for s in source
    ]
    assert differences[0] == 0
    assert np.all(np.diff(differences) > 0)


def test_where_gaussians_have_not_arrived_the_source_is_shown(scene):
    field = make_field((16, 230))
    scene.set_picture(random_picture((16, 230)))
    (first, core), *_ = split(field)
    view = View((0, 2), (3.0, 3.0), (36, 690))
    before = show(scene, view)
    for piece in split_tiles(first):
        scene.add_tile(pack(piece))
    assert np.array_equal(show(scene, view), before)  # nothing of half a tile
    scene.cover(core)
    shown = show(scene, view)
    edge = 3 * (core[2] - (EDGE + 1) * BLOCK)
    whole = View((0, 2), (3.0, 3.0), (36, edge))
    assert_shows(shown[:, :edge].astype(np.float32), field, whole, step=3)
    assert np.array_equal(shown[:, 3 * core[2] :], before[:, 3 * core[2] :])
    scene.clear_tiles()
    assert np.array_equal(show(scene, view), before)


def test_a_tile_that_goes_leaves_the_source_and_its_neighbours(scene):
    field = make_field((16, 600))
    scene.set_picture(random_picture((16, 600)))
    view = View((0, 2), (3.0, 3.0), (36, 1800))
    before = show(scene, view)
    add(scene, field)
    whole = show(scene, view)
    core = [core for _, core in split(field)][1]
    scene.uncover(core)
    after = show(scene, view)
    assert not scene.covers(view)
    assert np.array_equal(after[:, 3 * core[0] : 3 * core[2]], before[:, 3 * core[0] : 3 * core[2]])
    edge = 3 * (core[0] - (EDGE + 1) * BLOCK)
    assert np.array_equal(after[:, :edge], whole[:, :edge])
    add(scene, field)  # as if it came back; those still there are replaced
    assert scene.covers(view)
    assert np.array_equal(show(scene, view), whole)


def test_rows_drawn_one_band_after_another_are_the_whole(scene):
    field = make_field()
    scene.set_picture(random_picture())
    add(scene, field)
    view = View((-3, -2), (7.3, 7.3), (240, 320))
    whole = show(scene, view)
    target = Target(scene.ctx, view.size)
    for start, stop in ((200, 240), (0, 57), (57, 200)):
        scene.draw(target, view, Overlay(), (start, stop))
    assert np.abs(target.read() / 255 - whole).max() <= 1.01 * STEP


def test_a_reduced_view_shows_the_same_share_of_gaussians(scene):
    pixels, field = random_picture(), make_field()
    scene.set_picture(pixels)
    add(scene, field)
    reduced = View((0, 0), (0.75, 0.75), (22, 30))
    assert_shows(show(scene, reduced, share=1.0).astype(np.float32), field, reduced, step=1)


def test_transparent_pixels_show_a_checkerboard(scene):
    pixels = random_picture((16, 16))
    pixels[:, :8, 3] = 0
    scene.set_picture(pixels)
    shown = show(scene, View((0, 0), (1.0, 1.0), (16, 16)))
    assert np.array_equal(shown[:, 8:], pixels[:, 8:, :3] / 255)
    assert np.unique((255 * shown[:, :8]).round()).tolist() == [158, 199]
    # Read below the checkerboard, the stored colour
    assert scene.color_at(View((0, 0), (1.0, 1.0), (16, 16)), 2, 3) == tuple(pixels[3, 2, :3])


def test_color_under_the_cursor_is_that_of_the_pixel(scene):
    field = make_field()
    scene.set_picture(random_picture())
    add(scene, field)
    view = View((-3, -2), (11.0, 11.0), (300, 400))
    shown = show(scene, view)
    for x, y in ((100, 80), (333, 222), (40, 25)):
        color = np.array(scene.color_at(view, x, y)) / 255
        assert np.abs(color - shown[y, x]).max() <= 1.01 * STEP
    assert scene.color_at(view, 1, 1) is None


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (64, 64), (301, 222)])
def test_mip_levels_are_means_down_to_one_pixel(size):
    pixels = np.random.default_rng(0).integers(0, 256, (*size, 4), dtype=np.uint8)
    made = mipmaps(pixels)
    assert np.array_equal(made.levels[0], pixels)
    assert made.has_alpha
    assert made.levels[-1].shape == (1, 1, 4)
    for fine, coarse in zip(made.levels, made.levels[1:], strict=False):
        for y, x in {(0, 0), (len(coarse) - 1, coarse.shape[1] - 1)}:
            expected = fine[2 * y : 2 * y + 2, 2 * x : 2 * x + 2].reshape(-1, 4).mean(0)
            assert np.abs(coarse[y, x] - expected).max() <= 0.5


def test_a_large_picture_is_shown_coarsely_at_once_and_exactly_in_the_end(scene):
    ramp = np.zeros((900, 1100, 4), np.uint8)
    ramp[..., 0] = np.linspace(0, 255, 1100)[None]
    ramp[..., 1] = np.linspace(0, 255, 900)[:, None]
    ramp[..., 3] = 255
    scene.show_picture(mipmaps(ramp))
    view = View((0, 0), (1.0, 1.0), (900, 1100))
    assert scene.loading
    assert np.abs(show(scene, view) - ramp[..., :3] / 255).max() <= 4 * STEP
    count = 1
    while not scene.load(0.0):
        count += 1
    assert count > 1  # in bands
    assert not scene.loading
    assert np.array_equal(show(scene, view), ramp[..., :3] / 255)


def test_a_picture_beyond_the_largest_texture_is_averaged(gl_context):
    info = {"GL_MAX_TEXTURE_SIZE": 100}
    small = SimpleNamespace(info=info, texture=gl_context.texture, error="GL_NO_ERROR")
    pixels = random_picture((150, 180))
    source = Source(small, mipmaps(pixels))
    source.load(math.inf)
    finer, _, share = source.levels(1.0)
    assert finer.texture.size == (90, 75) and finer.span == (180, 150) and share == 0
    drawn = np.frombuffer(finer.texture.read(), np.uint8).reshape(75, 90, 4)
    expected = pixels.reshape(75, 2, 90, 2, 4).mean((1, 3))
    assert np.abs(drawn - expected).max() <= 0.5
    source.release()


def test_bytes_of_a_picture_are_kept():
    values = np.arange(256, dtype=np.float32).reshape(16, 16) / 255
    pixels = to_rgba(np.stack([values] * 3, -1), values)
    assert np.array_equal(pixels, (values * 255).round().astype(np.uint8)[..., None].repeat(4, 2))
