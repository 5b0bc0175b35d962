"""`gsasr train`, `prepare`, `pack` and `unpack`: what they take, and whom they call.

Nothing here loads PyTorch before a command runs.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..processor import cores
from .config import NETWORK_RECIPES, RECIPES, Execution, TrainConfig, recipe

TRAIN = """\
Train a network on a folder of pictures. Each step draws random crops, scales them down, lets the
network turn them into Gaussians, draws these at the scale of the crop and compares (L1).

The folder of the run receives
  model.safetensors   averaged weights, for --model everywhere and for gsasr evaluate
  state.pt            everything needed to go on: give the same command again, at any time
  log.csv             loss, learning rate, and PSNR where --valid is given

What is learned, and how fast, is a recipe: --recipe chooses one, any setting of it can be changed.
"""

EXAMPLES = """\
examples
  gsasr prepare PHOTOS -o DATA                  check the pictures and cut them up, once
  gsasr prepare OTHERS -o VALID --valid         pairs for validation
  gsasr train --data DATA --valid VALID --out RUN
  gsasr train --preset edsr-baseline --data DATA --out RUN --precision bfloat16
  torchrun --nproc-per-node 8 -m gsasr.cli train --preset edsr-baseline --data DATA --out RUN
"""

PREPARE = """\
Check every picture below a folder by decoding it, name those that are broken or too small, and cut
the others into overlapping PNG pieces, which training reads faster than whole photographs. With
--valid, write pairs for validation instead: OUT/HR/NAME.png, and OUT/LR/x2|x3|x4/NAME.png made
by MATLAB's bicubic. Stopped halfway, the same command goes on.
"""

PACK = """\
Write the state of a run as files small enough to travel (below 16 MiB each): weights in bfloat16,
averaged weights and moments of the optimizer in 8 bits. `gsasr unpack` makes a state.pt of them
with which `gsasr train` goes on, not equal to the bit but as well.
"""


def add_commands(commands: argparse._SubParsersAction) -> None:
    c = commands.add_parser(
        "train",
        help="train a network on a folder of pictures",
        description=TRAIN,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    c.set_defaults(run=train)
    c.add_argument(
        "--preset", choices=list(NETWORK_RECIPES), default="lite", help="network; default lite"
    )
    c.add_argument(
        "--recipe",
        choices=list(RECIPES),
        help="default: lite for lite, large for hatl-sa1b, paper for all others",
    )
    c.add_argument("--data", type=Path, required=True, help="folder tree of pictures")
    c.add_argument("--out", type=Path, required=True, help="folder of the run")
    c.add_argument("--valid", type=Path, help="pictures or prepared pairs for validation PSNR")
    settings = c.add_argument_group("settings of the recipe", "In brackets what recipes say.")
    for field in dataclasses.fields(TrainConfig):
        values = {name: _shown(getattr(each, field.name)) for name, each in RECIPES.items()}
        if len(set(values.values())) == 1:
            shown = values["paper"]
        else:
            shown = ", ".join(f"{name}: {value}" for name, value in values.items())
        text = f"{field.metadata['help']} ({shown})"
        _add(settings, field, getattr(RECIPES["paper"], field.name), text)
    carried_out = c.add_argument_group("how it is carried out", "Changes no result but rounding.")
    for field in dataclasses.fields(Execution):
        _add(carried_out, field, field.default, field.metadata["help"])

    c = _command(commands, prepare, "check training pictures and cut them up", PREPARE)
    c.add_argument("input", type=Path, help="folder tree of pictures")
    c.add_argument("-o", "--output", type=Path, required=True, help="folder to write to")
    c.add_argument("--valid", action="store_true", help="make pairs for validation instead")
    c.add_argument("--size", type=int, default=480, help="side of a piece, pixels (480)")
    c.add_argument("--step", type=int, default=240, help="from one piece to the next (240)")
    c.add_argument(
        "--rest",
        type=int,
        default=0,
        help="a last piece, flush with the edge, is cut where more pixels than this remain (0)",
    )
    c.add_argument(
        "--smallest", type=int, default=192, help="pictures with a shorter side are left out (192)"
    )
    c.add_argument("--scales", type=int, nargs="+", default=[2, 3, 4], help="of the pairs (2 3 4)")
    c.add_argument("--workers", type=int, default=cores(), help="processes; default: all")

    c = _command(commands, pack, "write a run's state as small files", PACK)
    c.add_argument("input", type=Path, metavar="RUN", help="folder of the run")
    c.add_argument("-o", "--output", type=Path, required=True, help="folder for the files")
    c.add_argument(
        "--no-moments", action="store_true", help="leave the optimizer out; it starts anew"
    )

    c = _command(commands, unpack, "make a run's state from such files", PACK)
    c.add_argument("input", type=Path, metavar="FILES", help="folder of the files")
    c.add_argument("-o", "--output", type=Path, required=True, metavar="RUN", help="run's folder")


def _command(
    commands: argparse._SubParsersAction,
    run: Callable[[argparse.Namespace], None],
    help: str,
    description: str,
) -> argparse.ArgumentParser:
    added = commands.add_parser(
        run.__name__,
        help=help,
        description=description,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    added.set_defaults(run=run)
    return added


def _add(group: argparse._ArgumentGroup, field: dataclasses.Field, value: Any, text: str) -> None:
    """An option for a setting; `value` tells its type. What is not given stays None."""
    flag = "--" + field.name.replace("_", "-")
    if isinstance(value, bool):
        group.add_argument(flag, action="store_true", default=None, help=text)
    elif isinstance(value, tuple):
        group.add_argument(flag, type=type(value[0]), nargs="*", metavar="X", help=text)
    else:
        kind = int if value is None else type(value)
        choices = field.metadata["choices"]
        metavar = None if choices else "X"
        group.add_argument(flag, type=kind, choices=choices, metavar=metavar, help=text)


def _shown(value: Any) -> str:
    if isinstance(value, tuple):
        return " ".join(map(_shown, value)) or "none"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _given(options: argparse.Namespace, kind: type) -> dict[str, Any]:
    """The fields of a configuration that were given on the command line."""
    names = [field.name for field in dataclasses.fields(kind)]
    found = {name: getattr(options, name) for name in names if getattr(options, name) is not None}
    return {name: tuple(v) if isinstance(v, list) else v for name, v in found.items()}


def train(options: argparse.Namespace) -> None:
    config = dataclasses.replace(
        recipe(options.preset, options.recipe), **_given(options, TrainConfig)
    )
    execution = Execution(**_given(options, Execution))
    rank = os.environ.get("RANK", "0")
    if "WORLD_SIZE" in os.environ:
        # torchrun ends the others when one has failed; they may be waiting for it in C code,
        # where Python would never come to a handler of its own.
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
    from .loop import train

    path = train(options.preset, options.data, options.out, config, options.valid, execution)
    if rank == "0":
        print(path)
    if "WORLD_SIZE" in os.environ:
        # All is written. Threads of gloo that outlast the interpreter abort the process now and
        # then, which torchrun would report as a failed run.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(0)


def prepare(options: argparse.Namespace) -> None:
    from .prepare import Pairs, Pieces, prepare

    if options.valid:
        task = Pairs(options.smallest, tuple(options.scales))
    else:
        task = Pieces(options.smallest, options.size, options.step, options.rest)
    print(prepare(options.input, options.output, task, options.workers))


def pack(options: argparse.Namespace) -> None:
    from .travel import pack

    for path in pack(options.input, options.output, moments=not options.no_moments):
        print(path)


def unpack(options: argparse.Namespace) -> None:
    from .travel import unpack

    print(unpack(options.input, options.output))
