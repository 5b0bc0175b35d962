"""Time prediction and CPU rendering of a model, as medians: python benchmarks/predict.py.

Prints a markdown table. Machines are noisy: compare ratios within one run.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import torch

from gsasr import image, rasterize
from gsasr.files import shipped
from gsasr.model import load_model
from gsasr.predict import predict
from gsasr.view import View


def median_seconds(work: Callable[[], object], repeats: int) -> float:
    """Median wall time of `repeats` calls, after one that is not counted."""
    work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--model", default="lite")
    options.add_argument("--repeats", type=int, default=5)
    arguments = options.parse_args()
    model = load_model(arguments.model)
    picture = image.read(shipped("assets/images/astronaut.png")).color
    height, width = picture.shape[:2]

    seconds = median_seconds(lambda: predict(model, picture, 4.0), arguments.repeats)
    field = predict(model, picture, 4.0)
    print(f"{model.name}, {width}x{height}, {torch.get_num_threads()} threads\n")
    print("| step | median | rate |\n|---|---|---|")
    rate = height * width / seconds / 1e6
    print(f"| predict, {len(field):,} Gaussians | {seconds:.2f} s | {rate:.3f} source Mpx/s |")
    for scale in (2, 4, 8):
        view = View.at_scale(field.size, scale)
        for quality in ("screen", "export"):
            seconds = median_seconds(
                lambda v=view, q=quality: rasterize.render(field, v, "cpu", q), arguments.repeats
            )
            rate = view.size[0] * view.size[1] / seconds / 1e6
            label = f"render x{scale}, cpu, {quality}"
            print(f"| {label} | {1e3 * seconds:.0f} ms | {rate:.1f} output Mpx/s |")


if __name__ == "__main__":
    main()
