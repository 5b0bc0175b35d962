"""Reading and writing networks; a file alone says which network it holds."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, replace
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from ..errors import CheckpointError
from ..files import require_file, shipped, writing
from . import hub, official
from .decoder import GaussianDecoder
from .encoders import ENCODERS, family_of
from .network import GSASR, ModelConfig
from .presets import PRESETS
from .state import State

SHIPPED = {"lite": "assets/models/gsasr-lite.safetensors"}


def load_model(name: str | os.PathLike = "lite") -> GSASR:
    """A network with trained weights, on the CPU, in evaluation mode, in float32.

    name: one of
        "lite", which is shipped;
        a preset with published weights, such as "hatl-sa1b" (`hub.FOLDERS`), downloaded once;
        a folder with encoder.pth and decoder.pth, or one of these files with the other beside it,
        or both as "A.pth,B.pth";
        a .safetensors file with `encoder.*` and `decoder.*` tensors.

    Every hyper-parameter is deduced from the tensors. Raises CheckpointError, whose sentence says
    what to do.
    """
    text, path = str(name), Path(name)
    if text in SHIPPED:
        return _load_file(shipped(SHIPPED[text]), text)
    if text in hub.FOLDERS and not path.is_dir():
        return _load_published(text)
    if text in PRESETS:
        raise CheckpointError(f"No trained weights of {text} are shipped; give a file of it.")
    if "," in text and not path.exists():
        files = tuple(Path(part) for part in text.split(","))
        return build(official.read(files), files[0].parent.name, text)
    if path.is_dir() or path.suffix in official.SUFFIXES:
        files = official.pair(path)
        folder = files[0].resolve().parent.name
        return build(official.read(files), path.stem if len(files) == 1 else folder, text)
    if path.suffix == ".safetensors":
        return _load_file(path, path.stem)
    known = ", ".join((*SHIPPED, *hub.FOLDERS))
    raise CheckpointError(
        f"There is no model {name}; give a .safetensors file, a folder with encoder.pth and "
        f"decoder.pth, or one of {known}."
    )


def _load_published(name: str) -> GSASR:
    files = hub.fetch(name)
    try:
        state = official.read(files)
    except CheckpointError:  # what the cache has is damaged
        files = hub.fetch(name, anew=True)
        state = official.read(files)
    model = build(state, name, str(files[0].parent))
    if model.config != PRESETS[name]:
        raise CheckpointError(
            f"{files[0].parent} does not hold {name} ({PRESETS[name]}): it looks like "
            f"{model.config} of {_sizes(model.config)}; delete it, so that it is fetched anew."
        )
    return model


def _sizes(config: ModelConfig) -> str:
    return f"{config.decoder.channels} channels and window {config.decoder.window}"


def _load_file(path: Path, name: str) -> GSASR:
    require_file(path, CheckpointError)
    try:
        with safe_open(path, framework="pt") as file:
            state = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118, no mapping
            metadata = file.metadata() or {}
    except (SafetensorError, OSError) as error:
        raise CheckpointError(
            f"{path} is damaged or no .safetensors file; write or fetch it anew."
        ) from error
    state = {k: v for k, v in state.items() if k.startswith(("encoder.", "decoder."))}
    return build(state, name, str(path), _stored_window(metadata))


def _stored_window(metadata: dict[str, str]) -> int | None:
    """The decoder's window as `save_model` noted it; tensors do not always tell."""
    try:
        return int(json.loads(metadata["config"])["decoder"]["window"])
    except (KeyError, TypeError, ValueError):
        return None


