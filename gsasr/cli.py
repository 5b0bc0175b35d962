"""The `gsasr` command."""

from __future__ import annotations

import argparse
import dataclasses
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path
from typing import NoReturn

from .errors import GsasrError, RequestError
from .memory import out_of_memory, require_picture
from .processor import DEVICES, PRECISIONS, chosen_device
from .rasterize import BACKENDS
from .training.commands import add_commands

MODEL = "name of a model, its .safetensors file, or folder with encoder.pth and decoder.pth"


def main(arguments: list[str] | None = None) -> int:
    """Run one command; returns the exit code: 0 for success, 2 for a user's mistake."""
    options = parser().parse_args(arguments)
    if threading.current_thread() is threading.main_thread():
        # As for Ctrl+C: clean up behind a file that is being written.
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    warnings.showwarning = lambda message, *_: print(f"gsasr: {message}", file=sys.stderr)
    try:
        options.run(options)
    except GsasrError as error:
        print(f"gsasr: {error}", file=sys.stderr)
        return 2
    except (MemoryError, RuntimeError) as error:
        if not out_of_memory(error):
            raise
        print("gsasr: Not enough memory; use a smaller scale or a region.", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("gsasr: stopped.", file=sys.stderr)
        return 130
    except BrokenPipeError:  # such as `gsasr doctor | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    return 0


def upscale(options: argparse.Namespace) -> None:
    from . import image
    from .model import load_model
    from .picture import resample_alpha, upscale
    from .rasterize import require_backend
    from .view import View

    image.check_output(options.output)
    require_backend(options.backend)
    picture = image.read(options.input)
    view = View.at_scale(picture.size, options.scale)
    require_picture(view.size)
    image.check_output(options.output, view.size, alpha=picture.alpha is not None)
    model = load_model(options.model).to(chosen_device(options.device))
    with progress("upscaling") as told:
        color = upscale(
            model,
            picture.color,
            view,
            options.condition,
            options.backend,
            precision=options.precision,
            antialias=options.antialias,
            progress=told,
            **given_tile(options),
        )
    alpha = None if picture.alpha is None else resample_alpha(picture.alpha, view)
    image.write(options.output, color, like=picture, alpha=alpha)


def predict(options: argparse.Namespace) -> None:
    from . import image
    from .errors import FieldError
    from .files import check_writable
    from .model import load_model
    from .prediction import predict

    if options.output.suffix != ".safetensors":
        raise FieldError(f"{options.output} must end in .safetensors.")
    check_writable(options.output, FieldError)
    picture = image.read(options.input)
    model = load_model(options.model).to(chosen_device(options.device))
    with progress("predicting") as told:
        field = predict(
            model,
            picture.color,
            options.scale,
            precision=options.precision,
            progress=told,
            **given_tile(options),
        )
    dataclasses.replace(field, source=picture.source).save(options.output)


def render(options: argparse.Namespace) -> None:
    from . import image
    from .gaussians import Gaussians
    from .picture import render

    image.check_output(options.output)
    field = Gaussians.load(options.input)
    view = chosen_view(field.size, options.scale, options.size, options.region)
    image.check_output(options.output, view.size)
    with progress("rendering") as told:
        color = render(
            field,
            view=view,
            backend=options.backend,
            antialias=options.antialias,
            progress=told,
        )
    image.write(options.output, color)


def info(options: argparse.Namespace) -> None:
    from .describe import describe

    for name, value in describe(options.input).items():
        print(f"{name + ':':<22} {value}")


def doctor(options: argparse.Namespace) -> None:
    from .doctor import report

    report()


def convert(options: argparse.Namespace) -> None:
    from .errors import CheckpointError
    from .files import check_writable
    from .model import load_model, save_model

    if options.output.suffix != ".safetensors":
        raise CheckpointError(f"{options.output} must end in .safetensors.")
    check_writable(options.output, CheckpointError)
    save_model(load_model(options.input), options.output, half=options.half)


def evaluate(options: argparse.Namespace) -> None:
    from .evaluation.benchmark import benchmark, table
    from .model import load_model

    model = load_model(options.model).to(chosen_device(options.device))
    for folder in options.folders:
        with progress(folder.name) as told:
            scores = benchmark(
                model, folder, tuple(options.scales), options.backend, options.precision, told
            )
        print(f"{folder.name}: PSNR dB / SSIM on Y, {model.name}\n")
        print(table(scores, options.per_image), end="\n\n")


def given_tile(options: argparse.Namespace) -> dict[str, int]:
    """--tile as a keyword argument, if it was given."""
    return {"tile": options.tile} if "tile" in options else {}


def chosen_view(
    image_size: tuple[int, int],
    scale: float | None,
    size: tuple[int, int] | None,
    region: tuple[float, float, float, float] | None,
):
    """The View for --scale or --size (height, width), of the whole picture or of --region."""
    from .view import View

    if (scale is None) == (size is None):
        raise RequestError("Give either --scale or --size.")
    region = region or (0.0, 0.0, float(image_size[1]), float(image_size[0]))
    if scale is not None:
        return View.region_at_scale(region, scale)
    return View.region_to_size(region, size)


def positive(text: str) -> float:
    value = float(text)
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"must be a number above 0, but is {text}")
    return value


