"""Training by several processes: the same curve as one process with the whole batch."""

import os
import socket
import subprocess
import sys
from dataclasses import replace

import pytest
import torch
from training import QUICK, log_rows, write_pictures

from gsasr.errors import RequestError
from gsasr.training.loop import train
from gsasr.training.parallel import Group
from gsasr.training.state import read_parts

STEADY = replace(QUICK, batch=4, steps=4, save_every=1, validate_every=100, decay=1e-9)
OPTIONS = (
    "--patch 8 --batch 4 --warmup 2 --save-every 1 --validate-every 100 --decay 1e-9 "
    "--optimizer adam --precision float32"
)


def environment() -> dict[str, str]:
    """Without what a surrounding torchrun would say, and with one thread per process."""
    ours = {k: v for k, v in os.environ.items() if k not in ("RANK", "WORLD_SIZE", "LOCAL_RANK")}
    return ours | {"OMP_NUM_THREADS": "1"}


def command(data, run, *more) -> list[str]:
    arguments = ["train", "--device", "cpu", "--data", data, "--out", run, *OPTIONS.split(), *more]
    return [str(argument) for argument in arguments]


def test_two_processes_learn_what_one_learns_and_one_may_go_on(tmp_path):
    data = write_pictures(tmp_path / "pictures")
    (data / "z.png").write_bytes((data / "0.png").read_bytes()[:900])
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone"]
    torchrun += ["--nproc-per-node", "2", "-m", "gsasr.cli"]
    done = subprocess.run(
        [*torchrun, *command(data, tmp_path / "parts", "--steps", "2")],
        capture_output=True,
        text=True,
        env=environment(),
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("model.safetensors") == 1  # one of them talks
    assert done.stderr.count("z.png") <= 1
    train("lite", data, tmp_path / "parts", STEADY)
    train("lite", data, tmp_path / "whole", STEADY)
    losses, whole = (
        [float(row["loss"]) for row in log_rows(tmp_path / name)] for name in ("parts", "whole")
    )
    assert len(losses) == 4
    # Only the order of additions differs.
    assert losses == pytest.approx(whole, abs=5e-6)
    average = [read_parts(tmp_path / name / "state.pt")["average"] for name in ("parts", "whole")]
    for name, value in average[0].items():
        torch.testing.assert_close(value, average[1][name], atol=1e-4, rtol=1e-3, msg=name)


def test_when_one_process_fails_the_others_stop_with_one_sentence(tmp_path):
    data = write_pictures(tmp_path / "pictures")
    (tmp_path / "empty").mkdir()
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = str(free.getsockname()[1])
    processes = []
    for rank, folder in enumerate((data, tmp_path / "empty")):
        places = {"RANK": str(rank), "LOCAL_RANK": str(rank), "WORLD_SIZE": "2"}
        places |= {"MASTER_ADDR": "localhost", "MASTER_PORT": port}
        processes.append(
            subprocess.Popen(
                [sys.executable, "-m", "gsasr.cli", *command(folder, tmp_path / "run")],
                env=environment() | places,
                stderr=subprocess.PIPE,
                text=True,
            )
        )
    said = [process.communicate(timeout=60)[1] for process in processes]
    assert [process.returncode for process in processes] == [2, 2]
    assert "There are no pictures" in said[1]
    assert "Another process of this run has stopped" in said[0]
    assert "Traceback" not in said[0] + said[1]


def test_a_batch_is_shared_evenly_or_not_at_all():
    cpu = torch.device("cpu")
    assert [Group(cpu, rank, 2).share(6) for rank in (0, 1)] == [range(3), range(3, 6)]
    with pytest.raises(RequestError, match="multiple of 4"):
        Group(cpu, 0, 4).share(6)
