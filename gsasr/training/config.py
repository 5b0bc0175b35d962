"""What a training run is made of. Nothing here loads PyTorch, so that `--help` answers at once."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from ..errors import RequestError
from ..processor import DEVICES, PRECISIONS

OPTIMIZERS = ("adam", "muon")


def _setting(default: Any, text: str, choices: tuple[str, ...] | None = None) -> Any:
    """A field with its documentation, which `gsasr train --help` shows too."""
    return field(default=default, metadata={"help": text, "choices": choices})


@dataclass(frozen=True)
class TrainConfig:
    """What is learned, and how: everything that a result depends on. Stored in its checkpoints.

    What each setting means is written beside it. Raises RequestError for impossible ones.
    """

    patch: int = _setting(32, "side of the low-resolution crops, pixels: a multiple of the window")
    batch: int = _setting(8, "crops per step, over all processes")
    scale_min: float = _setting(1.0, "the target scale of a crop is uniform from here")
    scale_max: float = _setting(4.0, "to here; a picture needs sides of at least patch * this")
    steps: int = _setting(20_000, "length of the run; a run may be resumed with another length")
    optimizer: str = _setting(
        "adam", "muon is for the matrices, with adam for the rest", OPTIMIZERS
    )
    rate: float = _setting(1e-3, "learning rate after the warm-up")
    warmup: int = _setting(200, "steps of linear warm-up")
    decay: float = _setting(0.5, "last share of the run, in which the rate falls as half a cosine")
    milestones: tuple[int, ...] = _setting((), "instead of that: the rate is halved at these steps")
    betas: tuple[float, float] = _setting((0.9, 0.99), "of Adam")
    clip: float = _setting(1.0, "largest norm of the gradient; 0: any")
    ema: float = _setting(0.999, "decay of the averaged weights, which are what is evaluated")
    precision: str = _setting("float32", "of the network; weights stay float32", PRECISIONS)
    save_every: int = _setting(200, "steps between checkpoints: what a kill can cost")
    validate_every: int = _setting(1000, "steps between validations")
    seed: int = _setting(0, "of weights and data; a crop depends on (seed, step, place) alone")

    def __post_init__(self) -> None:
        if not 1 <= self.scale_min <= self.scale_max < float("inf"):
            raise RequestError("Training scales must satisfy 1 <= scale_min <= scale_max.")
        if min(self.patch, self.batch, self.steps, self.save_every, self.validate_every) < 1:
            raise RequestError("patch, batch, steps, save_every and validate_every must be >= 1.")
        if len(self.betas) != 2 or not all(0 <= beta < 1 for beta in self.betas):
            raise RequestError("betas must be two numbers in [0, 1).")
        if not 0 <= self.ema < 1 or min(self.warmup, self.clip, self.seed, *self.milestones, 0) < 0:
            raise RequestError("ema must lie in [0, 1); warmup, clip, seed and milestones be >= 0.")
        if not 0 < self.rate <= 1e30 or not 0 < self.decay <= 1:
            raise RequestError("rate must be above 0, and decay in (0, 1].")
        if self.precision not in PRECISIONS:
            raise RequestError("The precision must be float32 or bfloat16.")
        if self.optimizer not in OPTIMIZERS:
            raise RequestError("The optimizer must be adam or muon.")

    @property
    def largest_crop(self) -> int:
        """Side of the largest ground-truth crop, pixels."""
        return round(self.patch * self.scale_max)

    def rate_at(self, step: int) -> float:
        """Learning rate of step 0, 1, ... `steps` - 1."""
        rate = self.rate * min(1.0, (step + 1) / max(1, self.warmup))
        if self.milestones:
            return rate * 0.5 ** sum(step >= milestone for milestone in self.milestones)
        remaining = (self.steps - step) / max(1.0, self.decay * self.steps)
        return rate * 0.5 * (1 - math.cos(math.pi * min(1.0, remaining)))


@dataclass(frozen=True)
class Execution:
    """How a run is carried out. Changes no result beyond rounding, and may change on resuming."""

    device: str = _setting("auto", "auto: cuda where there is a card", DEVICES)
    workers: int | None = _setting(
        None, "processes that prepare crops; 0: none beside training; default: by the machine"
    )
    cache: float = _setting(4.0, "GiB of decoded pictures that the workers together keep")
    compile: bool = _setting(False, "torch.compile the network; needs a C++ compiler or Triton")
    recompute: bool = _setting(
        False, "gradient checkpointing: much less memory for about a quarter more time"
    )
    tensorboard: bool = _setting(False, "also write curves and pictures for TensorBoard to the run")

    def __post_init__(self) -> None:
        if self.device not in DEVICES:
            raise RequestError("The device must be auto, cpu or cuda.")
        if (self.workers or 0) < 0 or not 0 <= self.cache < float("inf"):
            raise RequestError("workers and cache must not be negative.")


ORDINARY = Execution()

_PAPER = TrainConfig(
    patch=48,
    batch=64,
    scale_min=1.0,
    scale_max=4.0,
    steps=500_000,
    optimizer="adam",
    rate=2e-4,
    warmup=2000,
    milestones=(250_000, 400_000, 450_000, 475_000),
    betas=(0.9, 0.99),
    clip=0.0,
    ema=0.999,
    precision="float32",
    save_every=1000,
    validate_every=10_000,
)

RECIPES = {
    # Sec. 4.1 of the paper; the ground-truth crop is 48s x 48s.
    "paper": _PAPER,
    # For the largest backbone.
    "large": TrainConfig(
        **vars(_PAPER) | {"patch": 64, "scale_max": 16.0, "precision": "bfloat16"}
    ),
    # Ours: two hours on a core of a CPU with bfloat16 instructions.
    "lite": TrainConfig(steps=22_000, optimizer="muon", decay=0.4, precision="bfloat16"),
}

NETWORK_RECIPES = {
    "lite": "lite",
    "edsr-baseline": "paper",
    "edsr-paper": "paper",
    "rdn-paper": "paper",
    "swinir-paper": "paper",
    "edsr-div2k": "paper",
    "edsr-df2k": "paper",
    "rdn-div2k": "paper",
    "rdn-df2k": "paper",
    "swinir-div2k": "paper",
    "swinir-df2k": "paper",
    "hatl-sa1b": "large",
}
"""The recipe of each network, where no other is asked for."""


def recipe(network: str, name: str | None = None) -> TrainConfig:
    """The recipe of this name, or without one that of the network."""
    name = name or NETWORK_RECIPES[network]
    if name not in RECIPES:
        raise RequestError(f"Unknown recipe {name}; use one of {', '.join(RECIPES)}.")
    return RECIPES[name]
