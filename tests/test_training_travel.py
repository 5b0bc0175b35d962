"""The state of a run in small files."""

from dataclasses import replace

import pytest
import torch
from training import QUICK, log_rows, write_pictures

from gsasr.errors import CheckpointError, DataError
from gsasr.training import loop, optimizer, travel
from gsasr.training.loop import train
from gsasr.training.state import read_parts
from gsasr.training.travel import pack, unpack


@pytest.fixture
def pictures(tmp_path, monkeypatch, tiny_model):
    monkeypatch.setitem(loop.MODELS, "lite", tiny_model.config)
    monkeypatch.setattr(optimizer, "NARROW", 8)
    return write_pictures(tmp_path / "pictures")


@pytest.mark.parametrize("name", ["adam", "muon"])
def test_training_goes_on_from_packed_files_nearly_as_from_the_state(pictures, tmp_path, name):
    config = replace(QUICK, optimizer=name, batch=4, decay=1e-9)
    train("lite", pictures, tmp_path / "run", config)
    pack(tmp_path / "run", tmp_path / "files")
    assert unpack(tmp_path / "files", tmp_path / "other") == tmp_path / "other" / "state.pt"
    losses = []
    for run in ("run", "other"):
        train("lite", pictures, tmp_path / run, replace(config, steps=10))
        losses.append([float(r["loss"]) for r in log_rows(tmp_path / run) if int(r["step"]) > 6])
    assert len(losses[0]) == 3
    assert losses[0] == pytest.approx(losses[1], rel=0.01)


def test_a_packed_state_takes_a_third_and_keeps_weights_to_three_digits(tmp_path):
    from gsasr.model import GSASR, PRESETS
    from gsasr.training.state import TrainState

    torch.manual_seed(0)
    state = TrainState.fresh(GSASR(PRESETS["lite"], "lite"), QUICK)
    state.optimizer.param_groups[0]["lr"] = 1e-3
    for _ in range(3):
        for parameter in state.model.parameters():
            parameter.grad = torch.randn_like(parameter) * 1e-3
        state.optimizer.step()
        state.step += 1
        state.update_average(0.999)
    run = tmp_path / "run"
    run.mkdir()
    state.save(run / "state.pt")
    sizes = [
        sum(path.stat().st_size for path in pack(run, tmp_path / "files", moments))
        for moments in (False, True)
    ]
    weights = sum(p.numel() for p in state.model.parameters())
    assert sizes[0] < 4 * weights and sizes[1] < 6.5 * weights  # of 16 bytes per weight
    back = read_parts(unpack(tmp_path / "files", tmp_path / "other"))
    was = read_parts(run / "state.pt")
    assert back["step"] == 3 and back["model"].keys() == was["model"].keys()
    for part, tolerance in (("model", 2**-8), ("average", 2e-3)):
        for name, value in was[part].items():
            error = (back[part][name] - value).abs().max()
            assert error <= tolerance * value.abs().max(), name
    for number, moments in was["optimizer"]["state"].items():
        again = back["optimizer"]["state"][number]
        first, second = moments["exp_avg"], moments["exp_avg_sq"]
        assert (again["exp_avg"] - first).abs().max() <= first.abs().max() / 250
        assert (again["exp_avg_sq"] >= second * (1 - 1e-5)).all()  # a step never grows


def test_large_states_are_split_and_a_missing_file_is_noticed(pictures, tmp_path, monkeypatch):
    monkeypatch.setattr(travel, "PART", 20_000)
    train("lite", pictures, tmp_path / "run", QUICK)
    paths = pack(tmp_path / "run", tmp_path / "files")
    assert len(paths) > 2 and all(path.stat().st_size <= 20_000 for path in paths)
    unpack(tmp_path / "files", tmp_path / "other")
    with pytest.raises(DataError, match="exists"):
        unpack(tmp_path / "files", tmp_path / "other")
    paths[-2].write_bytes(b"damaged")
    with pytest.raises(CheckpointError, match="damaged"):
        unpack(tmp_path / "files", tmp_path / "third")
    for missing in (paths[-1], paths[0]):
        missing.unlink()
        with pytest.raises(CheckpointError, match="all the files"):
            unpack(tmp_path / "files", tmp_path / "third")
    with pytest.raises(CheckpointError, match="does not exist"):
        pack(tmp_path / "nothing", tmp_path / "files")


def test_a_state_without_moments_and_one_that_is_none_are_packed_or_refused(pictures, tmp_path):
    train("lite", pictures, tmp_path / "run", QUICK)
    pack(tmp_path / "run", tmp_path / "files", moments=False)
    unpack(tmp_path / "files", tmp_path / "other")
    again = pack(tmp_path / "other", tmp_path / "again")
    assert sum(p.stat().st_size for p in again) > 0
    torch.save({"params": 1}, tmp_path / "other" / "state.pt")
    with pytest.raises(CheckpointError, match="damaged"):
        pack(tmp_path / "other", tmp_path / "again")
