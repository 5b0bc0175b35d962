"""A network, a recipe and pictures small enough to train in a test."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
from PIL import Image

from gsasr.training.config import TrainConfig

QUICK = TrainConfig(patch=8, batch=2, steps=6, warmup=2, save_every=2, validate_every=3)


def write_pictures(folder: Path, count: int = 3, side: int = 200) -> Path:
    """A folder of smooth, colourful pictures; returns it."""
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(count):
        random = np.random.default_rng(number)
        coarse = random.integers(0, 256, (8, 8, 3), dtype=np.uint8)
        Image.fromarray(coarse).resize((side, side), Image.BICUBIC).save(folder / f"{number}.png")
    return folder


def log_rows(run: Path) -> list[dict[str, str]]:
    with (run / "log.csv").open() as file:
        return list(csv.DictReader(file))
