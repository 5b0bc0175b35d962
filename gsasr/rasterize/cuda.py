"""Rasterizer for NVIDIA cards: the steps around kernels.cu.

Forward: project every Gaussian to output pixels, list the tiles it reaches, sort the lists by
tile, and let every strip of pixels add up its tile's list. Backward: one thread per Gaussian.
The sort is stable, so a list keeps the order of the Gaussians and results are equal to the bit
from run to run. (The size of the tiles follows from the largest scale of a batch, so a picture
beside a much larger one may differ from itself alone in the last digits.)
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from ctypes import c_int
from functools import cache

import numpy as np
import torch
from torch import Tensor

from ..errors import BackendError
from . import nvrtc
from .batch import Picture

STRIP = 4  # pixels per thread of `gather`, as in kernels.cu
BLOCK = 128  # threads
ENTRIES = 1 << 25  # (tile, Gaussian) pairs held at once, about 40 bytes each while sorting
SPLAT = 12  # float32 per projected Gaussian
PICTURE = np.dtype(  # struct Picture of kernels.cu
    [
        ("origin", "f8", 2),
        ("scale", "f8", 2),
        ("gaussian", "i8"),
        ("tile", "i8"),
        ("pixel", "i8"),
        ("size", "i4", 2),  # width, height
        ("tiles", "i4", 2),  # across, down
    ]
)

Launch = Callable[..., None]  # (kernel name, threads, *arguments)


def forward(
    mean: Tensor,
    std: Tensor,
    rho: Tensor,
    peak: Tensor,
    cut: Tensor,
    batch: list[Picture],
    launch: Launch | None = None,
) -> Tensor:
    """(P, 3) pixels of all pictures; arguments as of `operator.rasterize`, on one card.

    launch: for tests, runs the kernels elsewhere.
    """
    launch = launch or kernels(mean.device)
    scene = _Scene(batch, mean.device)
    pixels = mean.new_zeros(scene.pixel_count, 3)
    if not scene.tile_count or not len(mean):
        return pixels
    splats, tiles = scene.project(launch, mean, std, rho, peak, cut)
    ends = tiles.cumsum(0)
    for start, stop, entries in _portions(ends):
        keys = torch.empty(entries, dtype=torch.int32, device=mean.device)
        owners = torch.empty_like(keys)
        launch("fill", stop - start, start, stop, splats, ends, *scene.arguments, keys, owners)
        keys, order = keys.sort(stable=True)
        owners = owners[order]
        first = torch.searchsorted(keys, scene.all_tiles)
        strips = scene.tile_count * scene.tile**2 // STRIP
        launch("gather", strips, strips, splats, owners, first, *scene.arguments, pixels)
    return pixels


def backward(
    upstream: Tensor,
    mean: Tensor,
    std: Tensor,
    rho: Tensor,
    peak: Tensor,
    cut: Tensor,
    batch: list[Picture],
    launch: Launch | None = None,
) -> Tensor:
    """(N, 8) gradients of mean 2, std 2, rho, peak 3; arguments as of `forward`."""
    launch = launch or kernels(mean.device)
    scene = _Scene(batch, mean.device)
    grads = mean.new_zeros(len(mean), 8)
    if not scene.tile_count or not len(mean):
        return grads
    splats, _ = scene.project(launch, mean, std, rho, peak, cut)
    pictures, count, _ = scene.arguments
    shape = std.contiguous(), rho.contiguous()
    upstream = upstream.contiguous()
    launch("backward", len(mean), len(mean), splats, *shape, pictures, count, upstream, grads)
    return grads


class _Scene:
    """The table of pictures on the card, and what follows from it."""

    def __init__(self, batch: list[Picture], device: torch.device) -> None:
        # Tiles about as large as a Gaussian: small ones waste fewer evaluations outside its
        # ellipse, large ones keep the lists short.
        scale = max((max(p.view.scale) for p in batch), default=1.0)
        self.tile = 8 if scale <= 6 else 16 if scale <= 24 else 32
        table = np.zeros(len(batch), PICTURE)
        self.tile_count = self.pixel_count = 0
        for row, picture in zip(table, batch, strict=True):
            height, width = picture.view.size
            across, down = -(-width // self.tile), -(-height // self.tile)
            row["origin"], row["scale"] = picture.view.origin, picture.view.scale
            row["gaussian"], row["pixel"] = picture.gaussians.start, picture.pixels.start
            row["tile"], row["size"], row["tiles"] = (
                self.tile_count,
                (width, height),
                (across, down),
            )
            self.tile_count += across * down
            self.pixel_count = picture.pixels.stop
        if self.tile_count >= 2**31:
            raise BackendError("The output is too large for one launch; render it in parts.")
        self.all_tiles = torch.arange(self.tile_count + 1, dtype=torch.int32, device=device)
        pictures = torch.from_numpy(table.view(np.uint8)).to(device)
        self.arguments = pictures, c_int(len(batch)), c_int(self.tile)

    def project(self, launch: Launch, *gaussians: Tensor) -> tuple[Tensor, Tensor]:
        """(N, 12) splats and (N,) int32 numbers of reached tiles."""
        count = len(gaussians[0])
        splats = gaussians[0].new_empty(count, SPLAT)
        tiles = torch.empty(count, dtype=torch.int32, device=splats.device)
        inputs = [tensor.contiguous() for tensor in gaussians]
        launch("project", count, count, *inputs, *self.arguments, splats, tiles)
        return splats, tiles


def _portions(ends: Tensor) -> list[tuple[int, int, int]]:
    """(start, stop, entries): runs of Gaussians that reach at most about ENTRIES tiles.

    ends: (N,) running sum of the tiles that each one reaches.
    """
    total = int(ends[-1])
    if total <= ENTRIES:
        return [(0, len(ends), total)] if total else []
    marks = torch.arange(ENTRIES, total, ENTRIES, dtype=ends.dtype, device=ends.device)
    stops = sorted({*(torch.searchsorted(ends, marks) + 1).tolist(), len(ends)})
    counts = [0, *ends[torch.tensor(stops, device=ends.device) - 1].tolist()]
    return [
        (start, stop, after - before)
        for start, stop, before, after in zip([0, *stops], stops, counts, counts[1:], strict=False)
        if after > before
    ]


def packed(arguments: tuple) -> tuple[ctypes.Array, list]:
    """Kernel arguments as an array of pointers to them, and what must outlive the launch.

    A tensor is passed as the address of its data, an int as `long long`, ctypes as they are.
    """
    values = [
        ctypes.c_void_p(a.data_ptr())
        if isinstance(a, Tensor)
        else ctypes.c_longlong(a)
        if isinstance(a, int)
        else a
        for a in arguments
    ]
    return (ctypes.c_void_p * len(values))(*map(ctypes.addressof, values)), values


def require() -> None:
    """Raise BackendError, with the reason, if no card can run the kernels."""
    if torch.version.cuda is None or not torch.cuda.is_available():  # AMD's build has the latter
        there = torch.version.cuda is not None
        why = "no NVIDIA GPU was found" if there else "PyTorch is built without CUDA"
        raise BackendError(
            f"The cuda backend cannot run: {why}; use --backend gl or cpu, or --device cpu."
        )
    kernels(torch.device("cuda", torch.cuda.current_device()))


@cache
def kernels(device: torch.device) -> Launch:
    """Launches kernels.cu on a card, on PyTorch's current stream. Raises BackendError."""
    major, minor = torch.cuda.get_device_capability(device)
    binary = nvrtc.compiled(10 * major + minor)
    return module(binary, device)


def module(binary: bytes, device: torch.device) -> Launch:
    """Load machine code on a card; returns a function that launches its kernels by name."""
    from cuda.bindings import driver

    def checked(result: tuple):
        status, *values = result
        if status != driver.CUresult.CUDA_SUCCESS:
            raise BackendError(
                f"The CUDA driver reports {status.name}; use --backend gl or cpu, or --device cpu."
            )
        return values[0] if values else None

    with torch.cuda.device(device):
        torch.cuda.synchronize()  # makes PyTorch's context current
        handle = checked(driver.cuModuleLoadData(binary))

    @cache
    def function(name: str):
        return checked(driver.cuModuleGetFunction(handle, name.encode()))

    def launch(name: str, threads: int, *arguments) -> None:
        pointers, _keep = packed(arguments)
        with torch.cuda.device(device):
            stream = torch.cuda.current_stream().cuda_stream
            grid = (-(-threads // BLOCK), 1, 1)
            where = ctypes.addressof(pointers)
            checked(driver.cuLaunchKernel(function(name), *grid, BLOCK, 1, 1, 0, stream, where, 0))

    return launch
