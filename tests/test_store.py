"""Which tile is fetched next, which goes, and that what came once is not predicted again."""

from __future__ import annotations

import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from fields import one, random_field

from gsasr.errors import BackendError, CheckpointError, FieldError
from gsasr.gaussians import Gaussians
from gsasr.view import View
from viewer.camera import Camera
from viewer.state import State
from viewer.store import TileStore
from viewer.streaming import Streaming
from viewer.worker import Worker

SIDE = 100
COUNT = 50  # Gaussians of a tile
BYTES = 1000  # of a tile on the GPU
CODED = 24 * COUNT


def cores(columns: int, rows: int = 1) -> list[tuple[int, int, int, int]]:
    return [
        (SIDE * x, SIDE * y, SIDE * (x + 1), SIDE * (y + 1))
        for y in range(rows)
        for x in range(columns)
    ]


class Network:
    """Makes Gaussians in the middle of a tile, and remembers of which."""

    def __init__(self, tiles: list[tuple[int, int, int, int]]) -> None:
        self.tiles = tiles
        self.asked: list[int] = []

    def __call__(self, index: int) -> Gaussians:
        self.asked.append(index)
        x, y = self.tiles[index][:2]
        field = random_field(COUNT, (10, 10))
        return Gaussians(
            **field.tensors() | {"mean": field.mean + field.mean.new_tensor([x, y])},
            size=(SIDE, SIDE * len(self.tiles)),
        )


def make_store(columns: int, rows: int = 1, memory: int = 1 << 30) -> tuple[TileStore, Network]:
    network = Network(cores(columns, rows))
    return TileStore(network.tiles, network, memory), network


def at(x: float, y: float = SIDE / 2, scale: float = 10.0, sides: float = 40) -> View:
    """A view of `sides` source pixels about a point."""
    size = round(sides * scale)
    return View((x - sides / 2, y - sides / 2), (scale, scale), (size, size))


def fetch_all(
    store: TileStore, view: View, budget: int, eager: bool = True, most: int = 1000
) -> list[tuple[int, bool]]:
    """What the worker and the window do together; the steps taken."""
    steps = []
    store.touch(view)
    while (wanted := store.next(view, budget, eager)) is not None:
        assert len(steps) < most, "never ends"
        steps.append(wanted)
        index, shown = wanted
        gaussians = store.gaussians(index)
        if not store.holds(index):
            store.keep(index, gaussians, view)
        if shown:
            store.show(index, BYTES)
            store.touch(view)
            store.evict(view, budget)
    return steps


def shown(store: TileStore) -> list[int]:
    return np.flatnonzero(store._shown).tolist()


def test_what_the_view_needs_comes_first_and_the_nearest_of_it():
    store, network = make_store(10)
    steps = fetch_all(store, at(430, sides=300), 100 * BYTES)
    assert network.asked[:4] == [4, 3, 5, 2]  # their middles lie at 450, 350, 550, 250
    assert steps == [(index, True) for index in network.asked]
    assert sorted(network.asked) == list(range(10)) and store.complete


def test_the_rest_comes_nearest_first():
    store, network = make_store(9)
    fetch_all(store, at(20), 100 * BYTES)
    assert network.asked == list(range(9))


def test_what_is_needed_takes_precedence_as_soon_as_the_view_moves():
    store, _ = make_store(20)
    for _ in range(3):
        index, _ = store.next(at(50), 100 * BYTES)
        store.keep(index, store.gaussians(index), at(50))
        store.show(index, BYTES)
    assert store.next(at(50), 100 * BYTES) == (3, True)
    assert store.next(at(1750), 100 * BYTES) == (17, True)


def test_not_eager_only_what_the_view_needs():
    store, network = make_store(10)
    fetch_all(store, at(450), 100 * BYTES, eager=False)
    assert network.asked == [4]


def test_below_one_to_one_the_source_is_enough():
    store, network = make_store(10)
    fetch_all(store, at(450, scale=1.0), 100 * BYTES, eager=False)
    assert network.asked == []


def test_beyond_the_gpu_budget_tiles_are_predicted_for_later():
    store, _ = make_store(6)
    steps = fetch_all(store, at(50), 3 * BYTES)
    assert [shown for _, shown in steps] == [True] * 3 + [False] * 3
    assert shown(store) == [0, 1, 2] and store.complete


def test_the_least_recently_seen_goes_first_and_never_what_is_in_view():
    store, _ = make_store(8)
    budget = 3 * BYTES
    for x in (50, 250, 450, 50, 650):  # after the return to 50, tile 2 is the oldest
        fetch_all(store, at(x), budget, eager=False)
    assert shown(store) == [0, 4, 6]
    fetch_all(store, at(700), budget, eager=False)  # needs 6 and 7
    assert shown(store) == [0, 6, 7]


