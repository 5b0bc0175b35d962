"""The OpenGL rasterizer, held against the dense reference."""

import subprocess
import sys
import threading

import numpy as np
import pytest
import torch

from gsasr.errors import BackendError, RequestError
from gsasr.gaussians import Gaussians
from gsasr.rasterize import blocks, cells, gl, opengl, reference, tiles
from gsasr.view import View

TOLERANCE = {"screen": 1e-3, "export": 1e-4}

pytestmark = pytest.mark.usefixtures("gl_context")


def random_gaussians(n=300, size=(17, 23), low=0.1, high=1.0, seed=0, corner=(0.0, 0.0)):
    rng = torch.Generator().manual_seed(seed)
    height, width = size
    return Gaussians(
        mean=torch.rand(n, 2, generator=rng) * torch.tensor([width + 4.0, height + 4.0])
        - 2
        + torch.tensor(corner),
        std=torch.rand(n, 2, generator=rng) * (high - low) + low,
        rho=torch.rand(n, generator=rng) * 1.9 - 0.95,
        color=torch.rand(n, 3, generator=rng),
        opacity=torch.rand(n, generator=rng) * 0.5,
        size=(int(height + corner[1]), int(width + corner[0])),
    )


def one(mean=(1.5, 1.5), std=(0.5, 0.5), rho=0.0, color=(1.0, 0.5, 0.25), opacity=1.0, size=(3, 3)):
    return Gaussians(
        torch.tensor([mean]),
        torch.tensor([std]),
        torch.tensor([rho]),
        torch.tensor([color]),
        torch.tensor([opacity]),
        size,
    )


def error(gaussians, view, quality="export"):
    drawn = gl.render(gaussians, view, quality)
    assert drawn.shape == (*view.size, 3)
    assert drawn.dtype == np.float32
    assert np.isfinite(drawn).all()
    return np.abs(drawn - reference.render(gaussians, view).numpy()).max(initial=0.0)


@pytest.fixture
def rasterizer(gl_context):
    made = gl.GlRasterizer(gl_context)
    yield made
    made.release()


def draw(rasterizer, parts, view, dtype="f4", **options):
    """What GlRasterizer.draw leaves in a texture, (h, w, 3) float32."""
    target = rasterizer.ctx.texture(view.size[::-1], 4, dtype=dtype)
    rasterizer.draw(parts, view, target, **options)
    kind = {"f2": np.float16, "f4": np.float32}[dtype]
    image = np.frombuffer(target.read(), kind).reshape(*view.size, 4).astype(np.float32)
    target.release()
    return image[..., :3]


@pytest.mark.parametrize("quality", ["screen", "export"])
@pytest.mark.parametrize("scale", [0.5, 1, 2.5, 4, 12, 30])
def test_it_agrees_with_the_reference_at_every_scale(scale, quality):
    gaussians = random_gaussians(size=(17, 23) if scale < 10 else (7, 9))
    view = View.at_scale(gaussians.size, scale)
    assert error(gaussians, view, quality) < TOLERANCE[quality]


@pytest.mark.parametrize("size", [(1, 1), (1, 37), (53, 1), (101, 203)])
@pytest.mark.parametrize("scale", [(7.1, 3.3), (0.9, 11.7), (1.0, 1.0)])
def test_regions_that_stick_out_of_the_picture_agree_with_the_reference(scale, size):
    assert error(random_gaussians(), View((-5.3, -4.1), scale, size)) < 1e-4


def test_a_single_gaussian_has_the_values_of_the_formula():
    drawn = gl.render(one(), View((0.0, 0.0), (1.0, 1.0), (3, 3)))
    # one source pixel is two standard deviations: exp(-2) beside the mean, exp(-4) diagonally
    column = np.exp(-0.5 * np.array([2.0, 0.0, 2.0]) ** 2)
    expected = np.outer(column, column)[..., None] * np.array([1.0, 0.5, 0.25])
    np.testing.assert_allclose(drawn, expected, atol=1e-4)


def test_no_gaussians_make_a_black_picture():
    empty = random_gaussians()[:0]
    assert not gl.render(empty, View((0.0, 0.0), (2.0, 2.0), (5, 7))).any()