def size(text: str) -> tuple[int, int]:
    """WxH -> (height, width)."""
    width, _, height = text.lower().partition("x")
    try:
        pair = int(height), int(width)
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be WxH, such as 1280x720, not {text}") from None
    if min(pair) < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1x1, not {text}")
    return pair


def region(text: str) -> tuple[float, float, float, float]:
    """X,Y,W,H in source pixels."""
    try:
        x, y, width, height = (float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be X,Y,W,H in source pixels, not {text}") from None
    return x, y, width, height


@contextmanager
def progress(label: str):
    """A bar on stderr, fed with the share done; silent when that is no terminal."""
    from tqdm import tqdm

    with tqdm(total=1.0, desc=label, disable=None, bar_format="{l_bar}{bar}| {elapsed}") as bar:

        def told(share: float) -> None:
            bar.update(share - bar.n)

        yield told


class OneLineParser(argparse.ArgumentParser):
    """Says what is wrong with the arguments in one line, without the usage before it."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message}; see {self.prog} --help\n")


def parser() -> argparse.ArgumentParser:
    top = OneLineParser(
        prog="gsasr", description="Pictures as 2D Gaussians, rendered at any scale."
    )
    commands = top.add_subparsers(required=True, metavar="COMMAND")

    def command(run: Callable[[argparse.Namespace], None], help: str) -> argparse.ArgumentParser:
        added = commands.add_parser(
            run.__name__,
            help=help,
            description=help,
            formatter_class=argparse.ArgumentDefaultsHelpFormatter,
        )
        added.set_defaults(run=run)
        return added

    def add_model(command: argparse.ArgumentParser) -> None:
        command.add_argument("--model", default="lite", help=MODEL)

    def add_prediction(command: argparse.ArgumentParser) -> None:
        command.add_argument(
            "--precision",
            choices=PRECISIONS,
            default="float32",
            help="of the network; bfloat16 is faster where the processor has it",
        )
        command.add_argument("--device", choices=DEVICES, default="auto", help="of the network")

    def add_tile(command: argparse.ArgumentParser) -> None:
        command.add_argument(
            "--tile",
            type=int,
            default=argparse.SUPPRESS,
            help="pixels along the side of a tile, which bounds the memory",
        )

    def add_backend(command: argparse.ArgumentParser) -> None:
        command.add_argument(
            "--backend", choices=("auto", *BACKENDS), default="auto", help="rasterizer"
        )

    def add_antialias(command: argparse.ArgumentParser) -> None:
        command.add_argument(
            "--antialias",
            action="store_true",
            help="integrate over each pixel instead of sampling at its centre; for scales below 1",
        )

    def add_output(command: argparse.ArgumentParser, help: str) -> None:
        command.add_argument("-o", "--output", type=Path, required=True, help=help)

    c = command(upscale, "enlarge a picture by any factor")
    c.add_argument("input", type=Path, help="picture")
    add_output(c, "picture to write (.png, .tif, .jpg, .webp)")
    c.add_argument("--scale", type=positive, required=True, help="factor, any number above 0")
    c.add_argument(
        "--condition", type=positive, help="scale told to the network; default --scale within 1..4"
    )
    add_model(c)
    add_prediction(c)
    add_tile(c)
    add_backend(c)
    add_antialias(c)

    c = command(predict, "turn a picture into Gaussians")
    c.add_argument("input", type=Path, help="picture")
    add_output(c, "file of Gaussians to write (.safetensors)")
    c.add_argument("--scale", type=positive, default=3.0, help="scale told to the network")
    add_model(c)
    add_prediction(c)
    add_tile(c)

    c = command(render, "draw a file of Gaussians")
    c.add_argument("input", type=Path, help="file of Gaussians")
    add_output(c, "picture to write")
    c.add_argument("--scale", type=positive, help="output pixels per source pixel")
    c.add_argument("--size", type=size, metavar="WxH", help="output size in pixels")
    c.add_argument("--region", type=region, metavar="X,Y,W,H", help="part to draw, source pixels")
    add_backend(c)
    add_antialias(c)

    c = command(info, "say what is in a picture, a file of Gaussians or a model")
    c.add_argument("input", type=Path, help="file")

    command(doctor, "say what this machine has, and what to do about what is missing")

    c = command(convert, "write a model as one .safetensors file")
    c.add_argument("input", help=MODEL)
    add_output(c, "model to write (.safetensors)")
    c.add_argument("--half", action="store_true", help="weights as float16, in half the space")

    c = command(evaluate, "measure PSNR and SSIM on benchmark folders")
    c.add_argument("folders", type=Path, nargs="+", help="folder with HR/ and LR/x2, LR/x3, ...")
    c.add_argument("--scales", type=int, nargs="+", default=[2, 3, 4], help="integer scales")
    c.add_argument("--per-image", action="store_true", help="a row for each picture")
    add_model(c)
    add_prediction(c)
    add_backend(c)

    add_commands(commands)
    return top


if __name__ == "__main__":
    sys.exit(main())
