"""Everything a run needs to go on after a kill, in one file that is replaced at once."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from pathlib import Path

import torch

from ..errors import CheckpointError, DataError
from ..files import writing
from ..model import GSASR


@dataclass
class TrainState:
    """model: the weights being trained. average: their exponential moving average."""

    model: GSASR
    average: GSASR
    optimizer: torch.optim.Optimizer
    step: int = 0

    @staticmethod
    def fresh(model: GSASR, betas: tuple[float, float]) -> TrainState:
        optimizer = torch.optim.Adam(model.parameters(), lr=0.0, betas=betas)
        return TrainState(model, copy.deepcopy(model).eval(), optimizer)

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
        with writing(path, DataError) as beside:
            try:
                torch.save(parts, beside)
            except RuntimeError as error:  # how torch reports a failed write
                raise OSError(str(error).splitlines()[0]) from error

    def load(self, path: Path) -> None:
        """Go on from a file that `save` wrote. Raises CheckpointError if it does not fit."""
        try:
            parts = torch.load(path, map_location="cpu", weights_only=True)
            self.model.load_state_dict(parts["model"])
            self.average.load_state_dict(parts["average"])
            self.optimizer.load_state_dict(parts["optimizer"])
            self.step = int(parts["step"])
        except Exception as error:  # any damage: the pickle, the keys, the shapes
            raise CheckpointError(
                f"{path} does not fit this network; resume with its preset or use another --out."
            ) from error
