"""A run's state in small files, for resuming on another machine.

`state.pt` takes 16 bytes per weight with Adam. Packed it takes a little more than 5: the weights
in bfloat16 (2), the averaged weights as their difference to those in 8 bits (1), and each of
Adam's two moments in 8 bits (1 + 1). Without the moments it takes 3. Codes of 8 bits are in units
of the largest value of each block of 256. Training goes on from it as well, though not equal to
the bit.
"""

from __future__ import annotations

import io
import os
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..errors import CheckpointError, DataError
from ..files import require_file, writing
from .state import read_parts, write_parts

BLOCK = 256  # values that share a unit
PART = 15 << 20  # bytes per file
NAME = "state-{}-of-{}.part"


def pack(run: str | os.PathLike, out: str | os.PathLike, moments: bool = True) -> list[Path]:
    """Write RUN/state.pt as files of at most 15 MiB in `out`; returns them.

    moments: with the optimizer's. Raises CheckpointError if there is no state, DataError if it
    cannot be written.
    """
    state = read_parts(require_file(Path(run) / "state.pt", CheckpointError))
    weights = {key: _small(value) for key, value in state["model"].items()}
    difference = {
        key: _encode(value - weights[key].float()) if _large(value) else value
        for key, value in state["average"].items()
        if value.is_floating_point()  # tables of indices are equal in both
    }
    packed = {"step": state["step"], "model": weights, "average": difference}
    if moments and "optimizer" in state:  # a state unpacked without it has none yet
        packed["optimizer"] = _encode_moments(state["optimizer"])
    stream = io.BytesIO()
    torch.save(packed, stream)
    content = stream.getvalue()
    chunks = [content[i : i + PART] for i in range(0, len(content), PART)]
    out = Path(out)
    try:
        out.mkdir(parents=True, exist_ok=True)
        for old in out.glob(NAME.format("*", "*")):
            old.unlink()
    except OSError as error:
        raise DataError(f"Cannot write to the folder {out}: {error.strerror}.") from error
    paths = [out / NAME.format(number, len(chunks)) for number in range(1, len(chunks) + 1)]
    for path, chunk in zip(paths, chunks, strict=True):
        with writing(path, DataError) as beside:
            beside.write_bytes(chunk)
    return paths


def unpack(folder: str | os.PathLike, run: str | os.PathLike) -> Path:
    """Make RUN/state.pt of the files that `pack` wrote; returns it.

    Raises CheckpointError if one is missing or damaged, DataError if RUN has a state already.
    """
    folder, target = Path(folder), Path(run) / "state.pt"
    if target.exists():
        raise DataError(f"{target} exists; choose another folder, or delete it.")
    found = set(folder.glob(NAME.format("*", "*")))
    paths = [folder / NAME.format(number, len(found)) for number in range(1, len(found) + 1)]
    if not found or found != set(paths):
        raise CheckpointError(f"{folder} does not hold all the files of a packed state.")
    try:
        content = b"".join(path.read_bytes() for path in paths)
        packed = torch.load(io.BytesIO(content), weights_only=True)
        weights = {
            key: value.float() if value.is_floating_point() else value.long()
            for key, value in packed["model"].items()
        }
        average = weights | {
            key: weights[key] + _decode(value) if isinstance(value, dict) else value
            for key, value in packed["average"].items()
        }
        state = {"step": packed["step"], "model": weights, "average": average}
        if "optimizer" in packed:
            state["optimizer"] = _decode_moments(packed["optimizer"])
    except Exception as error:  # any damage of a pickle
        raise CheckpointError(f"The files in {folder} are damaged; copy them again.") from error
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"Cannot make the folder {run}: {error.strerror}.") from error
    write_parts(state, target)
    return target


def _large(value: Any) -> bool:
    """Is this worth less than its four bytes each? Not the few numbers of norms and the like."""
    return isinstance(value, Tensor) and value.dtype == torch.float32 and value.numel() >= BLOCK


def _small(value: Tensor) -> Tensor:
    """A weight in bfloat16, an index in 16 bits; the latter without loss."""
    if value.dtype == torch.int64 and value.numel() and int(value.max()) < 1 << 15:
        return value.short()
    return value.bfloat16() if _large(value) else value


def _encode(values: Tensor, positive: bool = False) -> dict[str, Any]:
    """In 8 bits: signed multiples of 1/127 of the largest of each block, rounded.

    positive: values that divide (Adam's second moment). They span many orders of magnitude, so
    their fourth root is coded, in multiples of 1/255, rounded up: a step may become a little
    shorter by it, never longer.
    """
    flat = values.detach().float().flatten()
    blocks = torch.nn.functional.pad(flat, (0, -flat.numel() % BLOCK)).view(-1, BLOCK)
    if positive:
        blocks = blocks.clamp(min=0) ** 0.25
    unit = blocks.abs().amax(dim=1, keepdim=True) / (255 if positive else 127)
    codes = blocks / unit.clamp(min=1e-38)
    codes = codes.ceil().clamp(0, 255).byte() if positive else codes.round().to(torch.int8)
    return {
        "codes": codes.flatten()[: flat.numel()].clone(),
        "unit": unit.flatten(),
        "shape": list(values.shape),
        "positive": positive,
    }


def _decode(coded: dict[str, Any]) -> Tensor:
    flat = coded["codes"].float()
    blocks = torch.nn.functional.pad(flat, (0, -flat.numel() % BLOCK)).view(-1, BLOCK)
    blocks = blocks * coded["unit"][:, None]
    if coded["positive"]:
        blocks = blocks**4
    return blocks.flatten()[: flat.numel()].view(coded["shape"]).clone()


def _encode_moments(tree: Any, name: str = "") -> Any:
    """A state dict of any optimizer, its large tensors coded."""
    if isinstance(tree, dict):
        return {key: _encode_moments(value, str(key)) for key, value in tree.items()}
    if isinstance(tree, list):
        return [_encode_moments(value) for value in tree]
    return _encode(tree, positive=name == "exp_avg_sq") if _large(tree) else tree


def _decode_moments(tree: Any) -> Any:
    if isinstance(tree, dict):
        if "codes" in tree:
            return _decode(tree)
        return {key: _decode_moments(value) for key, value in tree.items()}
    if isinstance(tree, list):
        return [_decode_moments(value) for value in tree]
    return tree
