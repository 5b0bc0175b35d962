"""The optimizers: Adam (the paper's), or Muon for the matrices and Adam for everything else."""

from __future__ import annotations

import torch
from torch import nn

MUON_RATE = 2.0  # learning rate of the matrices, in units of Adam's
NARROW = 16  # a layer with fewer inputs or outputs is no matrix to orthogonalise


def make_optimizer(model: nn.Module, name: str, betas: tuple[float, float]):
    """`name`: "adam" or "muon". The learning rate is set by `set_rate` before each step."""
    if name == "muon":
        return MuonWithAdam(model, betas)
    return torch.optim.Adam(model.parameters(), lr=0.0, betas=betas)


def set_rate(optimizer, rate: float) -> None:
    """Set Adam's learning rate, and Muon's in proportion."""
    for group in optimizer.param_groups:
        group["lr"] = rate * group.get("share", 1.0)


class MuonWithAdam:
    """Muon (Jordan et al. 2024) for the weights of hidden layers, Adam for the rest.

    Muon moves a matrix along its orthogonalised momentum. PyTorch's takes 2D tensors only, so
    the kernel of a convolution is given to it as a copy of shape (out, in * height * width).
    """

    def __init__(self, model: nn.Module, betas: tuple[float, float]) -> None:
        self._weights = [
            layer.weight
            for layer in model.modules()
            if isinstance(layer, (nn.Linear, nn.Conv2d)) and min(layer.weight.shape[:2]) >= NARROW
        ]
        self._matrices = [nn.Parameter(w.detach().flatten(1).clone()) for w in self._weights]
        hidden = {id(weight) for weight in self._weights}
        self._rest = [p for p in model.parameters() if id(p) not in hidden]
        self._muon = torch.optim.Muon(
            self._matrices, lr=0.0, weight_decay=0.0, adjust_lr_fn="match_rms_adamw"
        )
        self._adam = torch.optim.Adam(self._rest, lr=0.0, betas=betas)
        for group in self._muon.param_groups:
            group["share"] = MUON_RATE

    @property
    def param_groups(self) -> list[dict]:
        return self._muon.param_groups + self._adam.param_groups

    def zero_grad(self, set_to_none: bool = True) -> None:
        for tensor in (*self._weights, *self._rest):
            tensor.grad = None

    @torch.no_grad()
    def step(self) -> None:
        for matrix, weight in zip(self._matrices, self._weights, strict=True):
            matrix.copy_(weight.flatten(1))  # loading a checkpoint changes the weight alone
            matrix.grad = weight.grad.flatten(1)
        self._muon.step()
        self._adam.step()
        for matrix, weight in zip(self._matrices, self._weights, strict=True):
            weight.copy_(matrix.view_as(weight))

    def state_dict(self) -> dict:
        return {"muon": self._muon.state_dict(), "adam": self._adam.state_dict()}

    def load_state_dict(self, state: dict) -> None:
        self._muon.load_state_dict(state["muon"])
        self._adam.load_state_dict(state["adam"])
