"""What a run tells: a table (log.csv) always, TensorBoard if wanted."""

from __future__ import annotations

import csv
import time
from pathlib import Path

import numpy as np

from ..errors import DataError, RequestError
from ..files import writing

COLUMNS = ("step", "seconds", "loss", "rate", "psnr_x2", "psnr_x3", "psnr_x4")


class Log:
    """log.csv: a row per checkpoint. Rows after the step that a run resumes from are dropped."""

    def __init__(self, path: Path, step: int) -> None:
        self.path = path
        self._rows: list[dict[str, str]] = []
        if path.exists() and step:
            self._rows = _rows_until(path, step)
        before = float(self._rows[-1]["seconds"]) if self._rows else 0.0
        self._started = time.monotonic() - before
        self._losses: list[float] = []

    def loss(self, value: float) -> None:
        self._losses.append(value)

    def write(self, step: int, rate: float, scores: dict[str, float]) -> dict[str, str]:
        """Add the mean loss since the last row; returns the row. Raises DataError."""
        row = {name: f"{scores[name]:.3f}" if name in scores else "" for name in COLUMNS}
        row["step"] = str(step)
        row["seconds"] = f"{time.monotonic() - self._started:.0f}"
        row["loss"] = f"{np.mean(self._losses):.6f}"
        row["rate"] = f"{rate:.2e}"
        self._losses.clear()
        self._rows.append(row)
        with writing(self.path, DataError) as beside, beside.open("w", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS)
            writer.writeheader()
            writer.writerows(self._rows)
        return row


def _rows_until(path: Path, step: int) -> list[dict[str, str]]:
    """The rows of a log up to a step. Raises DataError for a file that is no log."""
    try:
        with path.open(newline="") as file:
            reader = csv.DictReader(file)
            if tuple(reader.fieldnames or ()) != COLUMNS:
                raise ValueError("other columns")
            rows = [row for row in reader if None not in row.values()]
        for row in rows:
            float(row["seconds"])
        return [row for row in rows if int(row["step"]) <= step]
    except (OSError, ValueError, csv.Error) as error:
        raise DataError(f"{path} is no log of a run; move it away to go on without.") from error


class Board:
    """The rows of the log as curves, and sample pictures, for TensorBoard."""

    def __init__(self, folder: Path, step: int) -> None:
        """Raises RequestError if the package is missing; `step`: later events are dropped."""
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError as error:
            raise RequestError(
                "--tensorboard needs the package tensorboard; pip install 'gsasr[tensorboard]'."
            ) from error
        self._writer = SummaryWriter(str(folder), purge_step=step + 1 if step else None)

    def row(self, row: dict[str, str]) -> None:
        for name in COLUMNS[2:]:
            if row[name]:
                self._writer.add_scalar(name, float(row[name]), int(row["step"]))
        self._writer.flush()

    def pictures(self, pictures: dict[str, np.ndarray], step: int) -> None:
        """Name -> (H, W, 3) in [0, 1]."""
        for name, picture in pictures.items():
            self._writer.add_image(name, picture.clip(0, 1), step, dataformats="HWC")

    def close(self) -> None:
        self._writer.close()
