"""The one entry to all rasterizers."""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from ..errors import BackendError, RequestError
from ..gaussians import Gaussians
from ..view import View
from . import BACKENDS
from .antialias import integrated

DIFFERENTIABLE = ("cpu", "cuda")  # also the names of their devices
QUALITIES = ("screen", "export", "gradient")


def render(
    gaussians: Gaussians,
    view: View,
    backend: str = "auto",
    quality: str | None = None,
    antialias: bool = False,
) -> torch.Tensor:
    """(h, w, 3) float32 image of the Gaussians through the view, not clamped.

    backend: "reference" (dense, for tests), "cpu", "cuda" (NVIDIA), "gl" (OpenGL 4.3, headless
        where there is no window), or "auto": where the Gaussians are ("cuda" or "cpu") if that
        is a card or if a gradient is wanted, else the first of "gl" on a GPU, "cuda", "cpu"
        that can run.
    quality: "screen" (error below half an 8-bit step), "export" (below 1e-4) or "gradient"
        (for training); by default "gradient" if a tensor requires it, else "export".
    antialias: integrate over each pixel (see antialias.py) instead of sampling at its centre.

    The image of "cuda" stays on the card. Raises BackendError where the backend cannot run,
    RequestError for an unknown name.
    """
    backend, quality = _chosen(gaussians, backend, quality)
    if antialias:
        gaussians = integrated(gaussians, view)
    if backend == "reference":
        from . import reference

        return reference.render(gaussians, view).float()
    if backend == "gl":
        if _differentiable(gaussians):
            raise RequestError("The gl backend has no gradients; use backend='cpu' or 'cuda'.")
        return _by_gl(_moved(gaussians, "cpu"), view, quality)
    from . import operator

    return operator.draw(_moved(gaussians, backend), [len(gaussians)], [view], quality)[0]


def render_batch(
    gaussians: Gaussians,
    counts: list[int],
    views: list[View],
    backend: str = "auto",
    quality: str | None = None,
) -> list[torch.Tensor]:
    """As `render` for several pictures of any sizes at once, by "cpu" or "cuda".

    gaussians: of all pictures, one after the other; counts: how many each has; views: of each.
    """
    if sum(counts) != len(gaussians) or len(counts) != len(views):
        raise RequestError("There must be one view and one count per picture, adding up to all.")
    if not views:
        return []
    backend, quality = _chosen(gaussians, backend, quality)
    if backend not in DIFFERENTIABLE:
        backend = gaussians.mean.device.type
    from . import operator

    return operator.draw(_moved(gaussians, backend), counts, views, quality)


def _by_gl(gaussians: Gaussians, view: View, quality: str) -> torch.Tensor:
    """By OpenGL; a minified view in a unit of about its pixels, since cells are a few units large
    and one that is much smaller than a pixel is read for nothing."""
    from . import gl

    unit = 2.0 ** -round(math.log2(min(view.scale)))  # source pixels; so the change is exact
    if unit <= 1:
        return torch.from_numpy(gl.render(gaussians, view, quality))
    height, width = gaussians.size
    coarse = replace(
        gaussians,
        mean=gaussians.mean / unit,
        std=gaussians.std / unit,
        size=(math.ceil(height / unit), math.ceil(width / unit)),
    )
    x, y = (side / unit for side in view.origin)
    coarse_view = View((x, y), (view.scale[0] * unit, view.scale[1] * unit), view.size)
    return torch.from_numpy(gl.render(coarse, coarse_view, quality))


def _differentiable(gaussians: Gaussians) -> bool:
    return torch.is_grad_enabled() and any(
        tensor.requires_grad for tensor in gaussians.tensors().values()
    )


def _chosen(gaussians: Gaussians, backend: str, quality: str | None) -> tuple[str, str]:
    """The backend that "auto" stands for here and the quality, or an error."""
    differentiable = _differentiable(gaussians)
    quality = quality or ("gradient" if differentiable else "export")
    if quality not in QUALITIES:
        raise RequestError(f"Unknown quality {quality!r}; use one of {', '.join(QUALITIES)}.")
    require_backend(backend)
    if backend == "auto":
        there = gaussians.mean.device.type
        drawn_there = differentiable or (there == "cuda" and _cuda_runs())
        backend = there if drawn_there else default_backend()
    return backend, quality


def _moved(gaussians: Gaussians, device: str) -> Gaussians:
    """As float32 on a kind of device; where several are of the kind, those on one stay there."""
    there = gaussians.mean.device
    target = there if there.type == device else torch.device(device)
    return gaussians.map(lambda tensor: tensor.to(target, torch.float32))


def require_backend(backend: str) -> None:
    """Raise the error that `render` would raise for this name, without drawing."""
    if backend not in ("auto", *BACKENDS):
        raise RequestError(f"Unknown backend {backend!r}; use auto, {', '.join(BACKENDS)}.")
    if backend == "cuda":
        from . import cuda

        cuda.require()


def default_backend() -> str:
    """What "auto" means for a picture without gradients: "gl" on a GPU, else "cuda" or "cpu"."""
    from . import opengl

    if opengl.hardware():
        return "gl"
    return "cuda" if _cuda_runs() else "cpu"


def _cuda_runs() -> bool:
    """Whether there is a card, a compiler for it, and code that it takes."""
    from . import cuda

    try:
        cuda.require()
    except BackendError:
        return False
    return True