def test_a_view_without_pixels_makes_an_empty_picture():
    assert gl.render(one(), View((0.0, 0.0), (2.0, 2.0), (0, 7))).shape == (0, 7, 3)


@pytest.mark.parametrize(
    "extreme",
    [
        one(std=(1e-5, 1e-5)),  # sampled exactly at its mean
        one(std=(1e-6, 1e-6), mean=(1.3, 1.4)),
        one(std=(1e-6, 2.0)),
        one(std=(3.0, 1e-6)),
        one(rho=0.999999, std=(1.0, 1.0)),
        one(rho=-0.999999, std=(0.02, 3.0)),
        one(rho=0.999, std=(2.0, 0.05), mean=(1.4, 1.6)),
        one(std=(40.0, 25.0), rho=0.5),
        one(std=(1e5, 1e5)),
        one(mean=(-40.0, 90.0)),
        one(mean=(1e7, -1e7)),
        one(opacity=0.0),
    ],
    ids=lambda g: f"std {g.std[0].tolist()} rho {float(g.rho):g} mean {g.mean[0].tolist()}",
)
@pytest.mark.parametrize("scale", [0.5, 1, 3, 12, 50])
def test_extreme_gaussians_agree_with_the_reference(extreme, scale):
    view = View((0.0, 0.0), (scale, scale), (max(1, int(3 * scale)), max(1, int(3 * scale))))
    assert error(extreme, view) < 1e-4


@pytest.mark.parametrize("scale", [1.0, 3.0, 9.0, 40.0])
def test_gaussians_of_every_steepness_agree_with_the_reference(scale):
    # narrower and wider than what is followed along a row by multiplication
    rng = torch.Generator().manual_seed(5)
    gaussians = random_gaussians(400)
    std = torch.exp(torch.rand(400, 2, generator=rng) * 7 - 5.5)
    view = View((2.2, 3.3), (scale, scale), (60, 90))
    spread = Gaussians(**{**gaussians.tensors(), "std": std, "size": gaussians.size})
    assert error(spread, view) < 1e-4


@pytest.mark.parametrize("shape", [blocks.SOFTWARE, blocks.HARDWARE], ids=["software", "hardware"])
@pytest.mark.parametrize("scale", [(0.4, 0.4), (1.05, 1.05), (1.3, 1.3), (1.6, 1.6), (1.3, 13.0)])
def test_narrow_gaussians_are_right_where_cells_have_few_pixels(gl_context, scale, shape):
    rng = torch.Generator().manual_seed(2)
    field = random_gaussians(3000, (24, 24))
    std = 0.08 + 0.04 * torch.rand(3000, 2, generator=rng)
    field = Gaussians(**{**field.tensors(), "std": std, "size": field.size})
    view = View((0.1, 0.2), scale, tuple(int(23 * side) for side in scale[::-1]))
    rasterizer = gl.GlRasterizer(gl_context, shape)
    for sides in ((1.0,), (2.0,), (4.0,), (1.0, 2.0, 4.0)):
        tile = rasterizer.upload(tiles.pack(field, "export", sides))
        drawn = draw(rasterizer, [tile], view)
        assert np.abs(drawn - reference.render(field, view).numpy()).max() < 1e-4
    rasterizer.release()


def test_a_deep_zoom_far_from_the_corner_is_exact():
    gaussians = random_gaussians(60, (8, 8), corner=(4000.0, 3000.0))
    for scale in (1000.0, 1e5):
        view = View((4003.123456789, 3002.987654321), (scale, scale), (40, 64))
        assert error(gaussians, view) < 1e-5


def test_pixels_a_millionth_apart_do_not_jitter():
    view = View((4001.3, 3001.7), (1e6, 1e6), (1, 400))
    ramp = one(mean=(4001.0, 3001.7), size=(4000, 4000))
    drawn = gl.render(ramp, view)[0, :, 0].astype(np.float64)
    exact = reference.render(ramp, view)[0, :, 0].numpy()
    assert np.abs(drawn - exact).max() < 5e-6  # float32 positions would be off by 2e-4


