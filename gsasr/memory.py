"""Refusing work that cannot fit in memory before it starts, and telling when it did not."""

from __future__ import annotations

import os
from pathlib import Path

from .errors import RequestError


def available() -> int:
    """Bytes that can be had without swapping; all physical memory where the system won't say."""
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass
    if hasattr(os, "sysconf"):
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return 1 << 62


def require_picture(size: tuple[int, int]) -> None:
    """RequestError unless a picture of `size` (height, width) can be rendered and written."""
    # float32 RGBA, the clipped copy, and the bytes to write
    _require(size[0] * size[1] * 48, f"A {size[1]}x{size[0]} picture")


def require_field(count: int) -> None:
    """RequestError unless `count` Gaussians can be held, as tiles and then as one."""
    _require(count * 2 * 36, f"A field of {count:,} Gaussians")


def _require(needed: int, what: str) -> None:
    if needed > available():
        raise RequestError(
            f"{what} needs {needed / 2**30:.1f} GiB, but {available() / 2**30:.1f} GiB are free; "
            "use a smaller scale, region or picture."
        )


def out_of_memory(error: Exception) -> bool:
    """Whether this is how Python, PyTorch or its CPU allocator say that memory is exhausted."""
    # By name, since only those who have loaded PyTorch can have met its error.
    of_a_card = type(error).__name__ == "OutOfMemoryError"
    return isinstance(error, MemoryError) or of_a_card or "allocate memory" in str(error)
