"""Time and memory of a piece of work, for all benchmarks."""

from __future__ import annotations

import ctypes
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import torch


def median_seconds(work: Callable[[], object], repeats: int, device: str = "cpu") -> float:
    """Median wall time of `repeats` calls, after one that is not counted."""
    times = []
    for _ in range(repeats + 1):
        finish(device)
        start = time.perf_counter()
        work()
        finish(device)
        times.append(time.perf_counter() - start)
    return statistics.median(times[1:])


def finish(device: str) -> None:
    if device == "cuda":
        torch.cuda.synchronize()


def peak_memory(work: Callable[[], object], device: str = "cpu") -> int:
    """Bytes by which memory grows at most during the work; on the CPU, only Linux with glibc."""
    if device == "cuda":
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        work()
        return torch.cuda.max_memory_allocated() - before
    ctypes.CDLL(None).malloc_trim(0)  # what earlier work left in the heap would be used again
    Path("/proc/self/clear_refs").write_text("5")  # forget the highest resident size
    before = _resident("VmRSS")
    work()
    return max(0, _resident("VmHWM") - before)


def _resident(name: str) -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith(name))


def machine(device: str = "cpu") -> str:
    """What the figures were measured on."""
    if device == "cuda":
        return f"{torch.cuda.get_device_name()}, PyTorch {torch.__version__}"
    model = [
        line.partition(":")[2].strip()
        for line in Path("/proc/cpuinfo").read_text().splitlines()
        if line.startswith("model name")
    ]
    threads = torch.get_num_threads()
    name = model[0] if model else platform.processor()
    return f"{name}, {len(model)} cores, {threads} threads, PyTorch {torch.__version__}"