def test_several_tiles_sum_to_the_picture_of_one(rasterizer):
    gaussians = random_gaussians(size=(40, 50))
    view = View.at_scale(gaussians.size, 5)
    expected = reference.render(gaussians, view).numpy()
    parts = tiles.split_tiles(gaussians, side=16)
    assert len(parts) == 12
    assert sum(len(part) for part in parts) == len(gaussians)
    uploaded = [rasterizer.upload(part, "export") for part in parts]
    assert np.abs(draw(rasterizer, uploaded, view) - expected).max() < 1e-4
    half = draw(rasterizer, uploaded, view, dtype="f2")
    assert np.abs(half - expected).max() < 2e-3 * max(1.0, expected.max())


def test_a_tile_that_arrives_later_is_added(rasterizer):
    gaussians = random_gaussians(size=(40, 50))
    view = View.at_scale(gaussians.size, 3)
    uploaded = [rasterizer.upload(part) for part in tiles.split_tiles(gaussians, side=16)]
    target = rasterizer.ctx.texture(view.size[::-1], 4, dtype="f4")
    rasterizer.draw(uploaded[:5], view, target)
    rasterizer.draw(uploaded[5:], view, target, clear=False)
    drawn = np.frombuffer(target.read(), np.float32).reshape(*view.size, 4)
    assert np.abs(drawn[..., :3] - draw(rasterizer, uploaded, view)).max() < 1e-5
    assert (drawn[..., 3] == 1).all()


def test_rows_can_be_drawn_by_themselves(rasterizer):
    gaussians = random_gaussians()
    view = View.at_scale(gaussians.size, 6)
    tile = rasterizer.upload(gaussians)
    target = rasterizer.ctx.texture(view.size[::-1], 4, dtype="f4")
    for start in range(0, view.size[0], 13):
        rasterizer.draw([tile], view, target, rows=(start, min(start + 13, view.size[0])))
    drawn = np.frombuffer(target.read(), np.float32).reshape(*view.size, 4)[..., :3]
    np.testing.assert_allclose(drawn, draw(rasterizer, [tile], view), atol=1e-5)


@pytest.mark.parametrize("shape", [blocks.SOFTWARE, blocks.HARDWARE], ids=["software", "hardware"])
@pytest.mark.parametrize("quality", ["screen", "export"])
def test_every_block_and_cell_draws_the_same_picture(gl_context, monkeypatch, shape, quality):
    gaussians = random_gaussians()
    view = View((0.3, 0.2), (9.0, 9.0), (150, 200))
    expected = reference.render(gaussians, view).numpy()
    rasterizer = gl.GlRasterizer(gl_context, shape)
    tile = rasterizer.upload(gaussians, quality)
    for level in tile.levels:
        for block in shape.blocks:
            monkeypatch.setattr(blocks, "choose", lambda *_, c=(level.side, block): c)
            drawn = draw(rasterizer, [tile], view)
            assert np.abs(drawn - expected).max() < TOLERANCE[quality]
    rasterizer.release()


def test_entries_of_32_bits_draw_the_same_picture(rasterizer, monkeypatch):
    gaussians = random_gaussians()
    view = View((0.3, 0.2), (9.0, 9.0), (150, 200))
    monkeypatch.setattr(cells, "SHORT", 20)
    tile = rasterizer.upload(gaussians, "export")
    assert any(level.wide for level in tile.levels)
    expected = reference.render(gaussians, view).numpy()
    assert np.abs(draw(rasterizer, [tile], view) - expected).max() < 1e-4


def test_lists_longer_than_a_driver_reads_in_one_go_are_drawn_whole(rasterizer, monkeypatch):
    gaussians = random_gaussians()
    view = View((0.3, 0.2), (9.0, 9.0), (150, 200))
    expected = reference.render(gaussians, view).numpy()
    monkeypatch.setattr(gl, "PORTION", 3)
    tile = rasterizer.upload(gaussians, "export")
    assert min(level.longest for level in tile.levels) > 3 * 3
    assert np.abs(draw(rasterizer, [tile], view) - expected).max() < 1e-4


