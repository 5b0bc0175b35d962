"""One formula, several targets: Gaussians and a view to pixels.

The names are loaded when first used, so that a window can draw (`rasterize.gl`) before PyTorch
is in.
"""

from __future__ import annotations

import importlib

BACKENDS = ("reference", "cpu", "cuda", "gl")

__all__ = ["BACKENDS", "default_backend", "render", "render_batch", "require_backend"]


def __getattr__(name: str):
    if name not in __all__:
        raise AttributeError(f"module 'gsasr.rasterize' has no attribute {name!r}")
    value = getattr(importlib.import_module(".backends", __name__), name)
    globals()[name] = value
    return value
