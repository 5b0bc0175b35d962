"""The index that shaders build: its lists against the CPU's, its pictures against the oracle's."""

import math
import threading
import time

import numpy as np
import pytest
import torch
from fields import EXTREMES, one, random_field
from test_cells import one_list

from gsasr.errors import FieldError
from gsasr.gaussians import Gaussians
from gsasr.rasterize import cells, footprint, gl, gl_index, reference, tiles
from gsasr.rasterize.cells import CELL_SIDES, Cells
from gsasr.rasterize.gl_index import SLACK, PrefixSum
from gsasr.rasterize.opengl import software
from gsasr.view import View

TOLERANCE = {"screen": 1e-3, "export": 1e-4}


@pytest.fixture(scope="module")
def rasterizer(gl_context):
    made = gl.GlRasterizer(gl_context, index=True)
    yield made
    assert gl_context.error == "GL_NO_ERROR"
    made.release()


@pytest.fixture(scope="module")
def build(rasterizer):
    """Gaussians to the tile that shaders make of them, or None if they leave it to the CPU."""
    return lambda gaussians, quality="export", sides=CELL_SIDES: rasterizer._index.build(
        gaussians, quality, sides
    )


def draw(rasterizer, made, view):
    target = rasterizer.ctx.texture(view.size[::-1], 4, dtype="f4")
    rasterizer.draw(made, view, target)
    assert rasterizer.ctx.error == "GL_NO_ERROR"
    image = np.frombuffer(target.read(), np.float32).reshape(*view.size, 4)[..., :3]
    target.release()
    return image


def error(rasterizer, gaussians, view, quality, side=tiles.SIDE):
    made = [rasterizer.upload(part, quality) for part in tiles.split_tiles(gaussians, side)]
    drawn = draw(rasterizer, made, view)
    for tile in made:
        tile.release()
    assert np.isfinite(drawn).all()
    return np.abs(drawn - reference.render(gaussians, view).numpy()).max()


def downloaded(level) -> Cells:
    """An index on the GPU as the CPU's type."""
    return Cells(
        level.side,
        level.first,
        level.shape,
        np.frombuffer(level.lists.read(), np.uint32),
        np.frombuffer(level.entries.read(), np.uint32 if level.wide else np.uint16),
        level.ordinary + level.steep,
        level.steep,
        level.longest,
    )


def means(tile) -> np.ndarray:
    """(N, 2) of the records of a tile on the GPU, source pixels."""
    if tile.unpacking is None:
        mean = np.frombuffer(tile.records.read(), np.float32).reshape(-1, 8)[1:, :2]
    else:
        packed = np.frombuffer(tile.records.read(), np.uint32).reshape(-1, 4)[1:, :2]
        mean = (packed & 0xFFFFF) * tile.unpacking[0]
    return mean.astype(np.float64) + tile.origin


def numbers(tile, gaussians) -> np.ndarray:
    """Which Gaussian each record of a tile is; each is there once."""
    apart = np.abs(means(tile)[:, None] - gaussians.mean.double().numpy()).max(axis=2)
    number = apart.argmin(axis=1)
    assert apart.min(axis=1).max() < 1e-3
    assert sorted(number) == list(range(len(gaussians)))
    return number


def by_cell(index, number=None) -> dict:
    """{(column, row): (ordinary, steep)}, sets of Gaussians, in the grid of all the picture."""
    rows, columns = index.shape
    found = {}
    for i in range(rows * columns):
        at = index.first[0] + i % columns, index.first[1] + i // columns
        both = [one_list(index, i, which) for which in range(2)]
        assert sum(map(len, both)) == len(set(both[0] + both[1]))  # none is listed twice
        found[at] = tuple(set(number[e] if number is not None else e for e in es) for es in both)
    return found


