"""One formula, several targets: Gaussians and a view to pixels."""

from .render import BACKENDS, available_backends, render

__all__ = ["BACKENDS", "available_backends", "render"]
