"""One process or many: who takes part in a run, as `torchrun` says in the environment."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import Any

import torch
import torch.distributed as dist

from ..errors import BackendError, DataError, RequestError
from ..processor import chosen_device

PLACE = {"WORLD_SIZE": "1", "RANK": "0", "LOCAL_RANK": "0"}  # of torchrun, with what lone runs have
PATIENCE = timedelta(hours=1)  # how long the others wait while the first one validates


@dataclass(frozen=True)
class Group:
    """The processes of a run. device: of this one. rank: its number. size: how many there are."""

    device: torch.device
    rank: int = 0
    size: int = 1

    @property
    def leads(self) -> bool:
        """Is this the one that writes, validates and talks?"""
        return self.rank == 0

    def share(self, batch: int) -> range:
        """Which samples of a batch are this process's. Raises RequestError if they are uneven."""
        if batch % self.size:
            raise RequestError(
                f"The batch of {batch} cannot be shared by {self.size} processes; "
                f"use a multiple of {self.size} for --batch."
            )
        each = batch // self.size
        return range(self.rank * each, (self.rank + 1) * each)

    def mean(self, value: torch.Tensor) -> torch.Tensor:
        """Mean of a tensor over the processes."""
        if self.size > 1:
            dist.all_reduce(value)
            value /= self.size
        return value

    def from_leader(self, value: Any) -> Any:
        """What the leader passes, in every process."""
        if self.size > 1:
            box = [value]
            dist.broadcast_object_list(box, device=self.device)
            return box[0]
        return value

    def all(self, values: list) -> list:
        """The lists of all processes as one, in every process."""
        if self.size > 1:
            parts: list[list] = [[]] * self.size
            dist.all_gather_object(parts, values)
            return [value for part in parts for value in part]
        return values


@contextmanager
def joined(device: str) -> Iterator[Group]:
    """The group that this process belongs to, alone unless started by `torchrun`.

    device: "auto", "cpu" or "cuda"; of several cards each process takes the one of its local rank.

    Raises BackendError where there is no such device, DataError if another process of the group
    stops; what it says itself is the reason.
    """
    try:
        size, rank, local = (int(os.environ.get(n, d)) for n, d in PLACE.items())
    except ValueError as error:
        raise RequestError(f"{', '.join(PLACE)} must be numbers; let torchrun set them.") from error
    if size > 1 and "MASTER_ADDR" not in os.environ:
        raise RequestError("WORLD_SIZE is set without MASTER_ADDR; start the run by torchrun.")
    chosen = _device(device, local)
    if size == 1:
        yield Group(chosen)
        return
    try:
        backend = "nccl" if chosen.type == "cuda" else "gloo"
        dist.init_process_group(backend, timeout=PATIENCE, rank=rank, world_size=size)
        yield Group(chosen, rank, size)
        dist.barrier()  # nobody leaves while another one still needs an answer
        dist.destroy_process_group()
    except RuntimeError as error:
        if isinstance(error, dist.DistError) or "onnection" in str(error):
            raise DataError("Another process of this run has stopped; see what it said.") from error
        raise


def _device(name: str, local_rank: int) -> torch.device:
    if chosen_device(name) == "cpu":
        return torch.device("cpu")
    cards = torch.cuda.device_count()
    if local_rank >= cards:
        raise BackendError(f"There are {cards} cards; start at most {cards} processes here.")
    torch.cuda.set_device(local_rank)
    return torch.device("cuda", local_rank)
