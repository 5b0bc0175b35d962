"""Rasterizers that draw the same field of Gaussians, to be measured side by side.

Ours and, to compare it with, what one would write first. Each is a class of contestant.py.
"""

from .cell_loop import CellLoop
from .contestant import Contestant
from .cpu import Cpu
from .ours import Ours
from .paper import Paper
from .quads import HalfQuads, Quads

CONTESTANTS: dict[str, type[Contestant]] = {
    contestant.name: contestant for contestant in (Ours, CellLoop, Quads, HalfQuads, Cpu, Paper)
}

__all__ = ["CONTESTANTS", "Contestant", "Ours"]
