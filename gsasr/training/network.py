"""The network as it is trained: recomputed, compiled, shared between processes, as asked for."""

from __future__ import annotations

from functools import partial

import torch
from torch import nn
from torch.nn.parallel import DistributedDataParallel
from torch.utils.checkpoint import checkpoint

from ..errors import RequestError
from ..model import GSASR
from ..model.decoder import HEADS, CrossLayer, SelfLayer
from ..model.encoders.edsr import ResidualBlock
from ..model.encoders.hat import HybridBlock
from ..model.encoders.rdn import ResidualDenseBlock
from ..model.encoders.swinir import SwinBlock
from .config import Execution
from .parallel import Group

RECOMPUTED = (ResidualBlock, ResidualDenseBlock, SwinBlock, HybridBlock, CrossLayer, SelfLayer)
"""Blocks of which gradient checkpointing keeps the inputs only; so it does for the heads."""


def trainable(model: GSASR, execution: Execution, group: Group) -> nn.Module:
    """What to call instead of `model` while training; the weights are the model's own."""
    if execution.recompute:
        recompute(model)
    network: nn.Module = Compiled(model) if execution.compile else model
    if group.size == 1:
        return network
    devices = [group.device] if group.device.type == "cuda" else None
    return DistributedDataParallel(network, device_ids=devices)


def recompute(model: GSASR) -> None:
    """From now on compute the insides of blocks again in the backward pass, to save memory."""
    heads = {model.decoder.get_submodule(f"mlp_block_{name}") for name in HEADS}
    for module in model.modules():
        if isinstance(module, RECOMPUTED) or module in heads:
            module.forward = partial(checkpoint, module.forward, use_reentrant=False)


class Compiled(nn.Module):
    """A network through torch.compile; what the compiler fails with becomes one sentence."""

    def __init__(self, model: GSASR) -> None:
        super().__init__()
        self.model = model
        self._call = torch.compile(model.forward)

    def forward(self, *inputs: torch.Tensor) -> torch.Tensor:
        try:
            return self._call(*inputs)
        except Exception as error:
            if type(error).__module__.startswith(("torch._dynamo", "torch._inductor")):
                reason = str(error).strip().splitlines()[0]
                raise RequestError(
                    f"torch.compile fails here ({reason}); leave out --compile, or install what "
                    "it needs: a C++ compiler, on CUDA also Triton."
                ) from error
            raise
