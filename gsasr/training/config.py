"""What a training run is made of."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ..errors import RequestError


@dataclass(frozen=True)
class TrainConfig:
    """Settings of one run; stored in its checkpoints.

    patch: side of the low-resolution crop, pixels, a multiple of the network's window.
    batch: crops per step.
    scale_min, scale_max: the target scale of each crop is uniform in this range.
    steps: length of the run. A run that is resumed may be given another length.
    rate: Adam learning rate after `warmup` steps of linear warm-up.
    decay: the last share of the run, over which the rate falls to zero as half a cosine.
    milestones: if given, the rate is halved at these steps instead (the paper's schedule).
    betas: of Adam. clip: largest gradient norm, 0: no clipping. ema: decay of averaged weights.
    precision: of the network's forward pass and activations, "float32" or "bfloat16" (autocast;
        about 1.5 times as fast on a CPU with bfloat16 instructions). Weights stay float32.
    save_every, validate_every: steps between checkpoints and between validations.
    seed: of the weights and the data; the data of a step depends on (seed, step) alone.
    """

    patch: int = 32
    batch: int = 8
    scale_min: float = 1.0
    scale_max: float = 4.0
    steps: int = 20_000
    rate: float = 1e-3
    warmup: int = 200
    decay: float = 0.5
    milestones: tuple[int, ...] = ()
    betas: tuple[float, float] = (0.9, 0.99)
    clip: float = 1.0
    ema: float = 0.999
    precision: str = "float32"
    save_every: int = 200
    validate_every: int = 1000
    seed: int = 0

    def __post_init__(self) -> None:
        if not 1 <= self.scale_min <= self.scale_max:
            raise RequestError("Training scales must satisfy 1 <= scale_min <= scale_max.")
        if min(self.patch, self.batch, self.steps, self.save_every, self.validate_every) < 1:
            raise RequestError("patch, batch, steps, save_every and validate_every must be >= 1.")
        if len(self.betas) != 2 or not all(0 <= beta < 1 for beta in self.betas):
            raise RequestError("betas must be two numbers in [0, 1).")
        if not 0 <= self.ema < 1 or min(self.warmup, self.clip, self.seed, *self.milestones, 0) < 0:
            raise RequestError("ema must lie in [0, 1); warmup, clip, seed and milestones be >= 0.")
        if not 0 < self.rate < float("inf") or not 0 < self.decay <= 1:
            raise RequestError("rate must be above 0, and decay in (0, 1].")
        if self.precision not in ("float32", "bfloat16"):
            raise RequestError("The precision must be float32 or bfloat16.")

    def rate_at(self, step: int) -> float:
        """Learning rate of step 0, 1, ... `steps` - 1."""
        rate = self.rate * min(1.0, (step + 1) / max(1, self.warmup))
        if self.milestones:
            return rate * 0.5 ** sum(step >= milestone for milestone in self.milestones)
        remaining = (self.steps - step) / max(1.0, self.decay * self.steps)
        return rate * 0.5 * (1 - math.cos(math.pi * min(1.0, remaining)))


PRESETS = {
    # Paper Sec. 4.1; the crop is 48s x 48s with s uniform in [1, 4].
    "edsr-baseline": TrainConfig(
        patch=48,
        batch=64,
        steps=500_000,
        rate=2e-4,
        warmup=2000,
        milestones=(250_000, 400_000, 450_000, 475_000),
        clip=0.0,
        save_every=1000,
        validate_every=5000,
    ),
    "lite": TrainConfig(),
}
