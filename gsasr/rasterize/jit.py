"""How numba compiles our loops, and how several of them run at once."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import numba
import numpy as np

from ..processor import cores

_pool: ThreadPoolExecutor | None = None


def jit(function: Callable) -> Callable:
    """Compile on first call, release the GIL while running, and keep the code on disk if we can."""
    options = {"nogil": True, "fastmath": {"contract", "nsz"}}
    try:
        return numba.njit(function, cache=True, **options)
    except RuntimeError:  # neither the package's folder nor the user's cache can be written
        return numba.njit(function, **options)


def parts(length: int, small: bool = False) -> list[tuple[int, int]]:
    """[0, length) cut into parts for the threads; one part if the work is small."""
    bounds = np.linspace(0, length, (1 if small else 4 * cores()) + 1).astype(np.int64)
    return [(int(a), int(b)) for a, b in pairwise(bounds) if a < b]


def in_threads(kernel: Callable, calls: list[tuple]) -> None:
    """Call the kernel once per argument tuple, in parallel; it releases the GIL."""
    global _pool
    if len(calls) <= 1:
        for call in calls:
            kernel(*call)
        return
    if _pool is None:
        _pool = ThreadPoolExecutor(cores(), thread_name_prefix="kernels")
    for future in [_pool.submit(kernel, *call) for call in calls]:
        future.result()
