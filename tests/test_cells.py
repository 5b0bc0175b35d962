"""The index of Gaussians by cell, held against dense sampling, and its GLSL twin."""

import numpy as np
import pytest

from gsasr.rasterize import cells


def random_ellipses(n, seed=0):
    rng = np.random.default_rng(seed)
    mean = rng.uniform(-3, 12, (n, 2))
    std = rng.uniform(0.05, 1.5, (n, 2))
    rho = rng.uniform(-0.98, 0.98, n)
    cut = rng.uniform(-1, 20, n)
    return mean, std, rho, cut


def one_list(index, cell, which):
    """The Gaussians in a cell's ordinary (0) or steep (1) list."""
    start, stop = index.lists[3 * cell + which], index.lists[3 * cell + (3 if which else 1)]
    entries = index.entries[2 * start : 2 * stop].astype(np.int64)
    return (entries[entries > 0] + index.lists[3 * cell + 2] - 1).tolist()


def lists(index):
    """{(column, row): all Gaussians of the cell}, in cells of the picture's grid."""
    rows, columns = index.shape
    return {
        (index.first[0] + column, index.first[1] + row): set(
            one_list(index, i, 0) + one_list(index, i, 1)
        )
        for row in range(rows)
        for column in range(columns)
        for i in [row * columns + column]
    }


def least_q(mean, std, rho, x0, y0, side):
    """Least q over a cell, by fine sampling along its edges (or 0 if it holds the mean)."""
    if x0 <= mean[0] <= x0 + side and y0 <= mean[1] <= y0 + side:
        return 0.0
    t = np.linspace(0, side, 4001)
    x = np.concatenate([x0 + t, x0 + t, np.full_like(t, x0), np.full_like(t, x0 + side)])
    y = np.concatenate([np.full_like(t, y0), np.full_like(t, y0 + side), y0 + t, y0 + t])
    u, v = (x - mean[0]) / std[0], (y - mean[1]) / std[1]
    return (v**2 + (u - rho * v) ** 2 / (1 - rho**2)).min()


@pytest.mark.parametrize("side", [0.5, 1.0, 2.0])
def test_a_gaussian_is_listed_in_exactly_the_cells_its_ellipse_meets(side):
    mean, std, rho, cut = random_ellipses(12)
    index = cells.build(mean, std, rho, cut, (side,))[0]
    assert index.side == side
    for (column, row), listed in lists(index).items():
        for n in range(len(cut)):
            if cut[n] < 0:
                assert n not in listed
                continue
            q = least_q(mean[n], std[n], rho[n], column * side, row * side, side)
            if abs(q - cut[n]) > 1e-2 * max(1, cut[n]):  # sampling finds the least q to about this
                assert (n in listed) == (q <= cut[n]), (n, column, row)


def test_the_grid_covers_footprints_outside_the_picture():
    index = cells.build(np.array([[-7.3, 2.5]]), np.ones((1, 2)), np.zeros(1), np.array([9.0]))[0]
    assert index.first == (-11, -1)
    assert index.shape == (7, 7)


def test_gaussians_that_are_nowhere_make_an_empty_index():
    mean, std, rho, cut = random_ellipses(5)
    for chosen, count in ((cut - 100, 5), (cut, 0)):
        (index,) = cells.build(mean[:count], std[:count], rho[:count], chosen[:count])
        assert index.shape == (0, 0)
        assert len(index.entries) == 0
        assert index.lists.tolist() == [0]


def test_cells_grow_for_huge_gaussians_so_that_memory_stays_bounded():
    n = 4000
    mean, std, rho, _ = random_ellipses(n)
    (index,) = cells.build(mean, std * 200, rho, np.full(n, 16.0))
    assert index.side > 1
    assert index.count <= max(cells.FEW, cells.ENTRIES_PER_GAUSSIAN * n)
    (far,) = cells.build(np.array([[0, 0], [1e9, 1e9]]), std[:2], rho[:2], np.full(2, 9.0))
    assert far.shape[0] * far.shape[1] <= cells.FEW
    assert {0, 1} == set().union(*lists(far).values())


