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
FULL = "The GPU is out of memory; close other programs or use --backend cpu."
LEAST_STORAGE = 1 << 24  # bytes that any OpenGL 4.3 takes in a storage buffer
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


def storage_limit(ctx: moderngl.Context) -> int:
    """Bytes of the largest buffer that shaders can read."""
    # An answer of 2^31 or more would come as a negative number.
    return max(LEAST_STORAGE, ctx.info["GL_MAX_SHADER_STORAGE_BLOCK_SIZE"])


def with_room(ctx: moderngl.Context, work: Callable[..., T], *arguments, **named) -> T:
    """What `work(*arguments, **named)` makes or fills in video memory: a buffer, a texture.

    Raises BackendError if there is no room for it.
    """
    _errors(ctx)  # of earlier commands: those are not this one's
    try:
        made = work(*arguments, **named)
    except moderngl.Error as failure:
        raise BackendError(FULL) from failure
    if "GL_OUT_OF_MEMORY" in _errors(ctx):
        if made is not None:
            made.release()
        raise BackendError(FULL)
    return made


def _errors(ctx: moderngl.Context) -> set[str]:
    """All that the driver has noted since it was last asked."""
    noted: set[str] = set()
    while len(noted) < 8 and (error := ctx.error) != "GL_NO_ERROR":
        if error in noted:  # a context that is lost may repeat itself for ever
            break
        noted.add(error)
    return noted


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