def least_q(mean, std, rho, low, high) -> float:
    """Of a Gaussian over a rectangle; the formula of shaders/gaussian.glsl, in float64."""
    (x0, y0), (x1, y1) = low - mean, high - mean
    root = np.sqrt(1 - rho**2)
    a, b, c = 1 / (std[0] * root), -rho / (std[1] * root), 1 / std[1]
    x, y = np.clip(0, x0, x1), np.clip(0, y0, y1)
    along_x, along_y = np.clip(-b * y / a, x0, x1), np.clip(-a * b * x / (b * b + c * c), y0, y1)
    return min(
        (a * along_x + b * y) ** 2 + (c * y) ** 2, (a * x + b * along_y) ** 2 + (c * along_y) ** 2
    )


def assert_same_lists(tile, gaussians, quality):
    """As cells.build makes them, but for what is within rounding of a cell's edge."""
    number = numbers(tile, gaussians)
    mean, std, rho = (t.double().numpy() for t in (gaussians.mean, gaussians.std, gaussians.rho))
    cut = footprint.cut(gaussians, quality).double().numpy()
    sides = tuple(level.side for level in tile.levels)
    steep_from = cells._steep_from(std, rho, cut)
    for level, expected in zip(tile.levels, cells.build(mean, std, rho, cut, sides), strict=True):
        index, side = downloaded(level), level.side
        assert side == expected.side
        found, expected = by_cell(index, number), by_cell(expected)
        assert set(expected) <= set(found)
        for (column, row), kinds in found.items():
            ours, theirs = set.union(*kinds), set.union(*expected.get((column, row), [set()]))
            assert theirs <= ours
            for n in ours - theirs:
                low = np.array([column, row]) * side
                edge = 1.2 * SLACK
                q = least_q(mean[n], std[n], rho[n], low - edge, low + side + edge)
                assert q <= cut[n] + 2e-4, (n, column, row)
            for n in kinds[0] ^ (ours - {n for n in ours if steep_from[n] < side}):
                assert steep_from[n] == pytest.approx(side, rel=1e-3)
        lengths = [[len(kind) for kind in kinds] for kinds in found.values()]
        assert np.sum(lengths, axis=0).tolist() == [level.ordinary, level.steep]
        assert level.longest == (np.max(lengths) + 1) // 2


