"""The training loop (paper Sec. 4.1): crops, L1 on the rendered crop, averaged weights."""

from __future__ import annotations

import json
import os
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from torch import nn
from tqdm import tqdm

from .. import rasterize
from ..errors import DataError, RequestError
from ..evaluation.metrics import psnr_y
from ..model import GSASR, activate, save_model
from ..model import PRESETS as MODELS
from ..prediction import predict
from ..view import View
from .config import ORDINARY, Execution, TrainConfig
from .data import CropSampler, Sample, validation_samples
from .loader import Batch, load_batches
from .log import Board, Log
from .network import trainable
from .optimizer import set_rate
from .parallel import Group, joined
from .state import TrainState, read_parts

SHOWN = 4  # validation samples whose pictures go to TensorBoard


def train(
    preset: str,
    data: str | os.PathLike,
    out: str | os.PathLike,
    config: TrainConfig,
    valid: str | os.PathLike | None = None,
    execution: Execution = ORDINARY,
) -> Path:
    """Train a preset on the pictures below `data`; returns the file of averaged weights.

    `out` receives model.safetensors (averaged weights with their configuration, for
    `load_model`), state.pt (to go on after a kill: call `train` again) and log.csv.
    valid: folder for validation PSNR, see `validation_samples`; none without it.
    Under `torchrun` every process calls this with the same arguments.

    Raises DataError for unusable data, a full disk or a loss that is not finite, CheckpointError
    for a state of another network.
    """
    out = Path(out)
    multiple = MODELS[preset].multiple
    if config.patch % multiple:
        raise RequestError(f"--patch must be a multiple of {multiple} for {preset}.")
    with joined(execution.device) as group:
        group.share(config.batch)
        sampler = CropSampler(data, config.patch, (config.scale_min, config.scale_max))
        samples = validation_samples(valid) if valid and group.leads else []
        if group.leads:
            _make_folder(out)
        state = starting_state(preset, config, group, out / "state.pt")
        network = trainable(state.model, execution, group)
        record = Record(out, state, config, samples, execution) if group.leads else None
        news = sampler.news if group.leads else []
        sampler.news = []
        for loaded in load_batches(
            sampler, config, range(state.step, config.steps), group, execution
        ):
            news += loaded.news
            if loaded.failure:
                tell(news)
                raise loaded.failure
            loss = train_step(network, state, loaded.batch, config, group)
            saving = state.step % config.save_every == 0 or state.step == config.steps
            validating = state.step % config.validate_every == 0 or state.step == config.steps
            if saving or validating or group.size == 1:
                news = group.all(news)
            if record:
                record.add(loss, news)
                if saving or validating:
                    record.save(validating)
            if saving or validating or group.size == 1:
                news = []
        if record:
            record.close()
    return out / "model.safetensors"


def starting_state(preset: str, config: TrainConfig, group: Group, path: Path) -> TrainState:
    """The state in `path` if there is one, else a fresh one; the same in every process."""
    torch.manual_seed(config.seed)
    state = TrainState.fresh(GSASR(MODELS[preset], preset).train().to(group.device), config)
    parts = group.from_leader(read_parts(path) if group.leads and path.exists() else None)
    if parts is not None:
        state.restore(parts, path)
    return state


def train_step(
    network: nn.Module, state: TrainState, batch: Batch, config: TrainConfig, group: Group
) -> float:
    """One step on this process's share of a batch; returns the L1 loss of the whole batch.

    Raises DataError, in every process, if loss or gradient are not finite.
    """
    set_rate(state.optimizer, config.rate_at(state.step))
    loss = batch_loss(network, batch.to(group.device), config.precision)
    state.optimizer.zero_grad(set_to_none=True)
    loss.backward()
    norm = torch.nn.utils.clip_grad_norm_(state.model.parameters(), config.clip or float("inf"))
    loss = group.mean(loss.detach())
    if not bool(norm.isfinite() & loss.isfinite()):
        raise _diverged(state.step + 1)
    state.optimizer.step()
    state.step += 1
    state.update_average(config.ema)
    return loss.item()


def _diverged(step: int) -> DataError:
    return DataError(
        f"Training diverged at step {step}; run it again with a lower --rate. "
        "What was saved before is kept."
    )


