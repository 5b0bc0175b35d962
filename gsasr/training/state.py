"""Everything a run needs to go on after a kill, in one file that is replaced at once."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from ..errors import CheckpointError, DataError
from ..files import writing
from ..model import GSASR
from .config import TrainConfig
from .optimizer import make_optimizer


@dataclass
class TrainState:
    """model: the weights being trained. average: their exponential moving average."""

    model: GSASR
    average: GSASR
    optimizer: Any
    step: int = 0

    @staticmethod
    def fresh(model: GSASR, config: TrainConfig) -> TrainState:
        """Step 0 of a run with this network, which is set to the layout that trains fastest."""
        model = model.to(memory_format=torch.channels_last)  # a tenth of a step on a CPU
        average = copy.deepcopy(model).eval().requires_grad_(False)
        return TrainState(model, average, make_optimizer(model, config.optimizer, config.betas))

    def update_average(self, decay: float) -> None:
        """Move the average towards the model; faster at first, when there is nothing to keep."""
        decay = min(decay, (1 + self.step) / (10 + self.step))
        with torch.no_grad():
            for mean, value in zip(self.average.parameters(), self.model.parameters(), strict=True):
                mean.lerp_(value, 1 - decay)

    def save(self, path: Path) -> None:
        """Raises DataError if the disk is full or the folder is gone; the old file stays."""
        parts = {
            "model": self.model.state_dict(),
            "average": self.average.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "step": self.step,
        }
        write_parts(parts, path)

    def restore(self, parts: dict[str, Any], path: Path) -> None:
        """Go on from the parts of the file `path`. Raises CheckpointError if they do not fit."""
        betas = [group.get("betas") for group in self.optimizer.param_groups]
        try:
            self.model.load_state_dict(parts["model"])
            self.average.load_state_dict(parts["average"])
            if "optimizer" in parts:  # `pack` may leave it out
                self.optimizer.load_state_dict(parts["optimizer"])
            for group, ours in zip(self.optimizer.param_groups, betas, strict=True):
                if ours:  # those of this run, not of the one that wrote the file
                    group["betas"] = ours
            self.step = int(parts["step"])
        except Exception as error:  # any damage: the keys, the shapes
            raise CheckpointError(
                f"{path} does not fit this network and optimizer; resume with those it was made "
                "with, or use another --out."
            ) from error


def write_parts(parts: dict[str, Any], path: Path) -> None:
    """Replace the file at once. Raises DataError; the old file stays."""
    with writing(path, DataError) as beside, beside.open("wb") as file:
        try:
            torch.save(parts, file)
        except RuntimeError as error:  # of torch, on top of what the system said
            if isinstance(error.__context__, OSError):
                raise error.__context__ from None
            raise OSError(str(error).splitlines()[0]) from error


def read_parts(path: Path) -> dict[str, Any]:
    """What `save` wrote, on the CPU. Raises CheckpointError if the file is damaged."""
    try:
        parts = torch.load(path, map_location="cpu", weights_only=True)
        if not parts.keys() >= {"model", "average", "step"}:
            raise KeyError("parts")
        return parts
    except Exception as error:  # any damage of a pickle, or something else in it
        raise CheckpointError(f"{path} is damaged; delete it or use another --out.") from error
