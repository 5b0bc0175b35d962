"""Samples per second of training: the loader alone, the network alone, and both together.

    python benchmarks/train.py --data DATA --preset edsr-baseline --precision bfloat16

"Both" close to "network alone" means that the loader keeps it busy. Takes the settings of
`gsasr train`; prints a markdown table.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Iterator
from pathlib import Path

import torch

from gsasr.training.config import Execution, recipe
from gsasr.training.data import CropSampler
from gsasr.training.loader import Batch, load_batches
from gsasr.training.loop import starting_state, train_step
from gsasr.training.network import trainable
from gsasr.training.parallel import Group, joined

WARM_UP = 5  # steps that are not counted: workers start, kernels are chosen


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--preset", default="lite")
    parser.add_argument("--recipe")
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--batch", type=int)
    parser.add_argument("--precision")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--workers", type=int)
    parser.add_argument("--compile", action="store_true")
    parser.add_argument("--recompute", action="store_true")
    options = parser.parse_args()
    changed = {k: v for k in ("batch", "precision") if (v := getattr(options, k)) is not None}
    config = dataclasses.replace(recipe(options.preset, options.recipe), **changed)
    execution = Execution(
        options.device,
        options.workers,
        compile=options.compile,
        recompute=options.recompute,
    )
    with joined(execution.device) as group:
        sampler = CropSampler(options.data, config.patch, (config.scale_min, config.scale_max))
        steps = range(options.steps + WARM_UP)

        def loaded(count: int) -> Iterator[Batch]:
            for each in load_batches(sampler, config, range(count), group, execution):
                if each.failure:
                    raise each.failure
                yield each.batch

        some = list(loaded(8))
        state = starting_state(options.preset, config, group, Path("no such file"))
        network = trainable(state.model, execution, group)

        def learn(batch: Batch) -> None:
            train_step(network, state, batch, config, group)

        figures = {
            "loader alone": rate(loaded(len(steps)), lambda batch: None, group),
            "network alone": rate((some[step % len(some)] for step in steps), learn, group),
            "both": rate(loaded(len(steps)), learn, group),
        }
    device = torch.cuda.get_device_name() if group.device.type == "cuda" else "CPU"
    print(f"{options.preset}, {config.precision}, batch {config.batch}, {device}\n")
    print("| what | samples per second | ms per step |\n|---|---|---|")
    for name, batches in figures.items():
        print(f"| {name} | {batches * config.batch:.1f} | {1000 / batches:.0f} |")
    if group.device.type == "cuda":
        print(f"\npeak of GPU memory: {torch.cuda.max_memory_allocated() / 2**30:.1f} GiB")


def rate(batches: Iterator[Batch], work, group: Group) -> float:
    """Batches per second, after the warm-up."""
    count, start = 0, 0.0
    for number, batch in enumerate(batches):
        if number == WARM_UP:
            _wait(group)
            start = time.perf_counter()
        work(batch)
        count += number >= WARM_UP
    _wait(group)
    return count / (time.perf_counter() - start)


def _wait(group: Group) -> None:
    if group.device.type == "cuda":
        torch.cuda.synchronize()


if __name__ == "__main__":
    main()
