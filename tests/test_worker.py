"""What the worker hands to the window, step by step."""

from __future__ import annotations

import threading
import time

import pytest

from gsasr.errors import RequestError
from viewer.worker import Worker


@pytest.fixture
def worker():
    errors: list[str] = []
    made = Worker(errors.append)
    made.errors = errors
    yield made
    made.stop()


def deliver_until(worker: Worker, what) -> None:
    end = time.perf_counter() + 10
    while not what():
        assert time.perf_counter() < end, "waited too long"
        worker.deliver(0.001)
        time.sleep(0.001)


def test_steps_are_gone_through_over_several_frames_while_the_work_waits(worker):
    seen, done = [], threading.Event()

    def steps():
        for number in range(3):
            seen.append(number)
            time.sleep(0.002)  # longer than a frame has
            yield

    def work(task):
        worker.carry_out(task, steps())
        done.set()

    worker.post("", work)
    deliver_until(worker, lambda: seen)
    assert seen == [0] and not done.is_set()
    worker.deliver(0.001)
    assert seen == [0, 1] and not done.is_set()
    deliver_until(worker, done.is_set)
    assert seen == [0, 1, 2]


def test_steps_of_a_cancelled_task_are_closed(worker):
    events = []

    def steps():
        try:
            while True:
                events.append("step")
                time.sleep(0.002)
                yield
        finally:
            events.append("closed")

    task = worker.post("", lambda task: worker.carry_out(task, steps()))
    deliver_until(worker, lambda: events)
    task.cancel()
    deliver_until(worker, lambda: not worker.tasks and events[-1] == "closed")
    count = len(events)
    worker.deliver(0.01)
    assert len(events) == count and worker.errors == []


def test_an_error_on_the_windows_side_ends_the_task_in_a_sentence(worker):
    def fail():
        raise RequestError("No.")

    after = []

    def work(task):
        worker.show(task, fail)
        worker.carry_out(task, (None for _ in range(1)))
        after.append(True)

    worker.post("", work)
    deliver_until(worker, lambda: not worker.tasks)
    assert worker.errors == ["No."] and after == []
