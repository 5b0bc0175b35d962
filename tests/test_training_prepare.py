"""`gsasr prepare`: checking pictures, cutting them up, and making pairs."""

import os

import numpy as np
import pytest
from PIL import Image
from training import write_pictures

from gsasr import cli, imresize
from gsasr.errors import DataError, RequestError
from gsasr.evaluation.benchmark import benchmark
from gsasr.training.data import find_pictures, load, validation_samples
from gsasr.training.prepare import Pairs, Pieces, prepare

SMALL = Pieces(smallest=40, size=80, step=50)


@pytest.fixture
def pictures(tmp_path):
    """Two usable pictures, 200x200 and 120x60, one that is cut off, and one too small."""
    folder = write_pictures(tmp_path / "pictures", count=1)
    Image.open(folder / "0.png").resize((120, 60)).save(folder / "wide.jpg")
    (folder / "more").mkdir()
    (folder / "more" / "cut.png").write_bytes((folder / "0.png").read_bytes()[:2000])
    Image.new("RGB", (300, 39)).save(folder / "thin.png")
    return folder


def test_pieces_cover_a_picture_up_to_its_edges():
    assert Pieces().starts(480) == [0]
    assert Pieces().starts(300) == [0]
    assert Pieces().starts(960) == [0, 240, 480]
    assert Pieces().starts(1000) == [0, 240, 480, 520]
    assert Pieces(rest=40).starts(1000) == [0, 240, 480]
    assert Pieces(rest=39).starts(1000) == [0, 240, 480, 520]
    assert Pieces(rest=500).starts(490) == [0]


def test_pictures_are_cut_up_and_the_broken_and_small_ones_named(pictures, tmp_path):
    out = tmp_path / "out"
    told = prepare(pictures, out, SMALL, workers=2)
    # Along 200: 0, 50, 100, 120; along 120: 0, 40; along 60: 0.
    names = [f"0_{i:03d}.png" for i in range(1, 17)] + ["wide_001.png", "wide_002.png"]
    assert [path.name for path in find_pictures(out)] == names
    whole = load(pictures / "0.png")
    assert (load(out / "0_001.png") == whole[:80, :80]).all()
    assert (load(out / "0_016.png") == whole[120:, 120:]).all()
    assert load(out / "wide_002.png").shape == (60, 80, 3)
    lines = told.splitlines()
    assert lines[0].startswith("2 of 4 pictures became 18 files")
    assert "cut.png" in lines[1] and "thin.png has only 300x39" in lines[2] and len(lines) == 3


def test_a_second_run_completes_what_is_missing_and_redoes_what_changed(pictures, tmp_path):
    out = tmp_path / "out"
    prepare(pictures, out, SMALL)
    (out / "wide_002.png").unlink()
    kept = (out / "0_001.png").stat().st_mtime_ns
    assert "(16 were there already)" in prepare(pictures, out, SMALL)
    assert (out / "wide_002.png").exists() and (out / "0_001.png").stat().st_mtime_ns == kept
    later = kept / 1e9 + 60
    os.utime(pictures / "0.png", (later, later))
    assert "(2 were there already)" in prepare(pictures, out, SMALL)


def test_pictures_of_one_name_do_not_overwrite_each_other(tmp_path):
    folder = write_pictures(tmp_path / "pictures", count=2, side=80)
    Image.open(folder / "1.png").save(folder / "0.jpg")
    prepare(folder, tmp_path / "out", SMALL)
    names = [path.name for path in find_pictures(tmp_path / "out")]
    assert names == ["0.jpg_001.png", "0.png_001.png", "1_001.png"]


def test_pairs_are_laid_out_like_a_benchmark_and_made_by_matlabs_bicubic(
    pictures, tmp_path, tiny_model
):
    out = tmp_path / "out"
    prepare(pictures, out, Pairs(smallest=40))
    truth = load(out / "HR" / "0.png").numpy()
    assert truth.shape == (192, 192, 3)  # a multiple of 12
    for scale in (2, 3, 4):
        small = load(out / f"LR/x{scale}/0.png").numpy()
        assert np.array_equal(small, imresize.downscale(truth, scale))
    scores = benchmark(tiny_model, out)
    assert [(s.name, s.scale) for s in scores][:2] == [("0.png", 2), ("wide.png", 2)]
    samples = validation_samples(out, side=48)
    assert [s.scale for s in samples] == [2, 3, 4, 2, 3, 4]
    for sample in samples:
        assert sample.hr.shape == (48, 48, 3)
        again = imresize.downscale(sample.hr.numpy(), round(sample.scale)).astype(int)
        inside = np.abs(again - sample.lr.numpy())[2:-2, 2:-2]
        assert inside.max() <= 1  # the same place of the picture


def test_what_cannot_be_prepared_is_refused_with_a_reason(pictures, tmp_path):
    with pytest.raises(DataError, match="outside the pictures"):
        prepare(pictures, pictures / "out", SMALL)
    with pytest.raises(DataError, match="no pictures"):
        prepare(tmp_path / "nothing", tmp_path / "out", SMALL)
    prepare(pictures, tmp_path / "out", SMALL)
    with pytest.raises(DataError, match="other settings"):
        prepare(pictures, tmp_path / "out", Pairs(smallest=40))
    with pytest.raises(DataError, match="not empty"):
        prepare(write_pictures(tmp_path / "more"), pictures, SMALL)
    with pytest.raises(DataError, match=r"None of the 4 pictures .* such as: "):
        prepare(pictures, tmp_path / "none", Pieces(smallest=300))
    for wrong in ({"step": 0}, {"size": 100}, {"rest": -1}):
        with pytest.raises(RequestError):
            Pieces(**wrong)
    for scales in ((), (1,), (200,)):
        with pytest.raises(RequestError):
            Pairs(scales=scales)


def test_the_command_says_what_it_did(pictures, tmp_path, capsys):
    out = str(tmp_path / "out")
    options = ["--smallest", "40", "--size", "80", "--workers", "1"]
    assert cli.main(["prepare", str(pictures), "-o", out, *options]) == 0
    assert capsys.readouterr().out.startswith("2 of 4 pictures became")
