"""PSNR and SSIM of a network on a benchmark folder (NAME/HR/*.png and NAME/LR/xS/*.png)."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .. import image
from ..errors import DataError
from ..model import GSASR
from ..picture import upscale
from ..view import View
from .metrics import psnr_y, ssim_y


@dataclass(frozen=True)
class Score:
    """One picture at one scale: PSNR in dB and SSIM, both on Y with a border of `scale` cropped."""

    name: str
    scale: int
    psnr: float
    ssim: float


def benchmark(
    model: GSASR,
    folder: str | os.PathLike,
    scales: tuple[int, ...] = (2, 3, 4),
    backend: str = "cpu",
    precision: str = "float32",
    progress: Callable[[float], None] = lambda share: None,
) -> list[Score]:
    """Scores of every picture of one benchmark set.

    The HR picture is cropped from its top left to scale times the LR picture, as usual. Raises
    DataError if the folder is not laid out as HR/NAME.png and LR/x2|x3|x4/NAME.png.
    """
    folder = Path(folder)
    names = sorted(path.name for path in folder.glob("HR/*.png"))
    missing = [s for s in scales if not (folder / f"LR/x{s}").is_dir()]
    if not names or missing:
        raise DataError(f"{folder} needs HR/NAME.png and LR/xS/NAME.png for each scale S.")
    scores = []
    for scale in scales:
        for name in names:
            lr = image.read(folder / f"LR/x{scale}" / name).color
            height, width = lr.shape[0] * scale, lr.shape[1] * scale
            truth = image.read(folder / "HR" / name).color[:height, :width]
            if truth.shape[:2] != (height, width) or min(height, width) < 11 + 2 * scale:
                raise DataError(f"HR/{name} in {folder} does not fit its LR/x{scale} picture.")
            view = View.at_scale(lr.shape[:2], scale)
            picture = upscale(model, lr, view, backend=backend, precision=precision)
            scores.append(
                Score(name, scale, psnr_y(picture, truth, scale), ssim_y(picture, truth, scale))
            )
            progress(len(scores) / (len(scales) * len(names)))
    return scores


def table(scores: list[Score], per_image: bool = False) -> str:
    """Markdown: a row of means, and with `per_image` one per picture, a column per scale."""
    scales = sorted({score.scale for score in scores})
    lines = ["| image | " + " | ".join(f"x{s}" for s in scales) + " |"]
    lines.append("|---" * (len(scales) + 1) + "|")
    names = sorted({score.name for score in scores}) if per_image else []
    for name in [*names, None]:
        cells = []
        for scale in scales:
            chosen = [s for s in scores if s.scale == scale and name in (None, s.name)]
            psnr, ssim = np.mean([s.psnr for s in chosen]), np.mean([s.ssim for s in chosen])
            cells.append(f"{psnr:.2f} / {ssim:.4f}")
        lines.append(f"| {Path(name).stem if name else 'mean'} | " + " | ".join(cells) + " |")
    return "\n".join(lines)
