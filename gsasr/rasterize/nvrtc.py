"""kernels.cu compiled for one kind of card, by NVIDIA's run-time compiler, and kept on disk.

NVRTC comes with PyTorch's CUDA wheels, or with `pip install 'gsasr[cuda]'`; no CUDA toolkit is
needed, and no GPU: code for any card can be compiled anywhere.
"""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

from ..errors import BackendError
from ..files import shipped, writing

OLDEST = 75  # compute capability times ten (Turing), the oldest that CUDA 13 compiles for


def compiled(capability: int, source: Path | None = None) -> bytes:
    """Machine code (cubin) of a .cu file for cards of a compute capability such as 90.

    A card newer than the compiler knows gets intermediate code (PTX), which its driver
    translates. source: by default the rasterizer's kernels.cu; it may include gaussian.glsl.

    Raises BackendError for a card that is too old, or if NVRTC is not installed.
    """
    architectures = supported()
    target = _target(capability, architectures)
    source = source or Path(__file__).with_name("kernels.cu")
    code, formula = source.read_bytes(), shipped("shaders/gaussian.glsl").read_bytes()
    options = [f"--gpu-architecture={target}", "--std=c++17", "--ftz=true"]
    parts = [code, formula, repr((options, _version())).encode()]
    name = hashlib.sha256(b"\0".join(parts)).hexdigest()[:32]
    file = _cache() / f"{source.stem}-{name}"
    if file.is_file():
        return file.read_bytes()
    binary = _compile(source.name, code, formula, options)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with writing(file, BackendError) as beside:
            beside.write_bytes(binary)
    except (OSError, BackendError):
        pass  # a cache that cannot be written costs a second per start, no more
    return binary


def supported() -> list[int]:
    """Compute capabilities, times ten, that this NVRTC compiles for. Raises BackendError."""
    return list(_call("nvrtcGetSupportedArchs"))


def _version() -> tuple[int, int]:
    return tuple(_call("nvrtcVersion", results=2))


def _target(capability: int, architectures: list[int]) -> str:
    """The --gpu-architecture for a card: its own, its family's, or the newest there is."""
    oldest = max(OLDEST, min(architectures))
    if capability < oldest:
        raise BackendError(
            f"This card has compute capability {capability / 10:.1f}, but the kernel needs "
            f"{oldest / 10:.1f} or newer; use --backend gl or cpu, or --device cpu."
        )
    # Machine code runs on later cards of the same major version, PTX on all later cards.
    older = [a for a in architectures if a <= capability]
    family = [a for a in older if a // 10 == capability // 10]
    return f"sm_{max(family)}" if family else f"compute_{max(older)}"


def _compile(name: str, code: bytes, formula: bytes, options: list[str]) -> bytes:
    program = _call("nvrtcCreateProgram", code, name.encode(), 1, [formula], [b"gaussian.glsl"])
    nvrtc = _library()
    encoded = [option.encode() for option in options]
    status, *_ = nvrtc.nvrtcCompileProgram(program, len(encoded), encoded)
    if status != nvrtc.nvrtcResult.NVRTC_SUCCESS:
        log = bytearray(_call("nvrtcGetProgramLogSize", program))
        _call("nvrtcGetProgramLog", program, log, results=0)
        raise BackendError(f"NVRTC cannot compile {name}: {log.decode(errors='replace').strip()}")
    kind = "CUBIN" if options[0].partition("=")[2].startswith("sm_") else "PTX"
    binary = bytearray(_call(f"nvrtcGet{kind}Size", program))
    _call(f"nvrtcGet{kind}", program, binary, results=0)
    _call("nvrtcDestroyProgram", program, results=0)
    return bytes(binary)


def _cache() -> Path:
    root = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(root) / "gsasr"


def _library():
    try:
        from cuda.bindings import nvrtc
    except ImportError as error:
        raise BackendError(
            "The cuda backend needs NVIDIA's run-time compiler; "
            "run `pip install 'gsasr[cuda]'`, or use --backend gl or cpu, or --device cpu."
        ) from error
    return nvrtc


def _call(function: str, *arguments, results: int = 1):
    """One NVRTC call: its result, a tuple of several, or None. Raises BackendError."""
    nvrtc = _library()
    try:
        status, *values = getattr(nvrtc, function)(*arguments)
    except RuntimeError as error:  # the bindings are there, the library is not
        raise BackendError(
            "NVIDIA's run-time compiler (libnvrtc) was not found; "
            "run `pip install 'gsasr[cuda]'`, or use --backend gl or cpu, or --device cpu."
        ) from error
    if status != nvrtc.nvrtcResult.NVRTC_SUCCESS:
        raise BackendError(
            f"{function} failed with {status.name}; use --backend gl or cpu, or --device cpu."
        )
    return values[0] if results == 1 else values or None
