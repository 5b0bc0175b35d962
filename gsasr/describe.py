"""What is in a file: a picture, a field of Gaussians, or a network."""

from __future__ import annotations

import os
from pathlib import Path

from . import image
from .errors import FieldError
from .files import require_file
from .gaussians import Gaussians


def describe(path: str | os.PathLike) -> dict[str, str]:
    """Name -> value, in the order to show. Raises GsasrError for a file that is none of these.

    path: a file, or a folder with a pair of official checkpoints.
    """
    if Path(path).is_dir() or Path(path).suffix in (".pth", ".pt"):
        return _model(path)
    if Path(path).suffix.lower() != ".safetensors":
        return _picture(image.read(path))
    if _is_field(path):
        return _field(Gaussians.load(path))
    return _model(path)


def _is_field(path: str | os.PathLike) -> bool:
    from safetensors import SafetensorError, safe_open

    require_file(path, FieldError)
    try:
        with safe_open(path, framework="pt") as file:
            return "opacity" in file.keys()  # noqa: SIM118, the file is no mapping
    except (SafetensorError, OSError) as error:
        raise FieldError(f"{path} is damaged or no .safetensors file.") from error


def _picture(picture: image.Picture) -> dict[str, str]:
    kind = "gray" if picture.gray else "RGB"
    return {
        "kind": "picture",
        "size": f"{picture.size[1]}x{picture.size[0]}",
        "channels": kind + (" with alpha" if picture.alpha is not None else ""),
        "bits per channel": str(picture.bits),
        "colour profile": "embedded" if picture.icc else "sRGB assumed",
    }


def _field(field: Gaussians) -> dict[str, str]:
    rows = {
        "kind": "Gaussians",
        "picture": f"{field.source or 'unknown'}, {field.size[1]}x{field.size[0]}",
        "made by": f"{field.model or 'unknown'} at scale {field.scale:g}",
        "Gaussians": f"{len(field)} ({len(field) / (field.size[0] * field.size[1]):.2f} per pixel)",
    }
    for name in ("std", "rho", "opacity"):
        values = getattr(field, name).flatten()
        if len(field):
            low, middle, high = values.min(), values.median(), values.max()
            rows[name] = f"{low:.4g} to {high:.4g}, median {middle:.4g}"
    return rows


def _model(path: str | os.PathLike) -> dict[str, str]:
    from .model import load_model

    model = load_model(path)
    encoder, decoder = model.config.encoder, model.config.decoder
    parameters = sum(parameter.numel() for parameter in model.parameters())
    return {
        "kind": "network",
        "family": str(model.config),
        "encoder": str(encoder),
        "decoder": str(decoder),
        "Gaussians per pixel": f"{decoder.gaussians_per_pixel:g}",
        "parameters": f"{parameters:,}",
        "picture sides": f"padded to multiples of {model.multiple}",
    }
