"""OpenGL on this machine: contexts without a window, what the driver says of itself, shaders."""

from __future__ import annotations

import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import moderngl

from ..errors import BackendError
from ..files import shipped

T = TypeVar("T")
SOFTWARE = ("llvmpipe", "softpipe", "swrast", "software rasterizer", "swiftshader")


def load_shader(ctx: moderngl.Context, name: str, defines: dict[str, object] | None = None) -> str:
    """Source of shaders/`name` with `defines` after its version line; its includes are resolved."""
    for path in shipped("shaders").glob("*.glsl"):
        ctx.includes.setdefault(path.name, path.read_text())
    version, rest = shipped(f"shaders/{name}").read_text().split("\n", 1)
    lines = [version, *(f"#define {key} {value}" for key, value in (defines or {}).items()), rest]
    return "\n".join(lines)


def create_context() -> moderngl.Context:
    """A headless context of OpenGL 4.3 or later, current on the calling thread.

    Raises BackendError if there is none.
    """
    try:
        return moderngl.create_context(require=430, standalone=True, backend="egl")
    except Exception as failure:  # moderngl and glcontext raise bare Exception and ValueError
        raise BackendError(
            "No headless OpenGL 4.3 here; install a GPU driver or Mesa (libegl1 and "
            "libgl1-mesa-dri), or use --backend cpu."
        ) from failure


def ask(question: Callable[[moderngl.Context], T]) -> T:
    """What a headless context answers. Raises BackendError if there is none."""

    def answer() -> T:
        ctx = create_context()
        try:
            return question(ctx)
        finally:
            ctx.release()

    # On a thread of its own, as a new context would displace the caller's.
    with ThreadPoolExecutor(1, thread_name_prefix="gl-probe") as thread:
        return thread.submit(answer).result()


@functools.cache
def driver_info() -> dict:
    """What a headless context says of itself, by OpenGL's names. Raises BackendError if none."""
    return ask(lambda ctx: dict(ctx.info))


def software(info: dict) -> bool:
    """Whether a context with this `info` draws on the CPU."""
    return any(name in info["GL_RENDERER"].lower() for name in SOFTWARE)


@functools.cache
def hardware() -> bool:
    """Whether a headless OpenGL 4.3 device is here that is no software renderer. Never raises."""
    try:
        return not software(driver_info())
    except BackendError:
        return False
