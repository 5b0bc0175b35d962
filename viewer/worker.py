"""One background thread: the window posts work, the work sends back what the window should do.

Only the window's thread touches OpenGL and the state; work therefore hands over what to do there,
which the window does between frames, a few steps at a time.
"""

from __future__ import annotations

import queue
import sys
import threading
import time
import traceback
from collections.abc import Callable, Generator

from gsasr.errors import Cancelled, GsasrError


class Task:
    """One piece of background work, as both threads see it.

    title: what to show while it runs; share: done so far in [0, 1], or None when unknown.
    """

    def __init__(self, title: str) -> None:
        self.title = title
        self.share: float | None = None
        self._cancelled = threading.Event()

    def cancel(self) -> None:
        """Ask the work to stop; it raises Cancelled at its next step."""
        self._cancelled.set()

    def cancelled(self) -> bool:
        """Was it asked to stop?"""
        return self._cancelled.is_set()

    def check(self) -> None:
        """Raise Cancelled if it was asked to stop."""
        if self.cancelled():
            raise Cancelled(f"{self.title} was cancelled.")

    def progress(self, share: float | None, title: str | None = None) -> None:
        """Tell the window how far it is."""
        self.share = share
        self.title = title or self.title


Action = Callable[[], None]
Work = Callable[[Task], None]


class Result:
    """What a task hands to the window's thread: steps to go through there."""

    def __init__(self, task: Task | None, steps: Generator[None, None, None]) -> None:
        self.task, self.steps = task, steps
        self.done = threading.Event()


class Worker:
    """Runs tasks one after another on one thread, and their results on the window's thread."""

    def __init__(self, on_error: Callable[[str], None]) -> None:
        """on_error: called on the window's thread with one sentence."""
        self.wake: Callable[[], None] = lambda: None  # called when the window has to look again
        self._on_error = on_error
        self._results: queue.SimpleQueue[Result] = queue.SimpleQueue()
        self._present: Result | None = None  # begun, and not at its end
        self._tasks: list[Task] = []  # running and waiting, oldest first
        self._queue: queue.SimpleQueue[tuple[Task, Work] | None] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._run, name="worker", daemon=True)
        self._thread.start()

    def post(self, title: str, work: Work) -> Task:
        """Run `work(task)` after what was posted before."""
        task = Task(title)
        with self._lock:
            self._tasks.append(task)
        self._queue.put((task, work))
        return task

    def show(self, task: Task | None, action: Action) -> None:
        """From the work: have the window's thread call `action`, unless cancelled by then."""
        self._put(Result(task, (action() for _ in range(1))))

    def carry_out(self, task: Task, steps: Generator[None, None, None]) -> None:
        """From the work: have the window's thread go through `steps`, over several frames.

        Returns at their end. Raises Cancelled if the task is, at once; the window's thread closes
        the steps only later, at its next `deliver`.
        """
        result = Result(task, steps)
        self._put(result)
        while not result.done.wait(0.1):
            task.check()
        task.check()

    @property
    def tasks(self) -> list[Task]:
        """Running and waiting tasks, oldest first."""
        with self._lock:
            return list(self._tasks)

    def cancel_all(self) -> None:
        """Ask everything, running or waiting, to stop."""
        for task in self.tasks:
            task.cancel()

    def deliver(self, seconds: float) -> bool:
        """On the window's thread: run results for about so long, at least one; True if any ran."""
        deadline = time.perf_counter() + seconds
        ran = False
        while not ran or time.perf_counter() < deadline:
            if self._present is None:
                try:
                    self._present = self._results.get_nowait()
                except queue.Empty:
                    break
            task, steps = self._present.task, self._present.steps
            if task is not None and task.cancelled():
                steps.close()
            else:
                ran = True
                try:
                    next(steps)
                    continue
                except StopIteration:
                    pass
                except GsasrError as error:
                    if task is not None:
                        task.cancel()
                    self._on_error(str(error))
            self._present.done.set()
            self._present = None
        return ran

    def stop(self, seconds: float = 2.0) -> None:
        """Cancel everything and wait for the thread, but no longer than so many seconds."""
        self.cancel_all()
        self._queue.put(None)
        self._thread.join(seconds)

    def _run(self) -> None:
        while (item := self._queue.get()) is not None:
            task, work = item
            try:
                task.check()
                work(task)
            except Cancelled:
                pass
            except GsasrError as error:
                self._fail(str(error))
            except MemoryError:
                self._fail("The memory does not suffice; close other programs or use less.")
            except Exception as error:  # a mistake of ours must not end the thread
                traceback.print_exc(file=sys.stderr)
                self._fail(f"{task.title} failed: {error or type(error).__name__}.")
            finally:
                with self._lock:
                    self._tasks.remove(task)
                self.wake()

    def _put(self, result: Result) -> None:
        self._results.put(result)
        self.wake()

    def _fail(self, sentence: str) -> None:
        self.show(None, lambda: self._on_error(sentence))
