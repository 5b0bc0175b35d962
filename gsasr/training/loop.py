"""The training loop (paper Sec. 4.1): crops, L1 on the rendered crop, Adam, averaged weights."""

from __future__ import annotations

import csv
import json
import os
import time
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from .. import rasterize
from ..errors import DataError, RequestError
from ..evaluation.metrics import psnr_y
from ..files import writing
from ..model import GSASR, activate, save_model
from ..model import PRESETS as MODELS
from ..view import View
from .config import TrainConfig
from .data import CropSampler, Sample, validation_pairs
from .state import TrainState

COLUMNS = ("step", "seconds", "loss", "rate", "psnr_x2", "psnr_x3", "psnr_x4")


def train(
    preset: str,
    data: str | os.PathLike,
    out: str | os.PathLike,
    config: TrainConfig,
    valid: str | os.PathLike | None = None,
) -> Path:
    """Train a preset on the pictures below `data`; returns the file of averaged weights.

    `out` receives model.safetensors (averaged weights with their configuration, for
    `load_model`), state.pt (to go on after a kill: call `train` again) and log.csv.
    valid: folder of pictures for validation PSNR; none without it.

    Raises DataError for unusable data or a full disk, CheckpointError for a state of another
    network.
    """
    out = Path(out)
    multiple = MODELS[preset].decoder.window
    if config.patch % multiple:
        raise RequestError(f"--patch must be a multiple of {multiple} for {preset}.")
    sampler = CropSampler(data, config.patch, (config.scale_min, config.scale_max))
    pairs = validation_pairs(valid) if valid else []
    try:
        out.mkdir(parents=True, exist_ok=True)
        for stale in (*out.glob(".state-*.pt"), *out.glob(".model-*.safetensors")):
            stale.unlink()  # half a file of a run that was killed
    except OSError as error:
        raise DataError(f"Cannot write to the folder {out}: {error.strerror}.") from error
    torch.manual_seed(config.seed)
    model = GSASR(MODELS[preset], preset).train()
    state = TrainState.fresh(model, config.betas)
    if (out / "state.pt").exists():
        state.load(out / "state.pt")
    log = Log(out / "log.csv", state.step)

    bar = tqdm(total=config.steps, initial=state.step, unit="step", disable=None)
    while state.step < config.steps:
        rate = config.rate_at(state.step)
        loss = train_step(state, sampler.batch(config.batch, config.seed, state.step), rate, config)
        log.loss(loss)
        bar.update()
        validate_now = state.step % config.validate_every == 0 or state.step == config.steps
        if validate_now or state.step % config.save_every == 0:
            scores = validate(state.average, pairs) if validate_now else {}
            row = log.write(state.step, rate, scores)
            bar.set_postfix(loss=row["loss"], psnr_x4=row["psnr_x4"] or "-")
            state.save(out / "state.pt")
            save_model(state.average, out / "model.safetensors", describe(config, state.step))
    bar.close()
    # Once more: the last run may have been killed between the two.
    save_model(state.average, out / "model.safetensors", describe(config, state.step))
    return out / "model.safetensors"


def train_step(state: TrainState, samples: list[Sample], rate: float, config: TrainConfig) -> float:
    """One step of Adam on a batch; returns its L1 loss. Raises DataError if it is not finite."""
    for group in state.optimizer.param_groups:
        group["lr"] = rate
    loss = batch_loss(state.model, samples, config.precision)
    state.optimizer.zero_grad(set_to_none=True)
    loss.backward()
    norm = torch.nn.utils.clip_grad_norm_(state.model.parameters(), config.clip or float("inf"))
    if not bool(norm.isfinite()) or not bool(loss.isfinite()):
        raise DataError(
            f"Training diverged at step {state.step + 1}; run it again with a lower --rate. "
            "What was saved before is kept."
        )
    state.optimizer.step()
    state.step += 1
    state.update_average(config.ema)
    return loss.item()


def batch_loss(model: GSASR, samples: list[Sample], precision: str) -> torch.Tensor:
    """Mean over the samples of the mean absolute error of the rendered crop."""
    lr = torch.stack([sample.lr for sample in samples])
    scales = torch.tensor([sample.scale for sample in samples])
    with torch.autocast("cpu", torch.bfloat16, enabled=precision == "bfloat16"):
        raw = model(lr, scales)
    losses = []
    if not bool(raw.isfinite().all()):  # a rasterizer would draw these as nothing
        return raw.sum()
    for columns, sample in zip(raw.float(), samples, strict=True):
        gaussians = activate(columns, tuple(sample.lr.shape[1:]))
        rendered = rasterize.render(gaussians, crop_view(sample), backend="cpu")
        losses.append((rendered - sample.hr.permute(1, 2, 0)).abs().mean())
    return torch.stack(losses).mean()


def crop_view(sample: Sample) -> View:
    return View.to_size(tuple(sample.lr.shape[1:]), tuple(sample.hr.shape[1:]))


@torch.inference_mode()
def validate(model: GSASR, pairs: list[Sample]) -> dict[str, float]:
    """Mean PSNR (Y, dB) per scale over the validation pairs, as {"psnr_x2": ...}."""
    from ..predict import predict

    scores: dict[str, list[float]] = {}
    for sample in pairs:
        gaussians = predict(model, sample.lr.permute(1, 2, 0).numpy(), sample.scale)
        rendered = rasterize.render(gaussians, crop_view(sample), backend="cpu").numpy()
        truth = sample.hr.permute(1, 2, 0).numpy()
        score = psnr_y(rendered, truth, border=int(sample.scale))
        scores.setdefault(f"psnr_x{int(sample.scale)}", []).append(score)
    return {name: float(np.mean(values)) for name, values in scores.items()}


def describe(config: TrainConfig, step: int) -> dict[str, str]:
    return {"training": json.dumps(asdict(config)), "step": str(step)}


class Log:
    """log.csv: a row per checkpoint. Rows after the step that a run resumes from are dropped."""

    def __init__(self, path: Path, step: int) -> None:
        self.path = path
        self._rows: list[dict[str, str]] = []
        if path.exists() and step:
            with path.open(newline="") as file:
                rows = list(csv.DictReader(file))
            self._rows = [
                row for row in rows if None not in row.values() and int(row["step"]) <= step
            ]
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
        row["loss"] = f"{np.mean(self._losses):.5f}"
        row["rate"] = f"{rate:.2e}"
        self._losses.clear()
        self._rows.append(row)
        with writing(self.path, DataError) as beside, beside.open("w", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS)
            writer.writeheader()
            writer.writerows(self._rows)
        return row
