"""What a driver says that moderngl does not ask: how much video memory, and whether it was reset.

For any context of moderngl, on the thread where it is current.
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import moderngl

from ..memory import available
from .opengl import software

NVX_DEDICATED, NVX_FREE = 0x9047, 0x9049  # GL_NVX_gpu_memory_info, KiB
ATI_FREE = 0x87FB  # GL_ATI_meminfo, for buffers: four numbers, the first is what is free, KiB
UNKNOWN = 1 << 30  # bytes of tiles to hold where the driver does not tell
LEAST = 1 << 28
SHARE = 0.7  # of what is free on a card; other programs, and our textures, need some
SOFTWARE_SHARE = 0.2  # of free main memory, where that is what the renderer uses

# How each context is asked whether it was reset, if it can be asked; every frame does
_reset_status: WeakKeyDictionary[moderngl.Context, Callable[[], int] | None] = WeakKeyDictionary()

_SIGNATURE = ctypes.WINFUNCTYPE if sys.platform == "win32" else ctypes.CFUNCTYPE


@dataclass(frozen=True)
class VideoMemory:
    """Bytes. total, free: as the driver tells, or None; budget: how much to fill with tiles."""

    total: int | None
    free: int | None
    budget: int


def video_memory(ctx: moderngl.Context) -> VideoMemory:
    """What there is for tiles of Gaussians; the driver is asked where it can tell."""
    total = free = None
    if "GL_NVX_gpu_memory_info" in ctx.extensions:
        total, free = _kibibytes(ctx, NVX_DEDICATED), _kibibytes(ctx, NVX_FREE)
    elif "GL_ATI_meminfo" in ctx.extensions:
        free = _kibibytes(ctx, ATI_FREE)
    if free is not None:
        return VideoMemory(total, free, max(LEAST, int(SHARE * free)))
    if software(ctx.info):
        return VideoMemory(None, None, max(LEAST, int(SOFTWARE_SHARE * available())))
    return VideoMemory(None, None, UNKNOWN)


def lost(ctx: moderngl.Context) -> bool:
    """Has the driver been reset, so that nothing drawn or stored in this context is left?

    Only a context made with notification of resets can tell; any other says False.
    """
    if ctx not in _reset_status:
        # Without these a loader may have an address all the same, of a function that does nothing.
        can_tell = ctx.version_code >= 450 or "GL_KHR_robustness" in ctx.extensions
        _reset_status[ctx] = (
            _function(ctx, "glGetGraphicsResetStatus", ctypes.c_uint) if can_tell else None
        )
    status = _reset_status[ctx]
    return status is not None and status() != 0


def _kibibytes(ctx: moderngl.Context, name: int) -> int | None:
    """An answer in KiB as bytes, or None if there is none."""
    ask = _function(ctx, "glGetIntegerv", None, ctypes.c_uint, ctypes.c_void_p)
    if ask is None:
        return None
    answer = (ctypes.c_int * 4)()
    ask(name, answer)
    return answer[0] * 1024 if answer[0] > 0 else None


def _function(ctx: moderngl.Context, name: str, *signature):
    """An OpenGL function (result, arguments), or None where it is not to be had."""
    # moderngl offers no other way to the loader of its context, of which it has two kinds.
    loader = getattr(ctx.mglo, "_context", None)
    load = getattr(loader, "load", None) or getattr(loader, "load_opengl_function", None)
    address = load(name) if load is not None else 0
    return _SIGNATURE(*signature)(address) if address else None
