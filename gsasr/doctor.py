"""What this machine has for GSASR, and what to do about what is missing: `gsasr doctor`."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from .errors import BackendError
from .processor import cores

if TYPE_CHECKING:
    from .rasterize.driver import VideoMemory

# What the rasterizer minds: name in OpenGL -> what it is called here, unit
GL_LIMITS = {
    "GL_MAX_COMPUTE_WORK_GROUP_INVOCATIONS": ("work group", "threads"),
    "GL_MAX_SHADER_STORAGE_BLOCK_SIZE": ("storage block", "bytes"),
    "GL_MAX_TEXTURE_SIZE": ("texture side", "pixels"),
}


@dataclass(frozen=True)
class Finding:
    """One line. advice: what to do about it; empty if nothing needs doing."""

    name: str
    value: str
    advice: str = ""


def examine() -> Iterator[Finding]:
    """All findings, one after another; none of them raises."""
    for check in (_python, _torch, _numba, _opengl, _window, _cuda):
        yield from check()


def _python() -> Iterator[Finding]:
    yield Finding("gsasr", f"{importlib.metadata.version('gsasr')}, Python {_version()}")
    yield Finding("system", f"{platform.platform()}, {cores()} cores for this process")


def _version() -> str:
    return f"{platform.python_version()} ({platform.machine()})"


def _torch() -> Iterator[Finding]:
    import torch

    build = f"CUDA {torch.version.cuda}" if torch.version.cuda else "CPU build"
    yield Finding("PyTorch", f"{torch.__version__}, {build}, {torch.get_num_threads()} threads")
    if not hasattr(torch.cpu, "get_capabilities"):
        return  # an older PyTorch cannot tell
    able = torch.cpu.get_capabilities()
    fast = any(able.get(name) for name in ("avx512_bf16", "amx_bf16", "amx_tile", "bf16"))
    yield Finding(
        "bfloat16 on the CPU",
        "in hardware" if fast else "emulated",
        "" if fast else "--precision bfloat16 will be slow here",
    )


def _numba() -> Iterator[Finding]:
    import numba

    yield Finding("numba", f"{numba.__version__}, --backend cpu")


def _opengl() -> Iterator[Finding]:
    from .rasterize import driver, opengl

    try:
        info = opengl.driver_info()
    except BackendError as error:
        yield Finding("OpenGL", "none", str(error))
        return
    software = opengl.software(info)
    kind = "software" if software else "hardware"
    advice = "if this machine has a GPU, install its driver" if software else ""
    yield Finding("OpenGL", f"{info['GL_VERSION']}, {info['GL_RENDERER']} ({kind})", advice)
    limits = (f"{name} {info[key]:,} {unit}" for key, (name, unit) in GL_LIMITS.items())
    yield Finding("OpenGL limits", "; ".join(limits))
    yield Finding("GPU memory", _memory(opengl.ask(driver.video_memory)))
    yield _shaders()


def _shaders() -> Finding:
    """Compiled as the viewer needs them; drivers keep them on disk, so its next start has them."""
    import moderngl

    from .rasterize import gl, opengl

    start = time.perf_counter()
    try:
        opengl.ask(lambda ctx: gl.GlRasterizer(ctx).warm_up())
    except (BackendError, moderngl.Error) as error:
        reason = str(error).strip().splitlines()[-1]
        return Finding("OpenGL shaders", reason, "update the driver, or use --backend cpu")
    return Finding("OpenGL shaders", f"compiled in {time.perf_counter() - start:.2f} s")


def _memory(memory: VideoMemory) -> str:
    told = [
        f"{size / 2**30:.1f} GiB {what}"
        for what, size in (("in all", memory.total), ("free", memory.free))
        if size is not None
    ]
    told = told or ["the driver does not tell"]
    return f"{', '.join(told)}; the viewer fills up to {memory.budget / 2**30:.1f} GiB"


def _window() -> Iterator[Finding]:
    if platform.system() != "Linux":
        return
    display = os.environ.get("WAYLAND_DISPLAY") or os.environ.get("DISPLAY")
    advice = "" if display else "the viewer needs a display; without one use --snapshot"
    yield Finding("display", display or "none", advice)


def _cuda() -> Iterator[Finding]:
    import torch

    from .rasterize import cuda, nvrtc

    try:
        architectures = nvrtc.supported()
        yield Finding(
            "NVRTC", f"compiles for compute capability {_span(architectures)}, --backend cuda"
        )
    except BackendError as error:
        yield Finding("NVRTC", "none", str(error) if torch.cuda.is_available() else "")
    if not torch.cuda.is_available():
        yield Finding("CUDA", "no GPU that PyTorch can use")
        return
    for index in range(torch.cuda.device_count()):
        card = torch.cuda.get_device_properties(index)
        value = f"{card.name}, {card.total_memory / 2**30:.0f} GiB, {card.major}.{card.minor}"
        try:
            cuda.kernels(torch.device("cuda", index))
            yield Finding(f"CUDA {index}", value)
        except BackendError as error:
            yield Finding(f"CUDA {index}", value, str(error))


def _span(architectures: list[int]) -> str:
    low, high = min(architectures) / 10, max(architectures) / 10
    return f"{low:.1f} to {high:.1f}"


def report(told: Callable[[str], None] = print) -> None:
    """Print all findings, as they come."""
    for finding in examine():
        told(f"{finding.name + ':':<22} {finding.value}")
        if finding.advice:
            told(f"{'':<22} -> {finding.advice}")
