"""What the OpenGL benchmark compares: each rasterizer draws the picture, and counts its work."""

import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from fields import one, random_field

from benchmarks.contestants import CONTESTANTS
from benchmarks.contestants.cell_loop import CellLoop, banded
from benchmarks.contestants.contestant import drawn
from benchmarks.contestants.paper import Paper, box, sample
from gsasr.rasterize import footprint, reference
from gsasr.view import View

BENCHMARKS = Path(__file__).parent.parent / "benchmarks"
EXACT = [name for name in CONTESTANTS if name not in ("paper", "quads, 16 bit")]
VIEWS = {
    "whole": View.at_scale((17, 23), 3),
    "part": View((5.25, -2.5), (7.5, 7.5), (60, 90)),
    "small": View((-3.0, -2.0), (0.7, 0.7), (19, 31)),
    "deep": View((11.21, 8.83), (300.0, 300.0), (33, 44)),
}


@pytest.fixture(scope="module")
def field():
    return random_field(1200, (17, 23), largest_std=1.2)


@pytest.mark.parametrize("view", VIEWS.values(), ids=VIEWS.keys())
@pytest.mark.parametrize("name", EXACT)
def test_a_contestant_draws_what_the_reference_draws(gl_context, monkeypatch, field, name, view):
    monkeypatch.setattr(CONTESTANTS[name], "dtype", "f4", raising=False)
    assert_draws(gl_context, name, field, view, 1e-3)


def test_quads_of_16_bits_lose_some_8_bit_steps_where_hundreds_add_up(gl_context, field):
    assert_draws(gl_context, "quads, 16 bit", field, VIEWS["whole"], 8 / 255)


def test_bands_of_small_buffers_draw_the_same(gl_context, monkeypatch, field):
    records, cut = drawn(field)
    bands = banded(records, cut, 8192)
    assert len(bands) > 3
    assert sum(len(band[0]) for band in bands) == len(records)
    assert all(array.nbytes <= 8192 for band in bands for array in (band[0], band[4]))
    monkeypatch.setattr(CellLoop, "dtype", "f4")
    monkeypatch.setattr("benchmarks.contestants.cell_loop.banded", lambda *_: bands)
    assert_draws(gl_context, "cell loop", field, VIEWS["part"], 1e-3)


def test_the_paper_draws_within_its_box(gl_context, field):
    view = VIEWS["part"]
    truth = reference.render(field, view, box(field, view)).numpy()
    contestant = Paper(gl_context, field)
    contestant.draw(view)
    assert contestant.share(view) == 1
    # A pixel at the very edge of a box may fall on either side of it.
    wrong = np.abs(contestant.image() - truth).max(axis=2) > 1e-4
    assert wrong.mean() < 2e-3


def test_the_paper_draws_a_share_where_all_would_take_too_long(field):
    some = sample(field, VIEWS["whole"], 100 * VIEWS["whole"].size[0] * VIEWS["whole"].size[1])
    assert len(some) == 100
    assert bool((some.mean[0] == field.mean[0]).all() and (some.mean[-1] == field.mean[-1]).all())


def test_a_contestant_counts_the_pixels_of_one_gaussian(gl_context):
    field = one((4.5, 4.5), (0.5, 0.5), size=(9, 9))
    view = View.at_scale(field.size, 10)
    counted = {
        name: make(gl_context, field).evaluations(view) for name, make in CONTESTANTS.items()
    }
    radius = (
        10 * 0.5 * float(footprint.cut(field, "screen")) ** 0.5
    )  # pixels; the mean is between two
    assert 16 < radius < 21
    assert counted["quads"] == counted["quads, 16 bit"] == (2 * math.floor(radius + 0.5)) ** 2
    assert counted["cpu"] == pytest.approx(np.pi * radius**2, rel=0.05)
    # Of the 5x5 cells round the mean all but the corners, 21.2 pixels away, are met.
    assert counted["cell loop"] == 21 * 100
    assert counted["cell loop"] <= counted["gsasr"] <= 81 * 100
    assert counted["paper"] == 8**2  # |offset| <= 0.1 * 89 / 2 = 4.45 pixels


def test_the_benchmark_prints_a_row_for_every_contestant_and_view(gl_context, tmp_path):
    small = "--sources 16 --per-pixel 2 --sizes 64x48 --zooms fit 40 --frames 2"
    short = "--path-seconds 0.4 --path-fps 10 --path-stride 2"
    out = tmp_path / "gl.md"
    printed = run(f"gl.py {small} {short} --out {out}")
    assert out.read_text() == printed
    rows = list(table_rows(printed))
    for name in ("gsasr", "cell loop", "quads", "cpu", "paper"):
        of_name = [row for row in rows if row["rasterizer"].split(" (")[0] == name]
        timed = [row["median, ms"] for row in of_name if "median, ms" in row]
        assert (len(of_name), len(timed)) == (4, 3), name  # the bytes; two views and the path
        assert all(float(median.replace(",", "")) > 0 for median in timed)


def test_the_breakdown_of_a_frame_adds_up(gl_context):
    printed = run("breakdown.py --side 16 --size 64x48 --zooms 4 --frames 1")
    lines = printed.split("```")[1].strip().splitlines()
    depths = [(len(line) - len(line.lstrip())) // 2 for line in lines]
    seconds = [float(line[36:44]) for line in lines]
    assert "dispatches" in printed and "display pass" in printed
    parts = sum(s for s, depth in zip(seconds, depths, strict=True) if depth == 1)
    assert depths[0] == 0 and parts == pytest.approx(seconds[0], abs=0.01 * len(lines))


def table_rows(markdown):
    """Each row of all tables, its cells by the names of their columns."""
    names = None
    for line in markdown.splitlines():
        if not line.startswith("|"):
            names = None
        elif not line.startswith("|---"):
            cells = [cell.strip() for cell in line.strip("|").split("|")]
            if names is None:
                names = cells
            else:
                yield dict(zip(names, cells, strict=True))


def run(command):
    """What a benchmark prints."""
    script, *arguments = command.split()
    done = subprocess.run(
        [sys.executable, BENCHMARKS / script, *arguments], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def assert_draws(ctx, name, field, view, tolerance):
    contestant = CONTESTANTS[name](ctx, field)
    contestant.draw(view)
    truth = reference.render(field, view)
    error = torch.from_numpy(contestant.image().copy()).double() - truth
    contestant.release()
    assert float(error.abs().max()) < tolerance
