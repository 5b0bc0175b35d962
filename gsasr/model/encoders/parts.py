"""What encoders of several families share."""

from __future__ import annotations

import torch
from torch import nn


def center_on_grey(first: nn.Conv2d) -> None:
    """Let the first convolution see the picture in [-1, 1]: mid-grey starts as 0."""
    with torch.no_grad():
        first.weight.mul_(2)
        first.bias.copy_(-0.5 * first.weight.sum((1, 2, 3)))


def soften(*layers: nn.Module) -> None:
    """Shrink the last layers of residual branches, so that deep stacks start stable."""
    with torch.no_grad():
        for layer in layers:
            layer.weight.mul_(0.1)
