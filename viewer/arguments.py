"""The command line of the viewer."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import NoReturn

from gsasr.errors import RequestError

from .loading import check_path
from .state import CONDITION, LEAST_MEMORY, OVERLAYS, SIGMA, TOLD


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise RequestError(f"{message[:1].upper()}{message[1:]}; see gsasr-viewer --help.")


def parse(argv: list[str] | None = None) -> argparse.Namespace:
    """The options. Raises RequestError, ImageError or FieldError for what makes no sense."""
    parser = _Parser(
        prog="gsasr-viewer",
        description="Open a picture, or Gaussians saved from one, and zoom into it.",
    )
    parser.add_argument("file", nargs="?", help="a picture, or a .safetensors file of Gaussians")
    parser.add_argument("--model", default="lite", metavar="NAME|FILE", help="the network (lite)")
    parser.add_argument(
        "--condition",
        type=_number,
        default=TOLD,
        metavar="SCALE",
        help=f"scale that the network is told, {CONDITION[0]:g} to {CONDITION[1]:g} ({TOLD:g})",
    )
    parser.add_argument(
        "--size", type=_size, default=(1280, 800), metavar="WxH", help="of the window or snapshot"
    )
    parser.add_argument(
        "--gpu-memory",
        type=_bytes,
        metavar="SIZE",
        help="of Gaussians on the GPU: 512M, 2G (most of what the driver says is free)",
    )
    group = parser.add_argument_group("without a window")
    group.add_argument("--snapshot", type=Path, metavar="OUT.png", help="render a view to a file")
    group.add_argument("--zoom", type=_number, help="output pixels per picture pixel (fit)")
    group.add_argument("--center", type=_point, metavar="X,Y", help="picture pixels (its middle)")
    group.add_argument("--overlay", choices=OVERLAYS, default="none")
    group.add_argument("--sigma", type=_number, default=2.0, help="size of the ellipses (2)")
    options = parser.parse_args(argv)
    _check(options)
    return options


def _check(options: argparse.Namespace) -> None:
    if not CONDITION[0] <= options.condition <= CONDITION[1]:
        raise RequestError(
            f"The scale of --condition must be {CONDITION[0]:g} to {CONDITION[1]:g}."
        )
    if not SIGMA[0] <= options.sigma <= SIGMA[1]:
        raise RequestError(f"The size of --sigma must be {SIGMA[0]:g} to {SIGMA[1]:g}.")
    if options.zoom is not None and options.zoom <= 0:
        raise RequestError(f"The scale of --zoom must be above 0, but is {options.zoom:g}.")
    if options.file is not None:
        check_path(Path(options.file))
    elif options.snapshot is not None:
        raise RequestError("Give the picture that --snapshot should show.")


def _number(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError
    return value


def _bytes(text: str) -> int:
    unit = {"M": 1 << 20, "G": 1 << 30}.get(text[-1:].upper())
    if unit is None:
        raise ValueError
    size = _number(text[:-1]) * unit
    if not LEAST_MEMORY <= size < math.inf:
        raise ValueError
    return int(size)


def _size(text: str) -> tuple[int, int]:
    width, height = (int(side) for side in text.lower().split("x"))
    if not (1 <= width <= 16384 and 1 <= height <= 16384):
        raise ValueError
    return width, height


def _point(text: str) -> tuple[float, float]:
    x, y = (_number(value) for value in text.split(","))
    return x, y


_number.__name__, _bytes.__name__, _size.__name__ = "number", "size", "WxH"
_point.__name__ = "X,Y"
