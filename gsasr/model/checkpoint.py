"""Reading and writing networks; a file alone says which network it holds."""

from __future__ import annotations

import json
import os
from dataclasses import asdict
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from ..errors import CheckpointError
from ..files import require_file, shipped, writing
from .decoder import GaussianDecoder
from .encoders import ENCODERS, family_of
from .network import GSASR, ModelConfig
from .presets import PRESETS

SHIPPED = {"lite": "assets/models/gsasr-lite.safetensors"}


def load_model(name: str | os.PathLike = "lite") -> GSASR:
    """A network with trained weights, on the CPU, in evaluation mode.

    name: a preset that has shipped weights ("lite"), or a .safetensors file with `encoder.*` and
        `decoder.*` tensors; every hyper-parameter is deduced from their shapes.

    Raises CheckpointError, whose sentence says what to do.
    """
    if str(name) in SHIPPED:
        return _load_file(shipped(SHIPPED[str(name)]), str(name))
    if str(name) in PRESETS:
        raise CheckpointError(
            f"No trained weights of {name} are shipped; give a .safetensors file of it."
        )
    path = Path(name)
    if path.suffix != ".safetensors":
        known = ", ".join(SHIPPED)
        raise CheckpointError(f"There is no model {name}; give a .safetensors file or {known}.")
    return _load_file(path, path.stem)


def _load_file(path: Path, name: str) -> GSASR:
    require_file(path, CheckpointError)
    parts: dict[str, dict[str, torch.Tensor]] = {"encoder": {}, "decoder": {}}
    try:
        with safe_open(path, framework="pt") as file:
            for key in file.keys():  # noqa: SIM118, the file is no mapping
                part, _, rest = key.partition(".")
                if part in parts:
                    parts[part][rest] = file.get_tensor(key)
    except (SafetensorError, OSError) as error:
        raise CheckpointError(f"{path} is damaged or no .safetensors file.") from error
    return build(parts["encoder"], parts["decoder"], name, str(path))


def build(
    encoder: dict[str, torch.Tensor], decoder: dict[str, torch.Tensor], name: str, origin: str
) -> GSASR:
    """The network that these two state dicts describe, with them loaded.

    name: the network's name; origin: what to call the file in an error.
    """
    try:
        config = ModelConfig(
            ENCODERS[family_of(encoder)].config_from(encoder), GaussianDecoder.config_from(decoder)
        )
        if config.decoder.channels % config.decoder.heads:
            raise ValueError("heads must divide channels")
        model = GSASR(config, name)
    except (KeyError, ValueError, IndexError, RuntimeError, ZeroDivisionError) as error:
        raise CheckpointError(
            f"{origin} holds no GSASR network that is known here; "
            "it needs encoder.* (EDSR) and decoder.* tensors."
        ) from error
    state = {f"encoder.{k}": v for k, v in encoder.items()}
    state |= {f"decoder.{k}": v for k, v in decoder.items()}
    expected = model.state_dict()
    missing = sorted(expected.keys() - state.keys())
    extra = sorted(state.keys() - expected.keys())
    wrong = sorted(k for k in expected.keys() & state.keys() if expected[k].shape != state[k].shape)
    for keys, what in ((missing, "lacks"), (extra, "has unknown"), (wrong, "has another shape of")):
        if keys:
            more = f" and {len(keys) - 1} more" if len(keys) > 1 else ""
            raise CheckpointError(f"{origin} {what} {keys[0]}{more}; it does not fit its network.")
    for key, index in state.items():
        if key.endswith("relative_position_index"):
            table = state[key.replace("position_index", "position_bias_table")]
            if int(index.min()) < 0 or int(index.max()) >= table.shape[0]:
                raise CheckpointError(f"{origin} has a {key} that points outside its table.")
    if not all(bool(torch.isfinite(v).all()) for v in state.values() if v.is_floating_point()):
        raise CheckpointError(
            f"{origin} holds weights that are not finite; train or fetch it anew."
        )
    model.load_state_dict(state)
    return model.eval()


def save_model(
    model: GSASR, path: str | os.PathLike, metadata: dict[str, str] | None = None
) -> None:
    """Write a .safetensors file that `load_model` reads, its configuration inside.

    metadata: more strings to store, such as the training configuration and step.
    Raises CheckpointError if the file cannot be written; no partial file is left.
    """
    state = {k: v.detach().cpu().contiguous() for k, v in model.state_dict().items()}
    header = {
        "format": "gsasr-model",
        "name": model.name,
        "config": json.dumps(asdict(model.config)),
    }
    with writing(path, CheckpointError) as beside:
        save_file(state, beside, header | (metadata or {}))