def test_a_hundred_thousand_gaussians_on_one_pixel_are_all_drawn():
    count = 150_000
    crowd = Gaussians(
        mean=torch.full((count, 2), 1.5),
        std=torch.full((count, 2), 0.5),
        rho=torch.zeros(count),
        color=torch.ones(count, 3),
        opacity=torch.full((count,), 1.0 / count),
        size=(3, 3),
    )
    drawn = gl.render(crowd, View((0.0, 0.0), (5.0, 5.0), (15, 15)), "export")
    assert drawn[7, 7] == pytest.approx([1.0] * 3, abs=1e-3)  # float32 adds up so many to this


def test_records_are_short_for_the_screen_only_where_their_range_suffices(rasterizer):
    usual = random_gaussians()
    view = View.at_scale(usual.size, 5)
    for gaussians, quality, packed in (
        (usual, "screen", True),
        (usual, "export", False),
        (Gaussians.concatenate([usual, one(std=(1e-5, 1.0))]), "screen", False),
        (Gaussians.concatenate([usual, one(std=(1.0, 1.0), rho=0.99)]), "screen", False),
        (Gaussians.concatenate([usual, one(std=(1e5, 1e5), opacity=0.1)]), "screen", False),
    ):
        tile = rasterizer.upload(gaussians, quality)
        assert (tile.unpacking is not None) == packed
        expected = reference.render(gaussians, view).numpy()
        assert np.abs(draw(rasterizer, [tile], view) - expected).max() < TOLERANCE[quality]


def test_a_gaussian_takes_at_most_64_bytes_at_16_per_pixel():
    rng = torch.Generator().manual_seed(0)
    count = 16 * 96 * 96
    field = Gaussians(
        mean=96 * torch.rand(count, 2, generator=rng),
        std=0.2 + 0.35 * torch.rand(count, 2, generator=rng),
        rho=1.6 * torch.rand(count, generator=rng) - 0.8,
        color=torch.rand(count, 3, generator=rng),
        opacity=torch.full((count,), 0.1),
        size=(96, 96),
    )
    (part,) = tiles.split_tiles(field)
    packed = tiles.pack(part)
    lists = sum(level.lists.nbytes + level.entries.nbytes for level in packed.levels)
    assert (packed.records.data.nbytes + lists) / count < 64


def test_the_cheapest_cells_and_blocks_grow_with_what_a_pixel_sees():
    loads = [blocks.Load(1.0, 197, 0), blocks.Load(2.0, 301, 26), blocks.Load(4.0, 158, 530)]
    sides, sizes = zip(
        *(blocks.choose(loads, scale, blocks.SOFTWARE) for scale in (1, 2, 6, 8, 10)), strict=True
    )
    assert sides == (4.0, 2.0, 1.0, 1.0, 1.0)
    assert sizes == (4, 4, 6, 8, 10)


def test_a_target_of_another_size_is_refused(rasterizer):
    view = View((0.0, 0.0), (1.0, 1.0), (8, 9))
    with pytest.raises(RequestError, match="9x8"):
        rasterizer.draw([], view, rasterizer.ctx.texture((8, 9), 4, dtype="f4"))


def test_pictures_larger_than_a_piece_agree_with_the_reference(monkeypatch):
    monkeypatch.setattr(gl, "BLOCK", 64)
    monkeypatch.setattr(gl, "PIXELS", 64 * 17)
    gaussians = random_gaussians()
    assert error(gaussians, View((-1.0, -1.0), (7.7, 7.7), (131, 150))) < 1e-4


def test_fields_larger_than_what_is_held_at_once_agree_with_the_reference(monkeypatch):
    monkeypatch.setattr(gl, "HELD", 1)
    monkeypatch.setattr(gl, "split_tiles", lambda gaussians, most: tiles.split_tiles(gaussians, 8))
    gaussians = random_gaussians()
    assert error(gaussians, View((-1.0, -1.0), (7.7, 7.7), (131, 150))) < 1e-4


def test_drawing_causes_no_error_of_the_driver(gl_context, rasterizer):
    gaussians = random_gaussians()
    draw(rasterizer, [rasterizer.upload(gaussians)], View.at_scale(gaussians.size, 3))
    assert gl_context.error == "GL_NO_ERROR"


