"""The authors' files: pairs of PyTorch checkpoints, one of the encoder and one of the decoder."""

from __future__ import annotations

import warnings
from pathlib import Path

import torch

from ..errors import CheckpointError
from ..files import require_file
from .state import State

SUFFIXES = (".pth", ".pt")
STEMS = (("encoder", "decoder"), ("net_g", "net_fea2gs"))  # published; as training writes them


def pair(path: Path) -> tuple[Path, ...]:
    """The files that make one network.

    path: a folder with encoder.pth and decoder.pth, or with net_g*.pth and net_fea2gs*.pth, of
        which the furthest trained; or one file of such a pair, the other beside it; or a file
        without such a name, which must hold both parts.

    Raises CheckpointError.
    """
    if not path.is_dir():
        other = _other(path)
        return (path, other) if other is not None and other.exists() else (path,)
    for first, second in STEMS:
        found = {file.name.removeprefix(first): file for file in path.glob(f"{first}*.pth")}
        both = {rest: file for rest, file in found.items() if (path / f"{second}{rest}").exists()}
        if both:
            rest = max(both, key=_progress)
            return both[rest], path / f"{second}{rest}"
    raise CheckpointError(
        f"{path} lacks a pair encoder.pth and decoder.pth, or net_g_*.pth and net_fea2gs_*.pth; "
        "give a folder that has one."
    )


def _other(path: Path) -> Path | None:
    for first, second in STEMS:
        for stem, partner in ((first, second), (second, first)):
            if path.name.startswith(stem):
                return path.with_name(partner + path.name.removeprefix(stem))
    return None


def _progress(rest: str) -> tuple[bool, int, str]:
    """How far training was when it wrote `net_g` + rest: "_5000.pth" before "_latest.pth"."""
    number = rest.strip("_").removesuffix(".pth")
    return not number.isdecimal(), int(number) if number.isdecimal() else 0, rest


def read(files: tuple[Path, ...]) -> State:
    """All tensors of these files under `encoder.*` and `decoder.*`; keys tell which is which.

    Averaged weights (`params_ema`) are taken before others (`params`). Nothing in a file is
    executed. Raises CheckpointError.
    """
    state: State = {}
    for path in files:
        tensors = _tensors(path)
        if not any(key.startswith(("encoder.", "decoder.")) for key in tensors):
            part = "decoder" if any("attn_blocks." in key for key in tensors) else "encoder"
            if any(key.startswith(part) for key in state):
                raise CheckpointError(
                    f"{files[0]} and {path} both hold the {part}; give one of each part."
                )
            tensors = {f"{part}.{key}": value for key, value in tensors.items()}
        state |= tensors
    if len(files) == 1:
        for part, missing in (("encoder", "decoder"), ("decoder", "encoder")):
            if state and all(key.startswith(f"{part}.") for key in state):
                name = _other(files[0])
                raise CheckpointError(
                    f"{files[0]} holds the {part} alone; put the {missing} beside it as "
                    f"{name.name if name else f'{missing}.pth'}, or pass both as A.pth,B.pth."
                )
    return state


def _tensors(path: Path) -> State:
    require_file(path, CheckpointError)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # a damaged or hostile file may raise anything
        raise CheckpointError(
            f"{path} is damaged, or holds more than tensors and was not opened; "
            "fetch it anew from a source that you trust."
        ) from error
    for key in ("params_ema", "params"):
        if isinstance(content, dict) and key in content:
            content = content[key]
            break
    if not isinstance(content, dict) or not all(
        isinstance(key, str) and _is_plain(value) for key, value in content.items()
    ):
        raise CheckpointError(f"{path} holds no weights; give a checkpoint with params_ema.")
    return dict(content)


def _is_plain(value: object) -> bool:
    """Whether it is a tensor that is as large in the file as it says."""
    return (
        isinstance(value, torch.Tensor)
        and value.layout == torch.strided
        and value.device.type == "cpu"
        and not value.is_quantized
        and value.untyped_storage().nbytes() >= value.numel() * value.element_size()
    )