def build(state: State, name: str, origin: str, window: int | None = None) -> GSASR:
    """The network that these tensors (`encoder.*`, `decoder.*`) describe, with a copy of them.

    name: the network's name; origin: what to call the file in an error; window: the decoder's,
    where tensors do not tell (`GaussianDecoder.config_from`).

    Raises CheckpointError.
    """
    config = _config(state, origin)
    if config.decoder.enhanced and window in range(1, config.decoder.seeds):
        config = replace(config, decoder=replace(config.decoder, window=window))
    try:
        model = GSASR(config, name)
    except (ValueError, RuntimeError, ZeroDivisionError) as error:
        raise _unknown(origin) from error
    expected = model.state_dict()
    missing = sorted(expected.keys() - state.keys())
    extra = sorted(state.keys() - expected.keys())
    wrong = sorted(k for k in expected.keys() & state.keys() if expected[k].shape != state[k].shape)
    for keys, what in ((missing, "lacks"), (extra, "has unknown"), (wrong, "has another shape of")):
        if keys:
            more = f" and {len(keys) - 1} more" if len(keys) > 1 else ""
            raise CheckpointError(
                f"{origin} looks like {config}, but {what} {keys[0]}{more}; "
                "fetch it anew, or give another model."
            )
    state = {k: v.to(expected[k].dtype, copy=True) for k, v in state.items()}
    for key, index in state.items():
        if key.endswith("relative_position_index"):
            table = state[key.replace("position_index", "position_bias_table")]
            if int(index.min()) < 0 or int(index.max()) >= table.shape[0]:
                raise CheckpointError(f"{origin} has a {key} that points outside its table.")
    if not all(bool(torch.isfinite(v).all()) for v in state.values() if v.is_floating_point()):
        raise CheckpointError(
            f"{origin} holds weights that are not finite; train or fetch it anew."
        )
    model.load_state_dict(state, assign=True)
    return model.eval()


def _config(state: State, origin: str) -> ModelConfig:
    """What the network is made of. Raises CheckpointError."""
    encoder, decoder = (
        {k.removeprefix(part): v for k, v in state.items() if k.startswith(part)}
        for part in ("encoder.", "decoder.")
    )
    part = "encoder"
    try:
        family = ENCODERS[family_of(encoder)]
    except KeyError as error:
        raise _unknown(origin) from error
    try:
        encoder_config = family.config_from(encoder)
        part = "decoder"
        return ModelConfig(encoder_config, GaussianDecoder.config_from(decoder))
    except KeyError as error:
        if not decoder:
            raise _unknown(origin) from error
        raise CheckpointError(
            f"{origin} lacks {part}.{error.args[0]}; fetch it anew, or give another model."
        ) from error
    except (ValueError, IndexError, TypeError, ZeroDivisionError) as error:
        raise _unknown(origin) from error


def _unknown(origin: str) -> CheckpointError:
    return CheckpointError(
        f"{origin} holds no GSASR network that is known here; it needs the tensors of an encoder "
        f"({', '.join(ENCODERS)}) and of a decoder."
    )


def save_model(
    model: GSASR,
    path: str | os.PathLike,
    metadata: dict[str, str] | None = None,
    half: bool = False,
) -> None:
    """Write a .safetensors file that `load_model` reads, its configuration inside.

    metadata: more strings to store, such as the training configuration and step.
    half: store weights as float16, in half the space; angles of rotary positions stay float32.
    Raises CheckpointError if the file cannot be written, or a weight is too large for float16; no
    partial file is left.
    """
    state = {k: v.detach().cpu().contiguous() for k, v in model.state_dict().items()}
    if half:
        state = {k: _halved(k, v) for k, v in state.items()}
    header = {
        "format": "gsasr-model",
        "name": model.name,
        "family": str(model.config),
        "config": json.dumps(asdict(model.config)),
    }
    with writing(path, CheckpointError) as beside:
        save_file(state, beside, header | (metadata or {}))


def _halved(key: str, value: torch.Tensor) -> torch.Tensor:
    if not value.is_floating_point() or ".rope_" in key:
        return value
    if bool((value.abs() > torch.finfo(torch.float16).max).any()):
        raise CheckpointError(f"{key} is too large for float16; convert without --half.")
    return value.half()