def test_warming_up_compiles_every_program_and_draws_nothing(gl_context, rasterizer):
    rasterizer.warm_up("f4")
    compiled = len(rasterizer.shape.blocks) + 1
    assert len(rasterizer._programs) == compiled
    gaussians = random_gaussians()
    view = View.at_scale(gaussians.size, 3)
    drawn = draw(rasterizer, [rasterizer.upload(gaussians)], view)
    assert np.abs(drawn - reference.render(gaussians, view).numpy()).max() < 1e-3
    assert len(rasterizer._programs) == compiled
    assert gl_context.error == "GL_NO_ERROR"


def test_runs_cover_every_pixel_once_and_stay_inside_a_cell():
    rng = np.random.default_rng(0)
    for _ in range(200):
        origin, scale = rng.uniform(-50, 4000), float(np.exp(rng.uniform(-3, 8)))
        start, stop = sorted(rng.integers(0, 300, 2).tolist())
        side, longest = float(rng.choice([1, 2, 4])), int(rng.integers(1, 17))
        made = blocks.runs(origin, scale, start, stop, side, longest)
        assert made["count"].sum() == stop - start
        assert (np.diff(made["cell"]) >= 0).all()
        for pixel, count, cell, offset in made.tolist():
            assert 1 <= count <= longest
            last = origin + (pixel + count - 0.5) / scale
            first = origin + (pixel + 0.5) / scale
            assert np.floor(first / side) == np.floor(last / side) == cell
            middle = origin + (pixel + count // 2 + 0.5) / scale
            assert offset == pytest.approx(middle - cell * side, abs=1e-5)
        np.testing.assert_array_equal(
            np.concatenate([np.arange(p, p + n) for p, n, *_ in made.tolist()] or [[]]),
            np.arange(start, stop),
        )


def test_tiles_never_hold_more_than_the_most():
    parts = tiles.split_tiles(random_gaussians(200), side=16, most=30)
    assert max(len(part) for part in parts) == 30
    assert sum(len(part) for part in parts) == 200


def test_it_draws_from_any_thread_and_leaves_the_callers_context_current(gl_context):
    gaussians = random_gaussians()
    view = View.at_scale(gaussians.size, 3)
    expected = gl.render(gaussians, view)
    results = []
    threads = [
        threading.Thread(target=lambda: results.append(gl.render(gaussians, view)))
        for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(results) == 4
    for drawn in results:
        np.testing.assert_array_equal(drawn, expected)
    buffer = gl_context.buffer(b"still here")
    assert buffer.read() == b"still here"


def test_a_machine_without_opengl_is_told_what_to_do(monkeypatch):
    def refuse(**_):
        raise Exception("cannot create context")

    monkeypatch.setattr(opengl.moderngl, "create_context", refuse)
    with pytest.raises(BackendError, match="--backend cpu"):
        opengl.create_context()
    opengl.hardware.cache_clear(), opengl.driver_info.cache_clear()
    assert opengl.hardware() is False
    opengl.hardware.cache_clear(), opengl.driver_info.cache_clear()


def test_importing_it_loads_no_torch_and_the_program_ends_cleanly():
    code = (
        "import sys, types; package = types.ModuleType('gsasr.rasterize');"
        "import gsasr.files, pathlib;"
        "root = pathlib.Path(gsasr.files.__file__).parent / 'rasterize';"
        "package.__path__ = [str(root)]; sys.modules['gsasr.rasterize'] = package;"
        "from gsasr.rasterize import gl, opengl; assert 'torch' not in sys.modules;"
        "opengl.hardware(); gl._drawing_thread().submit(gl._headless).result()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


def test_one_huge_gaussian_costs_its_neighbours_no_precision():
    small = random_gaussians(n=50, size=(9, 9))
    huge = one((4.0, 4.0), (1e5, 1e5), opacity=0.2, size=(9, 9))
    together = Gaussians.concatenate([small, huge])
    assert error(together, View((2.0, 2.0), (40.0, 40.0), (90, 110))) < 1e-4
