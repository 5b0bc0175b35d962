"""Training: the data, the schedule, the loop, and going on after a kill."""

import csv
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from gsasr.errors import CheckpointError, DataError, RequestError
from gsasr.model import load_model
from gsasr.training.config import PRESETS, TrainConfig
from gsasr.training.data import CropSampler, downscale, find_pictures, validation_pairs
from gsasr.training.loop import train

QUICK = TrainConfig(patch=8, batch=2, steps=6, warmup=2, save_every=2, validate_every=3)


@pytest.fixture
def pictures(tmp_path, images):
    """A folder tree of three pictures of at least 192 pixels a side."""
    folder = tmp_path / "pictures"
    (folder / "more").mkdir(parents=True)
    for name, path in (("a.png", "astronaut"), ("more/b.jpg", "cat"), ("c.png", "chart")):
        Image.open(images / f"{path}.png").convert("RGB").save(folder / name)
    return folder


@pytest.fixture
def small_preset(monkeypatch, tiny_model):
    """Makes the preset "lite" as small as the tiny model."""
    from gsasr.training import loop

    monkeypatch.setitem(loop.MODELS, "lite", tiny_model.config)


def test_pictures_are_found_in_the_whole_tree(pictures):
    (pictures / "notes.txt").write_text("no picture")
    assert [p.name for p in find_pictures(pictures)] == ["a.png", "c.png", "b.jpg"]
    with pytest.raises(DataError, match="no pictures"):
        find_pictures(pictures / "none")


def test_downscaling_is_the_antialiased_bicubic_of_pillow(images):
    picture = Image.open(images / "cat.png").convert("RGB")
    ours = downscale(_tensor(picture)[None], (50, 75))[0]
    pillow = _tensor(picture.resize((75, 50), Image.Resampling.BICUBIC))
    # Pillow rounds to 8 bits between its two passes.
    assert float((ours - pillow).abs().max()) <= 2 / 255 + 1e-6
    assert float((ours - pillow).abs().mean()) < 0.3 / 255
    assert torch.equal((ours * 255).round() / 255, ours)


def _tensor(picture: Image.Image) -> torch.Tensor:
    return torch.from_numpy(np.array(picture)).permute(2, 0, 1).float() / 255


def test_a_batch_depends_on_seed_and_step_alone(pictures):
    one, other = (CropSampler(pictures, 8, (1.0, 4.0)) for _ in range(2))
    one.batch(3, 0, 0)
    for a, b in zip(one.batch(4, 7, 5), other.batch(4, 7, 5), strict=True):
        assert a.scale == b.scale and torch.equal(a.hr, b.hr) and torch.equal(a.lr, b.lr)
    assert not torch.equal(one.batch(1, 7, 5)[0].lr, one.batch(1, 7, 6)[0].lr)


def test_crops_have_the_size_of_their_scale_and_belong_together(pictures):
    for sample in CropSampler(pictures, 16, (1.0, 4.0)).batch(20, 0, 0):
        assert sample.lr.shape == (3, 16, 16)
        assert 1 <= sample.scale <= 4
        assert sample.hr.shape[1] == sample.hr.shape[2] == round(16 * sample.scale)
        again = downscale(sample.hr[None], (16, 16))[0]
        assert float((again - sample.lr).abs().max()) <= 1.01 / 255


def test_pictures_too_small_or_damaged_are_left_out_and_named(pictures, capsys):
    (pictures / "broken.png").write_bytes((pictures / "a.png").read_bytes()[:2000])
    (pictures / "text.png").write_text("not a picture")
    Image.new("RGB", (16, 200)).save(pictures / "thin.png")
    sampler = CropSampler(pictures, 8, (1.0, 4.0))
    assert "thin.png" not in [p.name for p in sampler.paths]
    for step in range(30):
        sampler.batch(2, 0, step)
    said = capsys.readouterr().err
    assert said.count("text.png") == 1 and said.count("broken.png") == 1
    with pytest.raises(DataError, match="at least 2000x2000"):
        CropSampler(pictures, 500, (1.0, 4.0))


def test_validation_pairs_cover_each_picture_at_each_scale(pictures):
    pairs = validation_pairs(pictures)
    assert [p.scale for p in pairs] == [2, 3, 4] * 3
    assert pairs[2].lr.shape == (3, 48, 48) and pairs[2].hr.shape == (3, 192, 192)


def test_the_rate_warms_up_holds_and_falls_to_zero():
    config = TrainConfig(steps=1000, rate=1e-3, warmup=100, decay=0.5)
    assert config.rate_at(0) == pytest.approx(1e-5)
    assert config.rate_at(300) == pytest.approx(1e-3)
    assert config.rate_at(750) == pytest.approx(5e-4)
    assert 0 < config.rate_at(999) < 1e-6


