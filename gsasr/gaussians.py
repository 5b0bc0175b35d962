"""Gaussians: what the network makes, what every rasterizer draws, what is saved."""

from __future__ import annotations

import json
import math
import os
from dataclasses import dataclass, replace

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from .errors import FieldError
from .files import require_file, writing

TENSORS = {"mean": 2, "std": 2, "rho": 0, "color": 3, "opacity": 0}  # name -> columns, 0: flat


@dataclass(frozen=True)
class Gaussians:
    """N peak-normalised 2D Gaussians whose sum is a picture.

    image(x) = sum opacity * color * exp(-q(x) / 2) with
    q = (dx^2/sx^2 - 2 rho dx dy/(sx sy) + dy^2/sy^2) / (1 - rho^2), d = x - mean.
    (Paper Eq. 1 and 2 without the 1/(2 pi sx sy sqrt(1 - rho^2)) factor, which the released
    checkpoints do not use.)

    mean: (N, 2) float32, (x, y), source pixels; the first pixel's centre is (0.5, 0.5).
    std: (N, 2) float32, standard deviations along x and y, source pixels, > 0.
    rho: (N,) float32, correlation in (-1, 1).
    color: (N, 3) float32, RGB in [0, 1], sRGB-encoded as in the picture.
    opacity: (N,) float32 in [0, 1].
    size: (height, width) of the source image, pixels.
    model, scale, source: what made them: model name, conditioning scale, file name.
    """

    mean: torch.Tensor
    std: torch.Tensor
    rho: torch.Tensor
    color: torch.Tensor
    opacity: torch.Tensor
    size: tuple[int, int]
    model: str = ""
    scale: float = 0.0
    source: str = ""

    def __post_init__(self) -> None:
        n = self.opacity.shape[0]
        for name, columns in TENSORS.items():
            expected = (n, columns) if columns else (n,)
            shape = tuple(getattr(self, name).shape)
            if shape != expected:
                raise FieldError(f"{name} must have shape {expected}, but has {shape}.")

    def __len__(self) -> int:
        return self.opacity.shape[0]

    @property
    def peak(self) -> torch.Tensor:
        """(N, 3) opacity * color, what one Gaussian adds at its mean."""
        return self.opacity[:, None] * self.color

    def tensors(self) -> dict[str, torch.Tensor]:
        """The five tensors by name."""
        return {name: getattr(self, name) for name in TENSORS}

    def map(self, function) -> Gaussians:
        """The same Gaussians with `function` applied to each of the five tensors."""
        return replace(self, **{name: function(tensor) for name, tensor in self.tensors().items()})

    def __getitem__(self, index) -> Gaussians:
        """A selection: slice, mask (N,) or indices."""
        return self.map(lambda tensor: tensor[index])

    @staticmethod
    def concatenate(parts: list[Gaussians]) -> Gaussians:
        """All of `parts` (at least one) as one; size and origin come from the first."""
        merged = {name: torch.cat([getattr(part, name) for part in parts]) for name in TENSORS}
        return replace(parts[0], **merged)

    def validate(self) -> Gaussians:
        """Itself, or FieldError if a value is not finite or outside its range."""
        if min(self.size) < 1 or not math.isfinite(self.scale):
            raise FieldError(f"The picture of a field cannot be {self.size[1]}x{self.size[0]}.")
        for name, tensor in self.tensors().items():
            if not bool(torch.isfinite(tensor).all()):
                raise FieldError(
                    f"{name} holds values that are not finite; predict the field anew."
                )
        for name, wrong, rule in (
            ("std", self.std <= 0, "be above 0"),
            ("rho", self.rho.abs() >= 1, "lie strictly between -1 and 1"),
            ("opacity", (self.opacity < 0) | (self.opacity > 1), "lie in [0, 1]"),
            ("color", (self.color < 0) | (self.color > 1), "lie in [0, 1]"),
        ):
            if bool(wrong.any()):
                raise FieldError(f"{name} must {rule}; predict the field anew.")
        return self

    def save(self, path: str | os.PathLike) -> None:
        """Write a .safetensors file that `load` reopens without the network.

        Raises FieldError if the file cannot be written; no partial file is left.
        """
        metadata = {
            "format": "gsasr-gaussians",
            "size": json.dumps(list(self.size)),
            "model": self.model,
            "scale": repr(float(self.scale)),
            "source": self.source,
        }
        tensors = {
            name: tensor.detach().to("cpu", torch.float32).contiguous()
            for name, tensor in self.tensors().items()
        }
        with writing(path, FieldError) as beside:
            save_file(tensors, beside, metadata)

    @staticmethod
    def load(path: str | os.PathLike) -> Gaussians:
        """Read what `save` wrote. Raises FieldError for anything else, or for bad values."""
        require_file(path, FieldError)
        try:
            with safe_open(path, framework="pt") as file:
                metadata = file.metadata() or {}
                if metadata.get("format") != "gsasr-gaussians":
                    raise FieldError(
                        f"{path} holds no Gaussians; make such a file with `gsasr predict`."
                    )
                tensors = {name: file.get_tensor(name).float() for name in TENSORS}
                height, width = json.loads(metadata["size"])
                return Gaussians(
                    **tensors,
                    size=(int(height), int(width)),
                    model=metadata.get("model", ""),
                    scale=float(metadata.get("scale", "0")),
                    source=metadata.get("source", ""),
                ).validate()
        except (
            SafetensorError,
            OSError,
            LookupError,
            ValueError,
            TypeError,
            OverflowError,
        ) as error:
            raise FieldError(
                f"{path} is damaged or no file of Gaussians; predict the field anew."
            ) from error