def test_more_rows_than_32_bits_count_make_larger_cells():
    count = 600_000
    rng = np.random.default_rng(0)
    mean = rng.uniform(0, 256, (count, 2))
    std = np.broadcast_to([0.3, 700.0], (count, 2))
    index = cells.build(mean, std, np.zeros(count), np.full(count, 16.0))[0]
    assert index.side > 1
    assert index.count <= cells.ENTRIES_PER_GAUSSIAN * count


def test_steep_gaussians_are_listed_apart():
    mean = np.full((2, 2), 0.5)
    std = np.array([[0.5, 0.5], [0.01, 0.5]])
    (index,) = cells.build(mean, std, np.zeros(2), np.full(2, 4.0))
    inside = -index.first[1] * index.shape[1] - index.first[0]
    assert one_list(index, inside, 0) == [0]
    assert one_list(index, inside, 1) == [1]
    assert 0 < index.steep < index.count


def test_larger_cells_are_met_where_one_of_their_small_ones_is():
    mean, std, rho, cut = random_ellipses(60, seed=3)
    levels = cells.build(mean, std, rho, cut, (0.5, 1.0, 2.0, 8.0))
    assert [level.side for level in levels] == [0.5, 1.0, 2.0, 8.0]
    small = lists(levels[0])
    for level in levels[1:]:
        times = round(level.side / 0.5)
        expected = {}
        for (column, row), held in small.items():
            expected.setdefault((column // times, row // times), set()).update(held)
        found = lists(level)
        for cell, held in expected.items():
            assert found[cell] == held
        assert sum(map(len, found.values())) == level.count


def test_entries_are_wide_only_where_a_cell_names_gaussians_too_far_apart():
    count = cells.SHORT + 10
    mean = np.full((count, 2), 0.5)
    std, rho = np.full((count, 2), 0.05), np.zeros(count)
    nowhere = np.full(count, -1.0)
    for last, wide in ((cells.SHORT - 1, False), (cells.SHORT, True)):
        cut = nowhere.copy()
        cut[[0, last]] = 4.0
        (index,) = cells.build(mean, std, rho, cut)
        assert index.wide == wide
        assert set().union(*lists(index).values()) == {0, last}


def test_degenerate_ellipses_are_indexed_without_overflow():
    mean = np.array([[0.25, 0.25], [3.5, 3.5], [1.0, 1.0]])
    std = np.array([[1e-6, 1e-6], [2.0, 2.0], [1e-12, 5.0]])
    rho = np.array([0.0, 0.999999, -0.999999])
    (index,) = cells.build(mean, std, rho, np.full(3, 9.0))
    held = lists(index)
    assert 0 in held[0, 0]
    assert {1} == held[7, 7] - {2}
    assert 1 not in held.get((7, 0), set())


def test_the_footprint_of_the_shaders_agrees_with_the_index(gl_context):
    from pathlib import Path

    from gsasr.rasterize import opengl, records

    mean, std, rho, cut = random_ellipses(200, seed=1)
    root = np.sqrt(1 - rho**2)
    whitening = [1 / (std[:, 0] * root), -rho / (std[:, 1] * root), 1 / std[:, 1]]
    data = np.stack([*mean.T, *(records.FOLD * w for w in whitening)], axis=1).astype(np.float32)
    opengl.load_shader(gl_context, "rasterize.comp")  # makes gaussian.glsl known
    program = gl_context.compute_shader((Path(__file__).parent / "footprint.comp").read_text())
    (index,) = cells.build(mean, std, rho, cut)
    rows, columns = index.shape
    gl_context.buffer(data).bind_to_storage_buffer(0)
    result = gl_context.buffer(reserve=4 * len(cut) * rows * columns)
    result.bind_to_storage_buffer(1)
    program["first"] = index.first
    program.run(columns, rows, len(cut))
    least = np.frombuffer(result.read(), np.float32).reshape(len(cut), rows, columns)
    threshold = records.FOLD**2 * cut
    held = lists(index)
    for n in range(len(cut)):
        for row in range(rows):
            for column in range(columns):
                listed = n in held[index.first[0] + column, index.first[1] + row]
                value = least[n, row, column]
                if abs(value - threshold[n]) > 1e-4 * max(1, abs(threshold[n])):
                    assert listed == (value <= threshold[n])
