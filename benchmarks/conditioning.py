"""What the scale told to the network costs: PSNR over conditioning scale and render scale.

    python benchmarks/conditioning.py Set5 Set14 --model lite

The network is told a scale; its Gaussians can then be drawn at any other. Rows are what it was
told, columns how large the picture was drawn; each cell is the mean PSNR (Y, dB) over the
pictures of FOLDER/HR, scaled down by the render scale as MATLAB does it. The last row is the rule
of `gsasr upscale`: the render scale, within what networks are trained for.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

from gsasr import image
from gsasr.evaluation.metrics import psnr_y
from gsasr.imresize import downscale
from gsasr.model import GSASR, load_model
from gsasr.picture import conditioning_scale, upscale
from gsasr.view import View


def main() -> None:
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument("folders", type=Path, nargs="+", help="each with HR/*.png")
    options.add_argument("--model", default="lite")
    options.add_argument("--conditions", type=float, nargs="+", default=[1.5, 2, 3, 4, 8])
    options.add_argument("--scales", type=int, nargs="+", default=[2, 3, 4, 6, 8, 12])
    arguments = options.parse_args()
    model = load_model(arguments.model)
    for folder in arguments.folders:
        print(f"\n| {folder.name}: told | " + " | ".join(f"x{s}" for s in arguments.scales) + " |")
        print("|---" * (len(arguments.scales) + 1) + "|")
        for condition in [*arguments.conditions, None]:
            cells = [f"{mean_psnr(model, folder, s, condition):.2f}" for s in arguments.scales]
            told = f"{condition:g}" if condition else "as drawn, 1 to 4"
            print(f"| {told} | " + " | ".join(cells) + " |", flush=True)


def mean_psnr(model: GSASR, folder: Path, scale: int, condition: float | None) -> float:
    """Mean PSNR of the pictures of a folder, told `condition`, or the render scale if None."""
    scores = []
    for path in sorted(folder.glob("HR/*.png")):
        color = np.rint(image.read(path).color * 255).astype(np.uint8)
        lr = downscale(color, scale)
        truth = color[: lr.shape[0] * scale, : lr.shape[1] * scale].astype(np.float32) / 255
        view = View.at_scale(lr.shape[:2], scale)
        told = condition or conditioning_scale(scale)
        with torch.inference_mode():
            picture = upscale(model, lr.astype(np.float32) / 255, view, told, backend="cpu")
        scores.append(psnr_y(picture, truth, scale))
    return float(np.mean(scores))


if __name__ == "__main__":
    main()
