"""Time the differentiable rasterizers, and the paper's algorithm beside them.

    python benchmarks/rasterize.py --sources 48 180 --scales 2 4

Prints a markdown table. Every source has 16 Gaussians per pixel, with standard deviations of 0.2
to 0.55 source pixels; images and gradients are cut at 5 standard deviations, as in training.

forward, both: medians; "both" is forward and backward. On a card, all steps are in them.
memory: peak of what one forward and backward pass allocate.
evaluations: pairs of a pixel and a Gaussian within 5 standard deviations, by area, per second
    of the forward pass; float32: those times 12 operations, as a share of the card's peak.
gather: pairs that the gather kernel evaluates, inside an ellipse or not, as a share of what the
    card can do. Each needs one exponential; those run on 16 units per multiprocessor, which is
    the narrowest place: the other seven instructions have 128.
paper: Algorithm 1 of the paper with its box of r = 0.1; the ratios are to it. Where its work is
    too long (`--most` steps), it runs on a part of the Gaussians and the time is scaled up.
"""

from __future__ import annotations

import argparse
import math

import torch
from contestants import paper
from fields import plane
from measure import machine, median_seconds, peak_memory

from gsasr.gaussians import Gaussians
from gsasr.rasterize import cuda, footprint, render
from gsasr.rasterize.batch import pictures, views_tensor
from gsasr.view import View

OPERATIONS = 12  # float32 operations of one evaluation
EXPONENTIALS = 16  # per clock and multiprocessor, of every architecture since Turing


def main() -> None:
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument("--sources", type=int, nargs="+", default=[48, 180, 360, 512])
    options.add_argument("--scales", type=float, nargs="+", default=[2, 4, 8, 12])
    options.add_argument("--repeats", type=int, default=5)
    options.add_argument("--most", type=float, default=2e9, help="pixel visits by the paper's loop")
    arguments = options.parse_args()
    device = "cuda" if torch.cuda.is_available() else "cpu"
    print(machine(device), end="\n\n")
    print("| source | scale | Gaussians | backend | forward, ms | both, ms | memory, MiB "
          "| evaluations, G/s | float32 | gather | forward : paper | both : paper |")  # fmt: skip
    print("|---|---|---|---|---|---|---|---|---|---|---|---|")
    for side in arguments.sources:
        field = plane(side, side, 16)
        for scale in arguments.scales:
            view = View.at_scale(field.size, scale)
            baseline = paper_on_card if device == "cuda" else paper_on_host
            slow = baseline(field, view, arguments.most)
            for backend in (device, *(["cpu"] if device == "cuda" and side <= 180 else [])):
                row(field, view, backend, arguments.repeats, slow)
            part = f" ({slow[2]:.1%})" if slow[2] < 1 else ""
            both = f"{slow[1]:.0f}" if slow[1] else "-"
            head = f"| {side}x{side} | {scale:g} | {len(field):,} | paper{part} "
            print(f"{head}| {slow[0]:.0f} | {both} | - | - | - | - | 1 | 1 |", flush=True)


def row(
    field: Gaussians,
    view: View,
    backend: str,
    repeats: int,
    slow: tuple[float, float, float],
) -> None:
    """Print a row of the table. slow: the baseline's forward and both, ms."""
    area = math.pi * field.std.prod(1) * (1 - field.rho**2).sqrt() * math.prod(view.scale)
    field = field.map(lambda tensor: tensor.clone().to(backend).requires_grad_(True))

    def forward() -> torch.Tensor:
        return render(field, view, backend, "gradient")

    def both() -> None:
        forward().sum().backward()

    both()
    memory = peak_memory(both, backend)
    times = [1e3 * median_seconds(work, repeats, backend) for work in (forward, both)]
    rate = footprint.GRADIENT_CUT * float(area.sum()) / times[0] / 1e6  # G/s
    shares = card_shares(field, view, rate) if backend == "cuda" else ("-", "-")
    ratios = [f"{a / b:.1f}" if a else "-" for a, b in zip(slow[:2], times, strict=True)]
    cells = [
        f"{field.size[1]}x{field.size[0]}", f"{view.scale[0]:g}", f"{len(field):,}", backend,
        f"{times[0]:.3g}", f"{times[1]:.3g}", f"{memory / 2**20:.0f}", f"{rate:.2f}",
        *shares, *ratios,
    ]  # fmt: skip
    print(f"| {' | '.join(cells)} |", flush=True)


def card_shares(field: Gaussians, view: View, rate: float) -> tuple[str, str]:
    """Shares of the card's float32 peak, and of its exponentials in the gather kernel alone."""
    properties = torch.cuda.get_device_properties(0)
    units = properties.multi_processor_count
    clock = clock_rate()
    lanes = 64 if (properties.major, properties.minor) in ((7, 5), (8, 0)) else 128
    peak = 2 * lanes * units * clock
    tensors, batch = launch_arguments(field, view)
    pairs, seconds = gather_time(tensors, batch)
    return (
        f"{OPERATIONS * rate * 1e9 / peak:.1%}",
        f"{pairs / seconds / (EXPONENTIALS * units * clock):.0%}",
    )


def clock_rate() -> float:
    """Highest clock of the card, Hz."""
    from cuda.bindings import driver

    attribute = driver.CUdevice_attribute.CU_DEVICE_ATTRIBUTE_CLOCK_RATE
    return 1e3 * driver.cuDeviceGetAttribute(attribute, torch.cuda.current_device())[1]


def launch_arguments(field: Gaussians, view: View) -> tuple[list[torch.Tensor], list]:
    with torch.no_grad():
        cut = footprint.cut(field, "gradient")
        tensors = [field.mean, field.std, field.rho, field.peak, cut]
    batch = pictures(views_tensor([view]), [len(field)], [view.size[0]], [view.size[1]])
    return [tensor.detach() for tensor in tensors], batch


def gather_time(tensors: list[torch.Tensor], batch: list) -> tuple[int, float]:
    """(pairs of pixels and Gaussians, seconds) of the gather kernel within one forward pass."""
    launch = cuda.kernels(tensors[0].device)
    pairs, seconds = 0, 0.0

    def timed(name: str, threads: int, *arguments) -> None:
        nonlocal pairs, seconds
        if name != "gather":
            launch(name, threads, *arguments)
            return
        start, stop = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        start.record()
        launch(name, threads, *arguments)
        stop.record()
        stop.synchronize()
        seconds += start.elapsed_time(stop) / 1e3
        owners, tile = arguments[2], arguments[-2].value
        pairs += len(owners) * tile**2

    for _ in range(3):  # the last counts
        pairs, seconds = 0, 0.0
        cuda.forward(*tensors, batch, timed)
    return pairs, seconds


def paper_on_card(field: Gaussians, view: View, most: float) -> tuple[float, float, float]:
    """Algorithm 1 on the card: ms of forward and both, share of the Gaussians that were drawn."""
    some = paper.sample(field, view, paper.ON_CARD * most)
    card = paper.OnCard(some, view)
    share = len(some) / len(field)
    times = [1e3 * median_seconds(work, 1, "cuda") / share for work in (card.forward, card.both)]
    return (*times, share)


def paper_on_host(field: Gaussians, view: View, most: float) -> tuple[float, float, float]:
    """The same by numba on one core, forward only: (ms, 0, share)."""
    some = paper.sample(field, view, most)
    share = len(some) / len(field)
    return 1e3 * median_seconds(lambda: paper.on_host(some, view), 1) / share, 0.0, share


if __name__ == "__main__":
    main()