@pytest.mark.parametrize("count", [1, 2, 1023, 1024, 1025, 1_000_000, 1_050_000])
def test_prefix_sums_are_those_of_numpy(gl_context, count):
    values = np.random.default_rng(count).integers(0, 4000, count, np.uint32)
    before = gl_index.ALIGNMENT  # what lies before and after stays as it was
    buffer = gl_context.buffer(np.concatenate([np.full(before, 7, np.uint32), values, values[:3]]))
    scan = PrefixSum(gl_context)
    for _ in range(2):
        buffer.write(values, 4 * before)
        scan.run(buffer, before, count)
        made = np.frombuffer(buffer.read(), np.uint32)
        expected = np.cumsum(values, dtype=np.uint32) - values
        np.testing.assert_array_equal(made[before : before + count], expected)
        assert (made[:before] == 7).all()
        np.testing.assert_array_equal(made[before + count :], values[:3])
        count = max(1, count // 3)  # the next use is a smaller one
        values = values[:count]
        buffer = gl_context.buffer(
            np.concatenate([np.full(before, 7, np.uint32), values, values[:3]])
        )
    scan.release()


@pytest.mark.parametrize("quality", TOLERANCE)
@pytest.mark.parametrize("largest", [0.3, 1.5, 3.0])
def test_every_cell_lists_the_gaussians_that_the_cpu_lists(build, quality, largest):
    field = random_field(int(300 / largest), (21, 34), largest_std=largest)
    tile = build(field, quality)
    assert_same_lists(tile, field, quality)
    tile.release()


def test_gaussians_far_from_the_corner_of_the_picture_are_listed_likewise(build):
    field = random_field(300, (20, 20))
    for corner in ((4001.0, 3003.0), (-502.0, -77.0)):
        field.mean[:] += torch.tensor(corner)
        tile = build(field)
        assert_same_lists(tile, field, "export")
        tile.release()


def test_gaussians_on_the_edges_of_cells_are_in_all_that_they_touch(build):
    place = torch.arange(200.0)
    thin = [torch.full((200,), 1e-6), torch.full((200,), 0.6)]
    for stds in (thin, thin[::-1], [thin[0], thin[0]]):
        field = random_field(200, (200, 4))
        field.std[:] = torch.stack(stds, dim=1)
        field.mean[:] = torch.stack([0.5 * place + 1, (7 * place) % 200], dim=1)
        field.opacity[:] = 1
        tile = build(field)
        assert_same_lists(tile, field, "export")
        tile.release()


def test_records_follow_the_source_row_by_row(build):
    field = random_field(2000, (40, 60))
    tile = build(field, "export")
    x, y = np.floor(means(tile)).T
    assert (np.diff(y * 1000 + x) >= 0).all()
    tile.release()


def test_some_sizes_of_cells_can_be_asked_for(build):
    field = random_field(300, (21, 34))
    for sides in ((4.0,), (2.0,), (1.0, 4.0)):
        tile = build(field, "screen", sides)
        assert tuple(level.side for level in tile.levels) == sides
        assert_same_lists(tile, field, "screen")
        tile.release()
    assert build(field, "screen", (0.5, 1.0)) is None


def test_the_cut_counts_areas_beyond_32_bits(build):
    field = random_field(200, (9, 9))
    unseen = [one((4.5, 4.5), (700.0, 700.0), opacity=0.0)] * 12  # 9e9 256ths of a square pixel
    together = Gaussians.concatenate([field, *unseen])
    together.mean[:] += 1e-3 * torch.arange(len(together))[:, None]  # to tell them apart
    tile = build(together)
    assert_same_lists(tile, together, "export")
    tile.release()


def test_gaussians_that_lie_side_by_side_in_memory_are_not_copied():
    field = random_field(300, (20, 20))
    for start in (0, 7):
        (tile,) = tiles.split_tiles(field[start:])
        for part in (tile, tile[2:9], tile[::2]):
            table = gl_index._table(part)
            assert np.shares_memory(table, part.std.numpy()) == (part.std.stride(0) == 9)
            columns = [t.reshape(len(part), -1) for t in part.tensors().values()]
            np.testing.assert_array_equal(table, torch.cat(columns, dim=1).numpy())


@pytest.mark.parametrize("quality", TOLERANCE)
def test_a_tile_tells_of_itself_what_a_packed_one_tells(rasterizer, build, quality):
    field = random_field(3000, (40, 50))
    made = build(field, quality)
    packed = tiles.pack(field, quality)
    assert made.count == len(packed)
    assert made.extent == packed.extent
    assert made.largest == packed.largest
    assert (made.unpacking is None) == (packed.records.unpacking is None)
    assert all(abs(a - b) <= 1 for a, b in zip(made.bounds, packed.bounds, strict=True))
    uploaded = rasterizer.upload(packed)
    assert made.nbytes == pytest.approx(uploaded.nbytes, rel=0.01)
    made.release(), uploaded.release()


def test_short_records_are_those_of_the_cpu(build):
    field = random_field(3000, (40, 50))
    field.std[:] += 0.05
    tile = build(field, "screen")
    number = numbers(tile, field)
    ours = np.frombuffer(tile.records.read(), np.uint32).reshape(-1, 4)
    assert not ours[0].any()
    packed = tiles.pack(field, "screen").records
    theirs = packed.data[1:][number]
    assert (ours[1:, 2:] & 0xFFFF == theirs[:, 2:] & 0xFFFF).mean() > 0.99  # of half floats
    halves = [
        (data[:, 2:] & 0xFFFF).astype(np.uint16).view(np.float16) for data in (ours[1:], theirs)
    ]
    np.testing.assert_allclose(*halves, rtol=1.1e-3)
    for column, shift in ((0, 20), (1, 20), (3, 16)):
        apart = (ours[1:, column] >> shift).astype(int) - (theirs[:, column] >> shift)
        assert np.abs(apart).max() <= 1
    tile.release()


@pytest.mark.parametrize("quality", TOLERANCE)
@pytest.mark.parametrize("scale", [0.5, 1, 3.3, 12, 1000])
def test_pictures_agree_with_the_oracle(rasterizer, build, scale, quality):
    field = random_field(800, (17, 23))
    made = build(field, quality)
    assert made is not None
    made.release()
    view = View((3.3, 2.2) if scale > 10 else (-1.0, -1.0), (scale, scale), (50, 70))
    assert error(rasterizer, field, view, quality) < TOLERANCE[quality]


@pytest.mark.parametrize("quality", TOLERANCE)
@pytest.mark.parametrize("extreme", EXTREMES)
@pytest.mark.parametrize("crowd", [0, 400], ids=["alone", "among others"])
def test_extreme_gaussians_agree_with_the_oracle(rasterizer, extreme, crowd, quality):
    field = Gaussians.concatenate([random_field(crowd, (5, 5)), EXTREMES[extreme]])
    for scale in (1, 7, 60):
        view = View((-0.4, -0.3), (scale, scale), (40, 50))
        assert error(rasterizer, field, view, quality) < TOLERANCE[quality]


@pytest.mark.parametrize("quality", TOLERANCE)
def test_several_tiles_sum_to_the_picture(rasterizer, build, quality):
    field = random_field(4000, (100, 90))
    parts = tiles.split_tiles(field, 64)
    assert len(parts) == 4
    assert all(build(part, quality) is not None for part in parts)
    corner = View((64 - 12.0, 64 - 9.0), (4.0, 4.0), (60, 90))  # of the four tiles
    assert error(rasterizer, field, corner, quality, side=64) < TOLERANCE[quality]


def test_cells_at_the_border_of_a_tile_are_drawn(rasterizer):
    field = random_field(300, (6, 6))
    for corner in ((0.0, 0.0), (250.0, 250.0)):
        shifted = Gaussians(
            **{**field.tensors(), "mean": field.mean + torch.tensor(corner)}, size=(6, 6)
        )
        view = View((corner[0] - 4, corner[1] - 4), (5.0, 5.0), (70, 70))
        assert error(rasterizer, shifted, view, "export") < 1e-4


def test_entries_are_wide_only_where_a_cell_names_gaussians_too_far_apart(
    rasterizer, build, monkeypatch
):
    field = random_field(300, (17, 23))
    assert not any(level.wide for level in build(field).levels)
    monkeypatch.setattr(cells, "SHORT", 20)
    tile = build(field)
    assert any(level.wide for level in tile.levels)
    assert_same_lists(tile, field, "export")
    assert error(rasterizer, field, View.at_scale(field.size, 5), "export") < 1e-4


def test_a_crowd_on_one_pixel_is_counted_whole(build):
    count = 70_000
    crowd = random_field(count, (1, 1))
    crowd.mean[:] = 0.5
    crowd.std[:] = 0.1
    crowd.opacity[:] = 1e-3
    crowd.color[:] = 1
    tile = build(crowd)
    (level,) = (level for level in tile.levels if level.side == 4)
    assert level.wide
    assert level.longest == count // 2
    named = np.frombuffer(level.entries.read(), np.uint32)
    assert np.array_equal(np.unique(named), np.arange(0 if named.min() == 0 else 1, count + 1))
    tile.release()


@pytest.mark.parametrize(
    "field",
    [
        EXTREMES["none"],
        EXTREMES["invisible"],
        EXTREMES["huge"],
        EXTREMES["far"],
        random_field(1000, (20, 20), largest_std=9.0),  # lists would grow beyond their limit
        Gaussians.concatenate([one((0.5, 0.5), (1, 1)), one((250.0, 250.0), (20.0, 20.0))]),
        Gaussians.concatenate([one((0.5, 0.5), (1, 1)), one((300.0, 0.5), (1, 1))]),  # no tile
        random_field(50, (9, 9)).map(torch.Tensor.double),
    ],
    ids=["none", "invisible", "huge", "far", "long lists", "sparse", "no tile", "64 bits"],
)
def test_what_does_not_suit_the_shaders_is_left_to_the_cpu(rasterizer, build, field):
    assert build(field) is None
    view = View((-1.0, -1.0), (3.0, 3.0), (40, 50))
    tile = rasterizer.upload(field, "export")
    expected = reference.render(field, view).numpy()
    assert np.abs(draw(rasterizer, [tile], view) - expected).max() < 1e-4 * max(1, expected.max())
    tile.release()


def test_what_is_left_to_the_cpu_is_packed_on_another_thread(rasterizer, monkeypatch):
    threads, go_on = [], threading.Event()

    def pack(*arguments):
        threads.append(threading.current_thread())
        go_on.wait(10)
        return tiles.pack(*arguments)

    monkeypatch.setattr(gl, "pack", pack)
    steps = rasterizer.uploading(EXTREMES["huge"], "export")
    for _ in range(3):
        start = time.perf_counter()
        next(steps)
        assert time.perf_counter() - start < 1
    abandoned = rasterizer.uploading(EXTREMES["huge"], "export")
    next(abandoned)
    abandoned.close()  # waits for nothing
    go_on.set()
    with pytest.raises(StopIteration) as end:
        while True:
            next(steps)
    end.value.value.release()
    assert threading.main_thread() not in threads


def test_each_step_of_warming_up_compiles_at_most_one_program(gl_context, monkeypatch):
    rasterizer = gl.GlRasterizer(gl_context, index=True)
    compiled = []
    compute_shader = type(gl_context).compute_shader
    monkeypatch.setattr(
        type(gl_context), "compute_shader", lambda *a: compiled.append(a) or compute_shader(*a)
    )
    for number, _ in enumerate(rasterizer.warming(), start=1):
        assert len(compiled) == number
    assert number > len(gl_index.PROGRAMS)
    field = random_field(5000, (30, 30))
    field.std[:] += 0.05  # which short records can hold
    rasterizer.upload(field, "screen").release()
    assert len(compiled) == number  # none was forgotten
    rasterizer.release()


def test_values_that_are_not_finite_are_refused_as_on_the_cpu(rasterizer):
    field = random_field(50, (9, 9))
    for value in (math.nan, math.inf):
        field.mean[7, 0] = value
        for upload in (rasterizer.upload, tiles.pack):
            with pytest.raises(FieldError, match="not finite"):
                upload(field)


def test_a_tile_leaves_nothing_behind_for_the_next(build):
    field = random_field(300, (17, 23))
    first = downloaded(build(field).levels[0])
    build(random_field(4000, (60, 60)))
    build(EXTREMES["huge"])
    second = downloaded(build(field).levels[0])
    for which in range(2):  # the bases depend on the order within a pixel, which is free
        np.testing.assert_array_equal(first.lists[which::3], second.lists[which::3])
    assert first.count == second.count


def test_only_a_gpu_indexes_unless_told_otherwise(gl_context, monkeypatch):
    assert gl.GlRasterizer(gl_context).packs == software(gl_context.info)
    for emulated in (False, True):
        monkeypatch.setattr(gl, "software", lambda _, e=emulated: e)
        assert gl.GlRasterizer(gl_context).packs == emulated
    assert not gl.GlRasterizer(gl_context, index=True).packs
    assert gl.GlRasterizer(gl_context, index=False).packs
