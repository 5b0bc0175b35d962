"""The one entry to all rasterizers."""

from __future__ import annotations

import torch

from ..errors import BackendError, RequestError
from ..gaussians import Gaussians
from ..view import View
from . import BACKENDS

QUALITIES = ("screen", "export", "gradient")


def render(
    gaussians: Gaussians, view: View, backend: str = "auto", quality: str | None = None
) -> torch.Tensor:
    """(h, w, 3) float32 image of the Gaussians through the view, not clamped.

    backend: "reference" (dense, for tests), "cpu", "gl" (OpenGL 4.3, headless where there is no
        window), or "auto": "cpu" if a gradient is wanted, else "gl" on a hardware GPU, else "cpu".
    quality: "screen" (error below half an 8-bit step), "export" (below 1e-4) or "gradient"
        (for training); by default "gradient" if a tensor requires it, else "export".

    Raises BackendError where the backend cannot run, RequestError for an unknown name.
    """
    differentiable = torch.is_grad_enabled() and any(
        tensor.requires_grad for tensor in gaussians.tensors().values()
    )
    quality = quality or ("gradient" if differentiable else "export")
    if quality not in QUALITIES:
        raise RequestError(f"Unknown quality {quality!r}; use one of {', '.join(QUALITIES)}.")
    require_backend(backend)
    if backend == "auto":
        backend = "cpu" if differentiable else default_backend()
    if backend == "reference":
        from . import reference

        return reference.render(gaussians, view).float()
    if backend == "cpu":
        from . import cpu

        return cpu.render(gaussians, view, quality)
    from . import gl

    if differentiable:
        raise RequestError("The gl backend has no gradients; use backend='cpu'.")
    return torch.from_numpy(gl.render(gaussians, view, quality))


def require_backend(backend: str) -> None:
    """Raise the error that `render` would raise for this name, without drawing."""
    if backend == "cuda":
        raise BackendError("The cuda backend is not written yet; use --backend cpu or gl.")
    if backend not in ("auto", *BACKENDS):
        raise RequestError(f"Unknown backend {backend!r}; use auto, {', '.join(BACKENDS)}.")


def default_backend() -> str:
    """What "auto" means for a picture without gradients: "gl" on a hardware GPU, else "cpu"."""
    from . import gl

    return "gl" if gl.hardware() else "cpu"
