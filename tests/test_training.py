"""Training: the recipes, the loop, and going on after a kill."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from training import QUICK, log_rows, write_pictures

from gsasr.errors import BackendError, CheckpointError, DataError, RequestError
from gsasr.files import writing
from gsasr.model import PRESETS, load_model
from gsasr.training import loop, optimizer
from gsasr.training.config import NETWORK_RECIPES, RECIPES, Execution, TrainConfig, recipe
from gsasr.training.loop import train
from gsasr.training.parallel import Group
from gsasr.training.state import read_parts, write_parts


@pytest.fixture
def pictures(tmp_path):
    return write_pictures(tmp_path / "pictures")


@pytest.fixture
def small_preset(monkeypatch, tiny_model):
    """Makes the preset "lite" as small as the tiny model."""
    monkeypatch.setitem(loop.MODELS, "lite", tiny_model.config)
    monkeypatch.setattr(optimizer, "NARROW", 8)  # it has matrices of 8x8 for Muon


def weights(run):
    return read_parts(run / "state.pt")["model"]


def assert_equal_weights(one, other):
    expected, found = weights(one), weights(other)
    for name, value in expected.items():
        torch.testing.assert_close(found[name], value, msg=name)


def test_the_rate_warms_up_holds_and_falls_to_zero():
    config = TrainConfig(steps=1000, rate=1e-3, warmup=100, decay=0.5)
    assert config.rate_at(0) == pytest.approx(1e-5)
    assert config.rate_at(300) == pytest.approx(1e-3)
    assert config.rate_at(750) == pytest.approx(5e-4)
    assert 0 < config.rate_at(999) < 1e-6


def test_the_papers_recipe_states_the_papers_settings():
    paper = recipe("edsr-baseline")
    assert paper is RECIPES["paper"]
    assert (paper.patch, paper.batch, paper.steps, paper.rate) == (48, 64, 500_000, 2e-4)
    assert (paper.scale_min, paper.scale_max, paper.ema, paper.warmup) == (1, 4, 0.999, 2000)
    assert (paper.optimizer, paper.betas, paper.clip) == ("adam", (0.9, 0.99), 0)
    assert paper.precision == "float32"
    assert paper.rate_at(999) == pytest.approx(1e-4)
    halved = [paper.rate_at(s) for s in (249_999, 250_000, 400_000, 450_000, 475_000)]
    assert halved == pytest.approx([2e-4, 1e-4, 5e-5, 2.5e-5, 1.25e-5])
    decoder = PRESETS["edsr-baseline"].decoder
    assert (decoder.window, decoder.channels, decoder.self_blocks) == (12, 180, 6)
    assert decoder.gaussians_per_pixel == 16


def test_the_recipe_of_larger_backbones_differs_in_patch_scales_and_precision_alone():
    large = RECIPES["large"]
    assert (large.patch, large.scale_max, large.precision) == (64, 16, "bfloat16")
    assert replace(large, patch=48, scale_max=4.0, precision="float32") == RECIPES["paper"]


def test_every_network_has_a_recipe_whose_patch_fits_its_windows():
    assert set(NETWORK_RECIPES) == set(PRESETS)
    for network, name in NETWORK_RECIPES.items():
        assert RECIPES[name].patch % PRESETS[network].multiple == 0
    with pytest.raises(RequestError, match="Unknown recipe"):
        recipe("lite", "fast")


def test_impossible_settings_are_refused():
    for wrong in (
        {"scale_min": 0.5},
        {"batch": 0},
        {"precision": "int8"},
        {"optimizer": "sgd"},
        {"betas": (0.9,)},
        {"ema": 7.0},
        {"seed": -1},
        {"rate": float("nan")},
    ):
        with pytest.raises(RequestError):
            TrainConfig(**wrong)
    for wrong in ({"device": "tpu"}, {"workers": -1}, {"cache": -1.0}):
        with pytest.raises(RequestError):
            Execution(**wrong)


@pytest.mark.parametrize("name", ["adam", "muon"])
def test_training_lowers_the_loss_and_writes_a_model_that_loads(
    images, tmp_path, small_preset, name
):
    config = replace(QUICK, steps=40, batch=4, rate=1e-2, save_every=10, validate_every=40)
    config = replace(config, optimizer=name)
    path = train("lite", images, tmp_path / "run", config, valid=images)
    rows = log_rows(tmp_path / "run")
    assert [int(row["step"]) for row in rows] == [10, 20, 30, 40]
    assert float(rows[-1]["loss"]) < 0.9 * float(rows[0]["loss"])
    assert 5 < float(rows[-1]["psnr_x2"]) < 50
    model = load_model(path)
    assert model(torch.rand(1, 3, 8, 8), 2.0).shape == (1, 256, 9)


@pytest.mark.parametrize("name", ["adam", "muon"])
def test_steps_after_a_resume_equal_those_without(pictures, tmp_path, small_preset, name):
    steady = replace(QUICK, decay=1e-9, optimizer=name)  # the length does not matter
    train("lite", pictures, tmp_path / "whole", steady)
    train("lite", pictures, tmp_path / "parts", replace(steady, steps=4))
    train("lite", pictures, tmp_path / "parts", steady)
    assert_equal_weights(tmp_path / "whole", tmp_path / "parts")
    assert [row["step"] for row in log_rows(tmp_path / "parts")] == ["2", "3", "4", "6"]


def test_gradient_checkpointing_and_workers_change_no_result(pictures, tmp_path, small_preset):
    train("lite", pictures, tmp_path / "plain", QUICK, execution=Execution(workers=0))
    other = Execution(workers=1, recompute=True)
    train("lite", pictures, tmp_path / "other", QUICK, execution=other)
    assert_equal_weights(tmp_path / "plain", tmp_path / "other")


def test_recomputed_blocks_are_not_kept_until_the_backward_pass(tiny_model):
    from gsasr.training.network import recompute

    def kept() -> int:
        """Bytes that autograd holds on to after a forward pass."""
        sizes = []

        def pack(tensor):
            sizes.append(tensor.numel() * tensor.element_size())
            return tensor

        with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
            tiny_model(torch.rand(1, 3, 16, 16), 2.0).sum()
        return sum(sizes)

    before = kept()
    recompute(tiny_model)
    assert kept() < 0.5 * before


def test_bfloat16_changes_the_loss_by_little(pictures, tmp_path, small_preset):
    losses = []
    for precision in ("float32", "bfloat16"):
        run = tmp_path / precision
        train("lite", pictures, run, replace(QUICK, steps=2, precision=precision))
        losses.append(float(log_rows(run)[-1]["loss"]))
    assert losses[0] != losses[1]
    assert losses[0] == pytest.approx(losses[1], rel=0.02)


def test_a_state_of_another_network_or_optimizer_is_refused(pictures, tmp_path, small_preset):
    run = tmp_path / "run"
    run.mkdir()
    for content in ({"step": 3}, {"model": {}, "average": {}, "optimizer": {}, "step": 1}):
        torch.save(content, run / "state.pt")
        with pytest.raises(CheckpointError, match="use another --out"):
            train("lite", pictures, run, QUICK)
    (run / "state.pt").write_bytes(b"half a file")
    with pytest.raises(CheckpointError, match="use another --out"):
        train("lite", pictures, run, QUICK)
    (run / "state.pt").unlink()
    train("lite", pictures, run, QUICK)
    before = (run / "state.pt").read_bytes()
    with pytest.raises(CheckpointError, match="does not fit"):
        train("lite", pictures, run, replace(QUICK, optimizer="muon"))
    with pytest.raises(CheckpointError, match="does not fit"):
        train("edsr-baseline", pictures, run, replace(QUICK, patch=12))
    assert (run / "state.pt").read_bytes() == before


def descendants(pid: int) -> set[int]:
    """Processes started by this one and by those, as Linux says."""
    children = set(map(int, Path(f"/proc/{pid}/task/{pid}/children").read_text().split()))
    return children.union(*(descendants(child) for child in children))


def alive(pid: int) -> bool:
    """Is it running, and not just waiting to be noticed dead?"""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_a_kill_loses_only_the_steps_since_the_last_save(pictures, tmp_path):
    run = tmp_path / "run"
    command = [sys.executable, "-m", "gsasr.cli", "train", "--data", str(pictures)]
    command += ["--out", str(run), "--patch", "8", "--batch", "1", "--save-every", "1"]
    command += ["--workers", "1"]
    process = subprocess.Popen([*command, "--steps", "100000"])
    deadline = time.monotonic() + 90
    while time.monotonic() < deadline and not (run / "model.safetensors").exists():
        time.sleep(0.05)
    helpers = descendants(process.pid) if sys.platform == "linux" else set()
    assert helpers or sys.platform != "linux"
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    reached = int(log_rows(run)[-1]["step"])
    load_model(run / "model.safetensors")
    state = torch.load(run / "state.pt", weights_only=True)["step"]
    assert state in (reached, reached - 1)
    deadline = time.monotonic() + 30
    while any(map(alive, helpers)):
        assert time.monotonic() < deadline, "the workers live on"
        time.sleep(0.05)
    done = subprocess.run([*command, "--steps", str(state + 2)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert torch.load(run / "state.pt", weights_only=True)["step"] == state + 2


def test_a_diverging_run_stops_and_keeps_what_was_saved(pictures, tmp_path, small_preset):
    run = tmp_path / "run"
    path = train("lite", pictures, run, replace(QUICK, steps=2))
    with pytest.raises(DataError, match=r"diverged at step \d+; .* lower --rate"):
        train("lite", pictures, run, replace(QUICK, steps=40, rate=1e30, clip=0.0))
    assert load_model(path)  # which refuses weights that are not finite
    assert all(value.isfinite().all() for value in weights(run).values())


def test_weights_that_are_not_finite_are_never_saved(pictures, tmp_path, small_preset, monkeypatch):
    run = tmp_path / "run"
    path = train("lite", pictures, run, replace(QUICK, steps=2))
    sound = torch.optim.Adam.step

    def ruinous(self):
        sound(self)
        with torch.no_grad():
            self.param_groups[0]["params"][0].fill_(float("inf"))

    monkeypatch.setattr(torch.optim.Adam, "step", ruinous)
    with pytest.raises(DataError, match="diverged at step 3;"):
        train("lite", pictures, run, replace(QUICK, save_every=1))
    assert load_model(path)  # which refuses weights that are not finite
    assert read_parts(run / "state.pt")["step"] == 2


def test_a_full_disk_stops_the_run_and_keeps_what_was_saved(
    pictures, tmp_path, small_preset, monkeypatch
):
    run = tmp_path / "run"
    train("lite", pictures, run, replace(QUICK, steps=2))
    before = (run / "state.pt").read_bytes()

    def full(parts, path):
        with writing(path, DataError):
            raise OSError(28, "No space left on device")

    monkeypatch.setattr("gsasr.training.state.write_parts", full)
    with pytest.raises(DataError, match="No space left on device"):
        train("lite", pictures, run, QUICK)
    assert (run / "state.pt").read_bytes() == before
    assert not [path for path in run.iterdir() if path.name.startswith(".")]


def test_a_log_that_is_none_is_refused_and_left_alone(pictures, tmp_path, small_preset):
    run = tmp_path / "run"
    train("lite", pictures, run, replace(QUICK, steps=2))
    good = (run / "log.csv").read_text()
    for wrong in ("a,b\n1,2\n", good.replace("2,", "two,", 1)):
        (run / "log.csv").write_text(wrong)
        with pytest.raises(DataError, match="no log of a run; move it away"):
            train("lite", pictures, run, QUICK)
        assert (run / "log.csv").read_text() == wrong


@pytest.mark.parametrize("name", ["adam", "muon"])
def test_a_run_goes_on_with_the_betas_it_is_given(pictures, tmp_path, small_preset, name):
    run, group = tmp_path / "run", Group(torch.device("cpu"))
    config = replace(QUICK, steps=2, optimizer=name)
    train("lite", pictures, run, config)
    other = replace(config, betas=(0.5, 0.6))
    state = loop.starting_state("lite", other, group, run / "state.pt")
    assert state.step == 2
    assert state.optimizer.param_groups[-1]["betas"] == (0.5, 0.6)


@pytest.mark.skipif(not hasattr(signal, "SIGXFSZ"), reason="needs limits of file sizes")
def test_a_write_that_fails_halfway_says_why_and_keeps_the_old_file(tmp_path):
    import resource

    path = tmp_path / "state.pt"
    path.write_bytes(b"old")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 16, limits[1]))
    try:
        with pytest.raises(DataError, match="File too large"):
            write_parts({"values": torch.rand(1 << 16)}, path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


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


def test_a_damaged_picture_is_named_once_and_training_goes_on(
    pictures, tmp_path, small_preset, capsys
):
    (pictures / "z.png").write_bytes((pictures / "0.png").read_bytes()[:900])
    train("lite", pictures, tmp_path / "run", replace(QUICK, batch=8))
    assert capsys.readouterr().err.count("z.png") == 1


def test_what_cannot_be_trained_is_refused_at_once(pictures, tmp_path):
    run = tmp_path / "run"
    with pytest.raises(RequestError, match="multiple of 8"):
        train("lite", pictures, run, replace(QUICK, patch=33))
    if not torch.cuda.is_available():
        with pytest.raises(BackendError, match="--device cpu"):
            train("lite", pictures, run, QUICK, execution=Execution(device="cuda"))
    assert not run.exists()


def test_a_compiler_that_is_missing_is_told_in_one_sentence(
    pictures, tmp_path, small_preset, monkeypatch
):
    import torch._inductor.config as inductor

    monkeypatch.setattr(inductor.cpp, "cxx", ("no-such-compiler",))
    monkeypatch.setattr(inductor, "fx_graph_cache", False)
    torch._dynamo.reset()
    with pytest.raises(RequestError, match="leave out --compile"):
        train("lite", pictures, tmp_path / "run", QUICK, execution=Execution(compile=True))


def test_tensorboard_gets_curves_and_pictures(pictures, tmp_path, small_preset):
    pytest.importorskip("tensorboard", reason="the extra gsasr[tensorboard] is not installed")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    run = tmp_path / "run"
    train("lite", pictures, run, QUICK, pictures, Execution(tensorboard=True))
    events = EventAccumulator(str(run / "tensorboard"))
    events.Reload()
    losses = [(event.step, event.value) for event in events.Scalars("loss")]
    rows = log_rows(run)
    assert losses == [(int(row["step"]), pytest.approx(float(row["loss"]))) for row in rows]
    assert "psnr_x4" in events.Tags()["scalars"] and "x4/0" in events.Tags()["images"]


def test_without_the_package_tensorboard_is_refused(pictures, tmp_path, small_preset, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(RequestError, match=r"gsasr\[tensorboard\]"):
        train("lite", pictures, tmp_path / "run", QUICK, execution=Execution(tensorboard=True))


def test_renders_shown_while_training_are_pictures_beside_their_truth(pictures, tiny_model):
    from gsasr.training.data import validation_samples
    from gsasr.training.loop import validate

    scores, shown = validate(tiny_model, validation_samples(pictures))
    assert sorted(scores) == ["psnr_x2", "psnr_x3", "psnr_x4"]
    assert sorted(shown) == ["x4/0", "x4/1", "x4/2"]
    for picture in shown.values():
        assert picture.shape == (192, 384, 3) and np.isfinite(picture).all()


def test_help_documents_every_setting_with_what_each_recipe_says_and_loads_no_network():
    code = (
        "import sys\nfrom gsasr import cli\n"
        "for name in ('train', 'prepare', 'pack', 'unpack'):\n"
        "    try: cli.main([name, '--help'])\n"
        "    except SystemExit as stopped: assert stopped.code == 0\n"
        "assert 'torch' not in sys.modules, 'torch was loaded'\n"
    )
    environment = os.environ | {"COLUMNS": "200"}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=environment
    )
    assert done.returncode == 0, done.stderr
    for field in (*fields(TrainConfig), *fields(Execution)):
        assert f"--{field.name.replace('_', '-')} " in done.stdout
        assert field.metadata["help"][:40] in done.stdout
    assert "(paper: 48, large: 64, lite: 32)" in done.stdout
    assert "250000 400000 450000 475000" in done.stdout
