"""GSASR: a picture as a continuous field of 2D Gaussians, rendered at any scale.

    import gsasr
    model = gsasr.load_model("lite")
    field = gsasr.predict(model, image, scale=4.0)  # image: (H, W, 3) float32 in [0, 1], sRGB
    picture = gsasr.render(field, scale=7.3)        # (h, w, 3) float32

Names are loaded when first used, so that importing this costs nothing.
"""

from __future__ import annotations

import importlib

_HOME = {
    "Gaussians": "gaussians",
    "GsasrError": "errors",
    "View": "view",
    "load_model": "model",
    "predict": "prediction",
    "render": "picture",
    "upscale": "picture",
}

__all__ = sorted(_HOME)
__version__ = "0.1.0"


def __getattr__(name: str):
    if name not in _HOME:
        raise AttributeError(f"module 'gsasr' has no attribute {name!r}")
    value = getattr(importlib.import_module(f".{_HOME[name]}", __name__), name)
    globals()[name] = value
    return value
