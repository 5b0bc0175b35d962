"""Processes that help: how many, and how they are started."""

from __future__ import annotations

import multiprocessing
import os
import threading
from multiprocessing.context import BaseContext

from ..processor import cores


def default_workers(device: str, processes: int) -> int:
    """Processes that prepare crops, for each of the `processes` of a run on this machine.

    A card is fed by up to 8. A CPU has no core to spare, and crops take it little of a step.
    """
    return max(1, min(8, cores() // processes)) if device == "cuda" else 0


def fresh_processes(module: str) -> BaseContext:
    """How to start processes that will run code of `module`.

    They are forked from a server that has imported it and done nothing else, where there is such
    a thing: a fork of this process would inherit the locks of threads (CUDA, numba) that are not
    there any more.
    """
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([module])
    return context


def die_with_parent(*_: object) -> None:
    """Run first in such a process, so that it does not outlive a parent that is killed."""
    parent = multiprocessing.parent_process()

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
