"""Batches of training samples, prepared by other processes while the network learns."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch.utils.data import DataLoader, Dataset

from ..errors import DataError, GsasrError
from .config import Execution, TrainConfig
from .data import CropSampler, Sample
from .parallel import Group
from .processes import default_workers, die_with_parent, fresh_processes


@dataclass(frozen=True)
class Batch:
    """Samples of one size of picture and many sizes of ground truth, in few tensors.

    lr: (B, 3, h, w) uint8. hr: (P, 3) uint8, the pixels of all ground truths, row by row.
    sizes: (height, width) of each ground truth; their products add up to P.
    """

    lr: torch.Tensor
    hr: torch.Tensor
    sizes: tuple[tuple[int, int], ...]

    @staticmethod
    def of(samples: list[Sample]) -> Batch:
        return Batch(
            torch.stack([sample.lr.permute(2, 0, 1) for sample in samples]),
            torch.cat([sample.hr.flatten(0, 1) for sample in samples]),
            tuple(tuple(sample.hr.shape[:2]) for sample in samples),
        )

    @property
    def scales(self) -> torch.Tensor:
        """(B,) float32 on the CPU."""
        return torch.tensor([height / self.lr.shape[2] for height, _ in self.sizes])

    def truths(self) -> list[torch.Tensor]:
        """The ground truths, (H, W, 3) float32 in [0, 1] each."""
        areas = [height * width for height, width in self.sizes]
        pixels = (self.hr.float() / 255).split(areas)
        return [part.view(*size, 3) for part, size in zip(pixels, self.sizes, strict=True)]

    def pin_memory(self) -> Batch:
        return Batch(self.lr.pin_memory(), self.hr.pin_memory(), self.sizes)

    def to(self, device: torch.device) -> Batch:
        """On another device; from pinned memory the copy runs beside the computation."""
        lr, hr = (tensor.to(device, non_blocking=True) for tensor in (self.lr, self.hr))
        return Batch(lr, hr, self.sizes)


@dataclass(frozen=True)
class Loaded:
    """What a worker hands over. news: pictures it left out. failure: why there is no batch."""

    batch: Batch | None
    news: list[str]
    failure: GsasrError | None = None

    def pin_memory(self) -> Loaded:
        return Loaded(self.batch and self.batch.pin_memory(), self.news, self.failure)


class Batches(Dataset):
    """The share of one process of the batch of each step."""

    def __init__(self, sampler: CropSampler, seed: int, share: range) -> None:
        self.sampler, self.seed, self.share = sampler, seed, share

    def __getitem__(self, step: int) -> Loaded:
        batch, failure = None, None
        try:
            batch = Batch.of([self.sampler.sample(self.seed, step, i) for i in self.share])
        except GsasrError as error:  # as a value, since an exception arrives with a traceback
            failure = error
        news, self.sampler.news = self.sampler.news, []
        return Loaded(batch, news, failure)


def load_batches(
    sampler: CropSampler, config: TrainConfig, steps: range, group: Group, execution: Execution
) -> Iterator[Loaded]:
    """This process's share of the batches of these steps, in their order.

    Workers are started from a fresh process: a fork of this one would inherit locks of threads
    (CUDA, numba) that do not exist there. Raises DataError if one of them is killed.
    """
    workers = execution.workers
    if workers is None:
        workers = default_workers(group.device.type, group.size)
    workers = min(workers, len(steps))
    sampler.cache = int(execution.cache * 2**30 / max(1, workers))
    loader = DataLoader(
        Batches(sampler, config.seed, group.share(config.batch)),
        batch_size=None,
        sampler=steps,
        num_workers=workers,
        multiprocessing_context=fresh_processes(__name__) if workers else None,
        worker_init_fn=die_with_parent,
        prefetch_factor=4 if workers else None,
        pin_memory=group.device.type == "cuda",
    )
    try:
        yield from loader
    except RuntimeError as error:
        if "DataLoader worker" not in str(error):
            raise
        raise DataError(
            "A process that prepares crops was stopped, likely for lack of memory; use fewer "
            "--workers (0: none) or a smaller --cache."
        ) from error
