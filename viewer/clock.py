"""How long the GPU takes over a piece of work, found out without waiting for it."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import moderngl

from gsasr.rasterize.opengl import software

LATE = 2  # frames after which a timer query is read: the GPU is hardly ever further behind


class Clock:
    """Times work in one OpenGL context.

    On a GPU by timer queries, read some frames later, so that neither side waits for the other. On
    software OpenGL by wall time up to a finish, which costs nothing there, as the CPU draws in any
    case: queries of llvmpipe do not see what they enclose (216 ms of a fragment shader
    are 8 ms to it, and compute shaders overflow them).
    """

    def __init__(self, ctx: moderngl.Context) -> None:
        self.software = software(ctx.info)
        self._ctx = ctx
        self._frame = 0
        self._running: deque[tuple[int, moderngl.Query, Callable[[float], None]]] = deque()
        self._idle: list[moderngl.Query] = []

    @contextmanager
    def measure(self, learn: Callable[[float], None]) -> Iterator[None]:
        """Time what is drawn within; `learn(seconds)` is called then or in a later frame."""
        if self.software:
            start = time.perf_counter()
            yield
            self._ctx.finish()
            learn(time.perf_counter() - start)
            return
        query = self._idle.pop() if self._idle else self._ctx.query(time=True)
        with query:
            yield
        self._running.append((self._frame, query, learn))

    def tick(self) -> None:
        """A new frame begins: hand out what has been measured."""
        self._frame += 1
        while self._running and self._running[0][0] <= self._frame - LATE:
            _, query, learn = self._running.popleft()
            learn(1e-9 * query.elapsed)
            self._idle.append(query)
