"""How numba compiles our loops."""

from __future__ import annotations

from collections.abc import Callable

import numba


def jit(function: Callable) -> Callable:
    """Compile on first call, release the GIL while running, and keep the code on disk if we can."""
    options = {"nogil": True, "fastmath": {"contract", "nsz"}}
    try:
        return numba.njit(function, cache=True, **options)
    except RuntimeError:  # neither the package's folder nor the user's cache can be written
        return numba.njit(function, **options)
