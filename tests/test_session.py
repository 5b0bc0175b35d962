"""What the actions of the user do, without a window."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from fields import random_field

from gsasr import image
from gsasr.model import save_model
from viewer.loading import Loader
from viewer.mipmaps import mipmaps
from viewer.session import Session
from viewer.state import Document
from viewer.worker import Task


@pytest.fixture
def session():
    made = Session("lite", 3.0, gpu_memory=1 << 30)
    made.state.gpu_memory = 1 << 30
    made.streaming = SimpleNamespace(restart=lambda: None)
    yield made
    made.worker.stop()


def wait(what) -> None:
    end = time.perf_counter() + 10
    while not what():
        assert time.perf_counter() < end, "waited too long"
        time.sleep(0.001)


class Tiles:
    """Three tiles, of which one, when asked for, lets the user cancel."""

    cores = ((0, 0, 9, 9),) * 3
    count = 30

    def __init__(self, session: Session, cancelled_at: int | None) -> None:
        self.session, self.cancelled_at = session, cancelled_at
        self.asked: list[int] = []

    def gaussians(self, index: int):
        self.asked.append(index)
        if index == self.cancelled_at:
            self.session.worker.cancel_all()
        return random_field(10, (9, 9))


@pytest.mark.parametrize(("cancelled_at", "asked"), [(0, [0]), (2, [0, 1, 2]), (None, [0, 1, 2])])
def test_saving_a_field_can_be_cancelled_at_every_tile(session, tmp_path, cancelled_at, asked):
    tiles = Tiles(session, cancelled_at)
    session.state.document = SimpleNamespace(tiles=tiles, complete=True, path=Path("cat.png"))
    session.save_field(tmp_path / "cat.safetensors")
    wait(lambda: not session.worker.tasks)
    assert tiles.asked == asked
    assert (tmp_path / "cat.safetensors").exists() == (cancelled_at is None)


def test_another_document_has_the_whole_budget_though_the_gpu_was_full_before(session):
    session.scene = SimpleNamespace(show_picture=lambda levels: None)
    session.painter = SimpleNamespace(reset=lambda: None)
    pixels = np.zeros((8, 8, 4), np.uint8)
    session.state.gpu_memory = 0  # since the first upload failed
    session._show(Document(Path("other.png"), pixels), mipmaps(pixels))
    assert session.state.gpu_memory == 1 << 30


def test_a_document_changes_on_the_windows_thread_only(session, tiny_model, tmp_path, monkeypatch):
    monkeypatch.setattr(torch, "set_num_threads", lambda count: None)
    save_model(tiny_model, tmp_path / "tiny.safetensors")
    image.write(tmp_path / "picture.png", np.zeros((20, 30, 3), np.float32))
    document = Loader().open(Task(""), tmp_path / "picture.png")
    writers: set[threading.Thread] = set()

    class Watched(Document):
        def __setattr__(self, name: str, value: object) -> None:
            writers.add(threading.current_thread())
            super().__setattr__(name, value)

    session.state.document = Watched(document.path, document.pixels, document.picture)
    session.state.model = str(tmp_path / "tiny.safetensors")
    session.predict(2.0)
    wait(lambda: not session.worker.tasks)
    session.worker.deliver(1.0)
    document = session.state.document
    assert session.state.message is None and document.tiles is not None
    assert (document.model, document.condition) == ("tiny", 2.0)
    assert writers == {threading.current_thread()}