def test_coming_back_is_no_second_prediction():
    store, network = make_store(12)
    budget = 2 * BYTES
    for x in (50, 650, 1150, 50, 650):
        fetch_all(store, at(x), budget, eager=False)
    assert network.asked == [0, 6, 11]


def test_where_the_view_alone_is_too_much_the_farthest_are_left_out():
    store, network = make_store(11)
    fetch_all(store, at(550, sides=900), 4 * BYTES, eager=False)
    assert shown(store) == [3, 4, 5, 6]
    assert sorted(network.asked) == [3, 4, 5, 6]


def test_a_smaller_budget_takes_effect_at_once():
    store, _ = make_store(9)
    view = at(450)
    fetch_all(store, view, 100 * BYTES)
    store.touch(view)
    gone = store.evict(view, 2 * BYTES)
    assert len(gone) == 7 and 4 in shown(store) and len(shown(store)) == 2
    assert {0, 8} <= set(gone[:2])  # never seen, and the farthest


def test_main_memory_keeps_what_is_nearest_to_the_view():
    store, network = make_store(10, memory=3 * CODED + CODED // 2)
    view = at(50)
    fetch_all(store, view, 100 * BYTES)
    assert network.asked == [0, 1, 2]  # the rest would not fit
    assert store.coded_bytes <= 3 * CODED + CODED // 2
    fetch_all(store, at(950), 100 * BYTES)
    assert store.holds(9) and not store.holds(0)  # the farthest went
    assert store.coded_bytes <= 3 * CODED + CODED // 2
    assert not store.complete


def test_what_was_dropped_from_memory_is_predicted_again():
    store, network = make_store(10, memory=2 * CODED + CODED // 2)
    for x in (50, 950, 50):
        fetch_all(store, at(x), BYTES, eager=False)
    assert network.asked == [0, 9]  # both copies fit
    fetch_all(store, at(550), BYTES, eager=False)
    far = [index for index in (0, 9) if not store.holds(index)]
    assert len(far) == 1
    fetch_all(store, at(100 * far[0] + 50), BYTES, eager=False)
    assert network.asked == [0, 9, 5, far[0]]


@pytest.mark.parametrize("budget", [0, 1, BYTES // 2, BYTES - 1])
def test_without_room_for_a_single_tile_it_ends(budget):
    store, network = make_store(5)
    fetch_all(store, at(250), budget)
    assert shown(store) == []
    assert sorted(network.asked) == list(range(5))


def test_tiles_that_are_larger_than_was_expected_do_not_go_in_circles():
    store, _ = make_store(40)
    budget, view, sizes = 5000, at(2000, sides=3000), {}
    for _ in range(200):
        wanted = store.next(view, budget)
        if wanted is None:
            break
        index, show = wanted
        store.keep(index, store.gaussians(index), view)
        if show:
            assert sizes.setdefault(index, 300 * (1 + index % 7)) == 300 * (1 + index % 7)
            store.show(index, sizes[index])
            store.evict(view, budget)
        assert store.shown_bytes <= budget
    else:
        pytest.fail("never ends")


def test_a_saved_field_is_never_dropped():
    store = TileStore(cores(4), None, memory=1)
    network = Network(store.cores)
    for index in range(4):
        store.keep(index, network(index))
    assert store.complete and store.count == 4 * COUNT


def test_gaussians_that_reach_far_are_needed_far():
    store = TileStore(cores(10), None)
    for index in range(10):
        std = 200.0 if index == 0 else 0.5
        store.keep(index, one((100.0 * index + 50, 50.0), (std, std)))
    assert store.visible(at(450)) == [4, 0]
    assert fetch_all(store, at(450), 100 * BYTES, eager=False) == [(4, True), (0, True)]


def test_a_tile_in_which_nothing_is_drawn_is_needed_only_where_it_lies():
    store = TileStore(cores(10), None)
    for index in range(10):
        color = (0.0, 0.0, 0.0) if index == 7 else (1.0, 1.0, 1.0)
        store.keep(index, one((100.0 * index + 50, 50.0), (0.5, 0.5), color=color))
    assert store.visible(at(50)) == [0]
    assert store.visible(at(750)) == [7]


class FakeScene:
    """A GPU with room for so many tiles."""

    packs = True
    most = 1000

    def __init__(self, room: int) -> None:
        self.room = room
        self.there: set = set()
        self.arriving = 0

    def prepare(self) -> None:
        pass

    def adding(self, piece):
        yield
        if len(self.there) >= self.room:
            raise BackendError("full")
        self.arriving += 1

    def cover(self, core) -> int:
        self.there.add(core)
        self.arriving = 0
        return BYTES

    def uncover(self, core) -> None:
        self.there.remove(core)

    def drop_arriving(self) -> None:
        self.arriving = 0

    def clear_tiles(self) -> None:
        self.there.clear()


class FakePainter:
    def invalidate(self, rows=None) -> None:
        pass


class Rig:
    """A window of 400x400 pixels without OpenGL, that streams the tiles of a store."""

    def __init__(self, store: TileStore, scene: FakeScene) -> None:
        self.messages: list[str] = []
        self.worker = Worker(self.messages.append)
        self.state, self.camera = State(gpu_memory=100 * BYTES), Camera()
        self.state.document = SimpleNamespace(tiles=store, path=Path("picture.png"))
        self.streaming = Streaming(
            self.state, self.camera, self.worker, scene, FakePainter(), self.messages.append
        )
        self.camera.resize(400, 400)
        self.camera.set_picture((SIDE, len(store.cores) * SIDE))

    def frame(self) -> None:
        self.worker.deliver(0.001)
        self.streaming.follow()
        time.sleep(0.001)

    def wait(self, what, act=lambda: time.sleep(0.001)) -> None:
        """Do `act` until `what()`."""
        end = time.perf_counter() + 10
        while not what():
            assert time.perf_counter() < end, "waited too long"
            act()


@pytest.fixture
def make_rig():
    made: list[Rig] = []

    def make(store: TileStore, scene: FakeScene) -> Rig:
        made.append(Rig(store, scene))
        return made[-1]

    yield make
    for rig in made:
        rig.worker.stop()


def test_malformed_gaussians_are_told_once_and_not_fetched_again_before_the_view_moves(make_rig):
    class Malformed(FakeScene):
        packs = False  # so Gaussians are packed, and found to be malformed, as they are added
        tried = 0

        def adding(self, piece):
            yield
            self.tried += 1
            raise FieldError("malformed")

    store, _ = make_store(10)
    scene = Malformed(room=4)
    rig = make_rig(store, scene)
    rig.camera.look_at(50, 50, 4.0)
    rig.wait(lambda: rig.messages, rig.frame)
    for _ in range(50):
        rig.frame()
    assert rig.messages == ["malformed"] and scene.tried == 1 and not rig.worker.tasks
    assert not store.any_shown
    rig.camera.look_at(950, 50, 4.0)
    rig.wait(lambda: scene.tried == 2, rig.frame)


def test_what_failed_is_not_fetched_again_by_a_frame_that_has_not_heard_of_it(make_rig):
    asked = []

    def fail(index: int):
        asked.append(index)
        raise CheckpointError("No.")

    rig = make_rig(TileStore(cores(10), fail, 1 << 30), FakeScene(room=4))
    rig.streaming.follow()
    rig.wait(lambda: asked, lambda: rig.worker.deliver(0.001))
    rig.wait(lambda: not rig.worker.tasks)
    rig.streaming.follow()  # nothing was delivered meanwhile
    assert not rig.worker.tasks and len(asked) == 1
    rig.worker.deliver(1.0)
    assert rig.messages == ["No."]


def test_a_gpu_with_no_room_at_all_is_told_in_a_sentence_that_makes_sense(make_rig):
    store, _ = make_store(10)
    rig = make_rig(store, FakeScene(room=0))
    rig.camera.look_at(50, 50, 4.0)
    rig.wait(lambda: rig.messages, rig.frame)
    rig.wait(lambda: store.complete, rig.frame)
    assert len(rig.messages) == 1 and "no room for any Gaussians" in rig.messages[0]


def test_a_full_gpu_makes_the_budget_smaller_and_says_so_and_goes_on(make_rig):
    store, network = make_store(10)
    scene = FakeScene(room=4)
    rig = make_rig(store, scene)
    state, camera, streaming, messages = rig.state, rig.camera, rig.streaming, rig.messages

    def work() -> None:
        while (wanted := streaming._next(store)) is not None:
            index, show = wanted
            store.keep(index, store.gaussians(index), camera.view())
            if show:
                for _ in streaming._arrive(store, index, ["one piece"]):
                    pass
                assert scene.arriving == 0
                assert len(scene.there) == len(shown(store)) <= 4

    camera.look_at(50, 50, 4.0)
    work()
    assert state.gpu_memory == int(0.9 * 4 * BYTES)
    assert len(messages) == 1 and "room" in messages[0]
    assert store.complete and network.asked == sorted(set(network.asked))
    camera.look_at(950, 50, 4.0)
    work()
    assert store.cores[9] in scene.there
    assert len(messages) == 1  # the smaller budget is kept to