def test_the_paper_preset_states_the_papers_schedule():
    paper = PRESETS["edsr-baseline"]
    assert (paper.patch, paper.batch, paper.steps, paper.rate) == (48, 64, 500_000, 2e-4)
    assert (paper.scale_min, paper.scale_max, paper.ema, paper.warmup) == (1, 4, 0.999, 2000)
    halved = [paper.rate_at(s) for s in (249_999, 250_000, 400_000, 450_000, 475_000)]
    assert halved == pytest.approx([2e-4, 1e-4, 5e-5, 2.5e-5, 1.25e-5])


def test_impossible_settings_are_refused():
    for wrong in (
        {"scale_min": 0.5},
        {"batch": 0},
        {"precision": "int8"},
        {"betas": (0.9,)},
        {"ema": 7.0},
        {"seed": -1},
        {"rate": float("nan")},
    ):
        with pytest.raises(RequestError):
            TrainConfig(**wrong)


def test_training_lowers_the_loss_and_writes_a_model_that_loads(pictures, tmp_path, small_preset):
    config = replace(QUICK, steps=40, batch=4, rate=1e-2, save_every=10, validate_every=40)
    path = train("lite", pictures, tmp_path / "run", config, valid=pictures / "more")
    rows = list(csv.DictReader((tmp_path / "run" / "log.csv").open()))
    assert [int(row["step"]) for row in rows] == [10, 20, 30, 40]
    assert float(rows[-1]["loss"]) < 0.9 * float(rows[0]["loss"])
    assert 5 < float(rows[-1]["psnr_x2"]) < 50
    model = load_model(path)
    assert model(torch.rand(1, 3, 8, 8), 2.0).shape == (1, 256, 9)


def test_steps_after_a_resume_equal_those_without(pictures, tmp_path, small_preset):
    steady = replace(QUICK, decay=1e-9)  # no decay, so that the length does not matter
    whole = load_model(train("lite", pictures, tmp_path / "whole", steady))
    train("lite", pictures, tmp_path / "parts", replace(steady, steps=4))
    parts = load_model(train("lite", pictures, tmp_path / "parts", steady))
    for name, value in whole.state_dict().items():
        torch.testing.assert_close(parts.state_dict()[name], value, msg=name)
    rows = list(csv.DictReader((tmp_path / "parts" / "log.csv").open()))
    assert [row["step"] for row in rows] == ["2", "3", "4", "6"]


def test_a_state_of_another_network_is_refused(pictures, tmp_path, small_preset):
    (tmp_path / "run").mkdir()
    for content in ({"step": 3}, {"model": {}, "average": {}, "optimizer": {}, "step": 1}):
        torch.save(content, tmp_path / "run" / "state.pt")
        with pytest.raises(CheckpointError, match="use another --out"):
            train("lite", pictures, tmp_path / "run", QUICK)
    (tmp_path / "run" / "state.pt").write_bytes(b"half a file")
    with pytest.raises(CheckpointError, match="use another --out"):
        train("lite", pictures, tmp_path / "run", QUICK)


def test_a_kill_loses_only_the_steps_since_the_last_save(pictures, tmp_path):
    run = tmp_path / "run"
    command = [sys.executable, "-m", "gsasr.cli", "train", "--data", str(pictures)]
    command += ["--out", str(run), "--patch", "8", "--batch", "1", "--save-every", "1"]
    process = subprocess.Popen([*command, "--steps", "100000"])
    deadline = time.monotonic() + 90
    while time.monotonic() < deadline and not (run / "model.safetensors").exists():
        time.sleep(0.05)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    reached = int(list(csv.DictReader((run / "log.csv").open()))[-1]["step"])
    load_model(run / "model.safetensors")
    state = torch.load(run / "state.pt", weights_only=True)["step"]
    assert state in (reached, reached - 1)
    done = subprocess.run([*command, "--steps", str(state + 2)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert torch.load(run / "state.pt", weights_only=True)["step"] == state + 2


def test_a_diverging_run_stops_and_keeps_what_was_saved(pictures, tmp_path, small_preset):
    run = tmp_path / "run"
    path = train("lite", pictures, run, replace(QUICK, steps=2))
    saved = path.read_bytes()
    with pytest.raises(DataError, match="diverged at step"):
        train("lite", pictures, run, replace(QUICK, steps=40, rate=1e30, clip=0.0))
    assert path.read_bytes() == saved or load_model(path)


def test_a_run_killed_between_its_last_two_files_is_completed(pictures, tmp_path, small_preset):
    path = train("lite", pictures, tmp_path / "run", QUICK)
    path.unlink()
    (tmp_path / "run" / ".state-1234.pt").write_bytes(b"half")
    assert load_model(train("lite", pictures, tmp_path / "run", QUICK)).config.decoder.window == 4
    assert sorted(p.name for p in (tmp_path / "run").iterdir()) == [
        "log.csv",
        "model.safetensors",
        "state.pt",
    ]


def test_a_patch_that_does_not_fit_the_windows_is_refused_at_once(pictures, tmp_path):
    with pytest.raises(RequestError, match="multiple of 8"):
        train("lite", pictures, tmp_path / "run", replace(QUICK, patch=33))
    assert not (tmp_path / "run").exists()
