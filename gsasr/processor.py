"""What computes: devices and precisions by name, and how many cores there are.

PyTorch is loaded only when a device is chosen, so that the commands' help answers at once.
"""

from __future__ import annotations

import os

from .errors import BackendError

DEVICES = ("auto", "cpu", "cuda")
PRECISIONS = ("float32", "bfloat16")


def cores() -> int:
    """Processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def chosen_device(name: str) -> str:
    """ "cpu" or "cuda" for one of DEVICES; "auto" is a card if PyTorch has one.

    Raises BackendError for "cuda" without a card.
    """
    import torch

    there = torch.cuda.is_available()
    if name == "cuda" and not there:
        raise BackendError("PyTorch finds no NVIDIA GPU; use --device cpu.")
    return ("cuda" if there else "cpu") if name == "auto" else name
