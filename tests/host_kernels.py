"""CUDA kernels as a library for this host, launched as on a card."""

import ctypes
import re
import subprocess
from pathlib import Path
from shutil import which

import pytest

from gsasr.files import shipped
from gsasr.rasterize import cuda

OPTIONS = ["-shared", "-fPIC", "-O2", "-std=c++17", "-Wall", "-Werror", "-Wno-unknown-pragmas"]


def built(source: Path, folder: Path, extra: str = ""):
    """Compile a .cu file; returns its launch function, with the library as `.library`."""
    compiler = which("c++") or which("g++") or which("clang++")
    if compiler is None:
        pytest.skip("needs a C++ compiler")
    names = re.findall(r'extern "C" __global__ void (\w+)\(', source.read_text())
    calls = "".join(
        f'if (!std::strcmp(name, "{name}")) return run({name}, threads, a), 0;' for name in names
    )
    program = folder / f"{source.stem}.cpp"
    program.write_text(
        f'#include "host_kernels.h"\n#include "{source.name}"\n{extra}\n'
        f'extern "C" int launch(const char* name, long long threads, void** a)'
        f"{{{calls} return 1;}}"
    )
    library = program.with_suffix(".so")
    includes = [f"-I{path}" for path in (Path(__file__).parent, source.parent, shipped("shaders"))]
    subprocess.run([compiler, *OPTIONS, *includes, program, "-o", library], check=True)
    kernels = ctypes.CDLL(str(library))

    def launch(name: str, threads: int, *arguments) -> None:
        pointers, _keep = cuda.packed(arguments)
        assert kernels.launch(name.encode(), ctypes.c_longlong(threads), pointers) == 0, name

    launch.library = kernels
    return launch