def batch_loss(network: nn.Module, batch: Batch, precision: str) -> torch.Tensor:
    """Mean over the samples of the mean absolute error of the rendered crop."""
    device, size = batch.lr.device.type, tuple(batch.lr.shape[2:])
    lr = (batch.lr.float() / 255).contiguous(memory_format=torch.channels_last)
    with torch.autocast(device, torch.bfloat16, enabled=precision == "bfloat16"):
        raw = network(lr, batch.scales)
    raw = raw.float()
    if not bool(raw.isfinite().all()):  # a rasterizer would draw these as nothing
        return raw.sum()
    gaussians = activate(raw.flatten(0, 1), size)
    views = [View.to_size(size, sides) for sides in batch.sizes]
    drawn = rasterize.render_batch(gaussians, [raw.shape[1]] * len(views), views, backend=device)
    errors = [(a - b).abs().mean() for a, b in zip(drawn, batch.truths(), strict=True)]
    return torch.stack(errors).mean()


@torch.no_grad()
def validate(model: GSASR, samples: list[Sample]) -> tuple[dict[str, float], dict[str, np.ndarray]]:
    """Mean PSNR (Y, dB) per scale as {"psnr_x2": ...}, and a few renders beside their truths."""
    scores: dict[str, list[float]] = {}
    shown: dict[str, np.ndarray] = {}
    for number, sample in enumerate(samples):
        lr, truth = (tensor.numpy().astype(np.float32) / 255 for tensor in (sample.lr, sample.hr))
        scale = round(sample.scale)
        gaussians = predict(model, lr, sample.scale)
        view = View.to_size(lr.shape[:2], truth.shape[:2])
        drawn = rasterize.render(gaussians, view, backend=gaussians.mean.device.type).cpu().numpy()
        scores.setdefault(f"psnr_x{scale}", []).append(psnr_y(drawn, truth, border=scale))
        if scale == 4 and len(shown) < SHOWN:
            shown[f"x4/{number // 3}"] = np.concatenate([drawn, truth], axis=1)
    return {name: float(np.mean(values)) for name, values in scores.items()}, shown


class Record:
    """What a run leaves in its folder and says on the terminal; only the leader has one."""

    def __init__(
        self,
        out: Path,
        state: TrainState,
        config: TrainConfig,
        samples: list[Sample],
        execution: Execution,
    ) -> None:
        self.out, self.state, self.config, self.samples = out, state, config, samples
        self._device = next(state.average.parameters()).device
        self._log = Log(out / "log.csv", state.step)
        self._board = Board(out / "tensorboard", state.step) if execution.tensorboard else None
        self._told: set[str] = set()
        self._bar = tqdm(total=config.steps, initial=state.step, unit="step", disable=None)

    def add(self, loss: float, news: list[str]) -> None:
        """A step was done; `news` is said once."""
        tell([line for line in dict.fromkeys(news) if line not in self._told])
        self._told.update(news)
        self._log.loss(loss)
        self._bar.update()

    def save(self, validating: bool) -> None:
        """Raises DataError or CheckpointError if it cannot be written; older files stay.

        So they do where a step made weights that are not finite of gradients that were.
        """
        if not all(bool(value.isfinite().all()) for value in self.state.average.parameters()):
            raise _diverged(self.state.step)
        scores, shown = validate(self.state.average, self.samples) if validating else ({}, {})
        self.state.average.to(self._device)  # prediction gives a card up where memory is short
        row = self._log.write(self.state.step, self.config.rate_at(self.state.step - 1), scores)
        if self._board:
            self._board.pictures(shown, self.state.step)
            self._board.row(row)
        self._bar.set_postfix(loss=row["loss"], psnr_x4=row["psnr_x4"] or "-")
        self.state.save(self.out / "state.pt")
        self._save_model()

    def close(self) -> None:
        self._bar.close()
        if self._board:
            self._board.close()
        self._save_model()  # once more: the last run may have been killed between the two

    def _save_model(self) -> None:
        training = json.dumps(asdict(self.config))
        metadata = {"training": training, "step": str(self.state.step)}
        save_model(self.state.average, self.out / "model.safetensors", metadata)


def tell(news: list[str]) -> None:
    for line in news:
        tqdm.write(line, file=sys.stderr)


def _make_folder(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        for stale in (*out.glob(".state-*.pt"), *out.glob(".model-*.safetensors")):
            stale.unlink()  # half a file of a run that was killed
    except OSError as error:
        raise DataError(f"Cannot write to the folder {out}: {error.strerror}.") from error
