"""The plot of a training log."""

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parent.parent / "benchmarks" / "plot_log.py"
LOG = """\
step,seconds,loss,rate,psnr_x2,psnr_x3,psnr_x4
200,9,0.11,1.00e-03,,,
400,18,0.07,1.00e-03,30.1,27.2,25.3
"""


def test_a_log_becomes_the_same_picture_every_time(tmp_path):
    pytest.importorskip("matplotlib", reason="the extra gsasr[plot] is not installed")
    (tmp_path / "log.csv").write_text(LOG)
    drawn = []
    for name in ("a.svg", "b.svg"):
        command = [sys.executable, SCRIPT, tmp_path / "log.csv", "-o", tmp_path / name]
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        drawn.append((tmp_path / name).read_bytes())
    assert drawn[0] == drawn[1] and b"<svg" in drawn[0]
