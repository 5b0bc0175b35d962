"""Training and validation pairs: a crop of a picture, and the same crop scaled down."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image

from .. import image
from ..errors import DataError, ImageError

SUFFIXES = {".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff"}


def find_pictures(folder: str | os.PathLike) -> list[Path]:
    """All pictures below a folder, sorted. Raises DataError if there is none."""
    paths = sorted(p for p in Path(folder).rglob("*") if p.suffix.lower() in SUFFIXES)
    if not paths:
        raise DataError(f"There are no pictures in {folder}; give a folder of PNG or JPEG files.")
    return paths


def load(path: Path) -> torch.Tensor:
    """(3, H, W) uint8. Raises ImageError."""
    color = image.read(path).color
    return torch.from_numpy(np.rint(color * 255).astype(np.uint8)).permute(2, 0, 1).contiguous()


def downscale(picture: torch.Tensor, size: tuple[int, int]) -> torch.Tensor:
    """(B, 3, H, W) in [0, 1] -> (B, 3, *size), antialiased bicubic (a = -0.5), 8-bit levels."""
    small = F.interpolate(picture, size, mode="bicubic", antialias=True, align_corners=False)
    return small.mul(255).round().clamp(0, 255).div(255)


@dataclass(frozen=True)
class Sample:
    """lr: (3, patch, patch); hr: (3, side, side); scale = side / patch exactly."""

    lr: torch.Tensor
    hr: torch.Tensor
    scale: float


class CropSampler:
    """Random crops of the pictures below a folder; the batch of a step depends on the step alone.

    Pictures are drawn in proportion to their area, and all kept decoded (8 bit) once used. One
    that turns out damaged is named on stderr and left out from then on; only then a batch also
    depends on the batches before it.
    """

    def __init__(self, folder: str | os.PathLike, patch: int, scales: tuple[float, float]) -> None:
        self.patch = patch
        self.scales = scales
        largest = round(patch * scales[1])
        self.paths: list[Path] = []
        areas: list[int] = []
        for path in find_pictures(folder):
            try:
                with Image.open(path) as header:
                    width, height = header.size
            except (OSError, ValueError, Image.DecompressionBombError):
                print(f"left out, not a picture: {path}", file=sys.stderr)
                continue
            if min(width, height) >= largest:
                self.paths.append(path)
                areas.append(width * height)
        if not self.paths:
            raise DataError(f"No picture in {folder} is at least {largest}x{largest} pixels.")
        self._weights = np.asarray(areas, np.float64)
        self._decoded: dict[Path, torch.Tensor] = {}

    def batch(self, size: int, seed: int, step: int) -> list[Sample]:
        """`size` samples; equal arguments give equal samples."""
        random = np.random.default_rng((seed, step))
        return [self._sample(random) for _ in range(size)]

    def _sample(self, random: np.random.Generator) -> Sample:
        side = round(self.patch * random.uniform(*self.scales))
        picture = self._picture(random)
        top = random.integers(0, picture.shape[1] - side + 1)
        left = random.integers(0, picture.shape[2] - side + 1)
        hr = picture[:, top : top + side, left : left + side].float() / 255
        lr = downscale(hr[None], (self.patch, self.patch))[0]
        turns, mirrored = int(random.integers(4)), bool(random.integers(2))
        lr, hr = (_turned(crop, turns, mirrored) for crop in (lr, hr))
        return Sample(lr, hr, side / self.patch)

    def _picture(self, random: np.random.Generator) -> torch.Tensor:
        while self._weights.any():
            index = int(random.choice(len(self.paths), p=self._weights / self._weights.sum()))
            path = self.paths[index]
            try:
                if path not in self._decoded:
                    self._decoded[path] = load(path)
                return self._decoded[path]
            except ImageError as error:
                print(f"left out: {error}", file=sys.stderr)
                self._weights[index] = 0
        raise DataError("None of the training pictures can be decoded.")


def _turned(crop: torch.Tensor, turns: int, mirrored: bool) -> torch.Tensor:
    crop = crop.rot90(turns, (1, 2))
    return (crop.flip(2) if mirrored else crop).contiguous()


def validation_pairs(folder: str | os.PathLike, side: int = 192) -> list[Sample]:
    """Centre crops (side, side) of every picture below a folder, at scales 2, 3 and 4."""
    pairs = []
    for path in find_pictures(folder):
        picture = load(path)
        top, left = ((length - side) // 2 for length in picture.shape[1:])
        if min(top, left) < 0:
            continue
        hr = picture[:, top : top + side, left : left + side].float() / 255
        pairs += [Sample(downscale(hr[None], (side // s,) * 2)[0], hr, s) for s in (2, 3, 4)]
    if not pairs:
        raise DataError(f"No validation picture in {folder} is at least {side}x{side} pixels.")
    return pairs
