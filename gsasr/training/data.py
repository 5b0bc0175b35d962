"""Training and validation samples: a crop of a picture, and the same crop scaled down."""

from __future__ import annotations

import os
from bisect import bisect_right
from collections import OrderedDict
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
    """All pictures below a folder, sorted, but hidden ones. Raises DataError if there is none."""
    paths = sorted(
        path
        for path in Path(folder).rglob("*")
        if path.suffix.lower() in SUFFIXES and not path.name.startswith(".")
        if path.is_file() or not path.exists()  # a link to nothing is named as broken later
    )
    if not paths:
        raise DataError(f"There are no pictures in {folder}; give a folder of PNG or JPEG files.")
    return paths


def load(path: Path) -> torch.Tensor:
    """(H, W, 3) uint8. Raises ImageError."""
    return torch.from_numpy(np.rint(image.read(path).color * 255).astype(np.uint8))


def downscale(picture: torch.Tensor, size: tuple[int, int]) -> torch.Tensor:
    """(H, W, 3) uint8 -> (*size, 3) uint8 by antialiased bicubic (a = -0.5)."""
    levels = picture.permute(2, 0, 1)[None].float()
    small = F.interpolate(levels, size, mode="bicubic", antialias=True, align_corners=False)
    return small[0].round().clamp(0, 255).byte().permute(1, 2, 0).contiguous()


@dataclass(frozen=True)
class Sample:
    """lr: (h, w, 3) uint8; hr: (H, W, 3) uint8, the same crop with H / h = W / w."""

    lr: torch.Tensor
    hr: torch.Tensor

    @property
    def scale(self) -> float:
        return self.hr.shape[0] / self.lr.shape[0]


class CropSampler:
    """Random crops of the pictures below a folder.

    A sample depends on the folder and on (seed, step, index) alone, whoever draws it and whatever
    was drawn before. Pictures are drawn in proportion to their area. Decoded ones (8 bit) are
    kept up to `cache` bytes. One that turns out damaged is left out: another is drawn instead.

    news: sentences about pictures left out since somebody last emptied the list.
    """

    def __init__(
        self,
        folder: str | os.PathLike,
        patch: int,
        scales: tuple[float, float],
        cache: int = 4 << 30,
    ) -> None:
        self.patch = patch
        self.scales = scales
        self.cache = cache
        self.news: list[str] = []
        largest = round(patch * scales[1])
        self.paths: list[Path] = []
        areas: list[int] = []
        small = 0
        for path in find_pictures(folder):
            try:
                with Image.open(path) as header:
                    width, height = header.size
            except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
                self.news.append(f"left out, not a picture: {path}")
                continue
            if min(width, height) < largest:
                small += 1
                continue
            self.paths.append(path)
            areas.append(width * height)
        if not self.paths:
            told = "".join(f"{line}\n" for line in self.news)
            raise DataError(f"{told}No picture in {folder} is at least {largest}x{largest} pixels.")
        if small:
            self.news.append(f"left out, smaller than {largest}x{largest} pixels: {small} pictures")
        self._reach = np.cumsum(areas).tolist()  # a random pixel below [i] lies in picture i
        self._decoded: OrderedDict[int, torch.Tensor] = OrderedDict()  # least recently used first
        self._held = 0  # bytes
        self._broken: set[int] = set()

    def sample(self, seed: int, step: int, index: int) -> Sample:
        """Number `index` of the batch of a step. Raises DataError if no picture can be decoded."""
        random = np.random.default_rng((seed, step, index))
        side = round(self.patch * random.uniform(*self.scales))
        picture = self._picture(random)
        top = int(random.integers(0, picture.shape[0] - side + 1))
        left = int(random.integers(0, picture.shape[1] - side + 1))
        hr = picture[top : top + side, left : left + side]
        lr = downscale(hr, (self.patch, self.patch))
        turns, mirrored = int(random.integers(4)), bool(random.integers(2))
        return Sample(_turned(lr, turns, mirrored), _turned(hr, turns, mirrored))

    def _picture(self, random: np.random.Generator) -> torch.Tensor:
        while len(self._broken) < len(self.paths):
            index = bisect_right(self._reach, int(random.integers(self._reach[-1])))
            if index in self._broken:
                continue
            if index in self._decoded:
                self._decoded.move_to_end(index)
                return self._decoded[index]
            try:
                picture = load(self.paths[index])
                if min(picture.shape[:2]) >= round(self.patch * self.scales[1]):
                    self._keep(index, picture)
                    return picture
                self.news.append(f"left out: {self.paths[index]} changed its size.")
            except ImageError as error:
                self.news.append(f"left out: {error}")
            self._broken.add(index)
        raise DataError("None of the training pictures can be decoded; check them with prepare.")

    def _keep(self, index: int, picture: torch.Tensor) -> None:
        self._decoded[index] = picture
        self._held += picture.numel()
        while self._held > self.cache and self._decoded:
            self._held -= self._decoded.popitem(last=False)[1].numel()


def _turned(crop: torch.Tensor, turns: int, mirrored: bool) -> torch.Tensor:
    crop = crop.rot90(turns, (0, 1))
    return (crop.flip(1) if mirrored else crop).contiguous()


def validation_samples(folder: str | os.PathLike, side: int = 192) -> list[Sample]:
    """Centre crops (side, side) of every picture, at the scales 2, 3 and 4.

    folder: as `gsasr prepare --valid` makes it, with HR/NAME and LR/x2|x3|x4/NAME (those of the
        scales that are there), or any tree of pictures, which are then scaled down here. Pictures
        smaller than `side` are not used.

    Raises DataError if none is left, ImageError for one that is damaged.
    """
    folder = Path(folder)
    paired = (folder / "HR").is_dir() and (folder / "LR").is_dir()
    scales = [s for s in (2, 3, 4) if not paired or (folder / f"LR/x{s}").is_dir()]
    samples = []
    for path in find_pictures(folder / "HR" if paired else folder):
        picture = load(path)
        if min(picture.shape[:2]) < side:
            continue
        for scale in scales:
            if paired:
                samples.append(_paired(picture, folder / f"LR/x{scale}" / path.name, scale, side))
            else:
                hr = _centre(picture, side, side)
                samples.append(Sample(downscale(hr, (side // scale,) * 2), hr.contiguous()))
    if not samples:
        raise DataError(
            f"{folder} holds no picture of at least {side}x{side} pixels for the scales 2, 3 or 4."
        )
    return samples


def _paired(picture: torch.Tensor, path: Path, scale: int, side: int) -> Sample:
    small = load(path)
    truth = picture[: small.shape[0] * scale, : small.shape[1] * scale]
    if truth.shape[:2] != (small.shape[0] * scale, small.shape[1] * scale):
        raise DataError(f"{path} does not fit its HR picture; make the pairs anew with prepare.")
    lr_side = min(side // scale, *small.shape[:2])
    lr = _centre(small, lr_side, lr_side)
    top, left = ((length - lr_side) // 2 * scale for length in small.shape[:2])
    hr = truth[top : top + lr_side * scale, left : left + lr_side * scale]
    return Sample(lr.contiguous(), hr.contiguous())


def _centre(picture: torch.Tensor, height: int, width: int) -> torch.Tensor:
    top, left = (picture.shape[0] - height) // 2, (picture.shape[1] - width) // 2
    return picture[top : top + height, left : left + width]
