"""Time prediction, beside the straightforward formulation of the network, and CPU rendering.

    python benchmarks/predict.py --models lite edsr-baseline

Prints markdown tables of medians. "network" is encoder and decoder on one square of noise; where
a model has no shipped weights they are random, which changes no time. The difference is the
largest of any raw output to the straightforward float32 one. Machines are noisy: compare ratios.
"""

from __future__ import annotations

import argparse

import numpy as np
import torch
from measure import machine, median_seconds, peak_memory
from straightforward import straightforward

from gsasr import image, rasterize
from gsasr.files import shipped
from gsasr.model import GSASR, PRESETS, load_model
from gsasr.model.checkpoint import SHIPPED
from gsasr.prediction import predict
from gsasr.processor import PRECISIONS
from gsasr.view import View


def main() -> None:
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument("--models", nargs="+", default=["lite", "edsr-baseline"])
    options.add_argument("--side", type=int, default=96, help="of the square of noise, pixels")
    options.add_argument("--repeats", type=int, default=5)
    arguments = options.parse_args()
    print(machine(), end="\n\n")
    print("| network | side | precision | formulation | median, s | Mpx/s | ratio | memory, MiB "
          "| difference |")  # fmt: skip
    print("|---|---|---|---|---|---|---|---|---|")
    for name in arguments.models:
        network(name, arguments.side, arguments.repeats)
    pipeline(arguments.models[0], arguments.repeats)


def network(name: str, side: int, repeats: int) -> None:
    """Rows of one network: both formulations in both precisions."""
    torch.manual_seed(0)
    model = load_model(name) if name in SHIPPED else GSASR(PRESETS[name], name).eval()
    side = -(-side // model.multiple) * model.multiple
    lr = torch.rand(1, 3, side, side)

    def ours(precision: str) -> torch.Tensor:
        with torch.autocast("cpu", torch.bfloat16, enabled=precision == "bfloat16"):
            return model(lr, 4.0)

    def theirs(precision: str) -> torch.Tensor:
        with straightforward(model):
            return ours(precision)

    exact = slow = None
    for label, work in (("straightforward", theirs), ("ours", torch.inference_mode()(ours))):
        layout = torch.channels_last if label == "ours" else torch.contiguous_format
        model.to(memory_format=layout)
        lr = lr.contiguous(memory_format=layout)
        for precision in PRECISIONS:
            raw = work(precision).float()
            exact = raw if exact is None else exact
            memory = peak_memory(lambda w=work, p=precision: w(p))
            seconds = median_seconds(lambda w=work, p=precision: w(p), repeats)
            slow = slow or seconds
            print(
                f"| {name} | {side} | {precision} | {label} | {seconds:.2f} "
                f"| {side * side / seconds / 1e6:.4f} | {slow / seconds:.2f} "
                f"| {memory / 2**20:.0f} | {float((raw - exact).abs().max()):.1e} |",
                flush=True,
            )


def pipeline(name: str, repeats: int) -> None:
    """A photograph, from pixels to Gaussians and back, tiles and halo and all."""
    model = load_model(name)
    picture = image.read(shipped("assets/images/astronaut.png")).color
    height, width = picture.shape[:2]
    print(f"\n| {name}, {width}x{height} | median | rate |\n|---|---|---|")
    fields = {}
    for precision in PRECISIONS:
        seconds = median_seconds(lambda p=precision: predict(model, picture, precision=p), repeats)
        fields[precision] = predict(model, picture, precision=precision)
        rate = height * width / seconds / 1e6
        print(f"| predict, {precision} | {seconds:.2f} s | {rate:.3f} source Mpx/s |")
    field = fields["float32"]
    for scale in (2, 4, 8):
        view = View.at_scale(field.size, scale)
        for quality in ("screen", "export"):
            seconds = median_seconds(
                lambda v=view, q=quality: rasterize.render(field, v, "cpu", q), repeats
            )
            rate = view.size[0] * view.size[1] / seconds / 1e6
            label = f"render x{scale}, cpu, {quality}"
            print(f"| {label} | {1e3 * seconds:.0f} ms | {rate:.1f} output Mpx/s |")
    view = View.at_scale(field.size, 4)
    exact, rough = (rasterize.render(f, view, "cpu").numpy() for f in fields.values())
    error = -10 * np.log10(np.mean((exact - rough) ** 2))
    print(f"\nA x4 render of what bfloat16 predicts has a PSNR of {error:.1f} dB to float32's.")


if __name__ == "__main__":
    main()
