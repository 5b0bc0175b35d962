"""Reading hyper-parameters off the tensors of a state dict."""

from __future__ import annotations

import math

import torch

State = dict[str, torch.Tensor]


def count(state: State, prefix: str) -> int:
    """How many numbered parts `prefix.0`, `prefix.1`, ... there are. Raises KeyError for none."""
    start = len(prefix) + 1
    numbers = {k[start:].split(".")[0] for k in state if k.startswith(prefix + ".")}
    if "0" not in numbers:
        raise KeyError(f"{prefix}.0")
    return sum(number.isdecimal() for number in numbers)


def side(tokens: int) -> int:
    """Side of a square of so many tokens. Raises ValueError if there is no such square."""
    if math.isqrt(tokens) ** 2 != tokens or not tokens:
        raise ValueError(f"{tokens} tokens make no square")
    return math.isqrt(tokens)
