"""What happens where the GPU is full, or takes no buffer so large."""

from __future__ import annotations

import moderngl
import numpy as np
import pytest
from fields import random_field

from gsasr.errors import BackendError
from gsasr.rasterize import cells, gl, gl_index, reference, tiles
from gsasr.rasterize.gl_tile import allocate
from gsasr.rasterize.opengl import LEAST_STORAGE, with_room
from gsasr.view import View
from viewer.mipmaps import mipmaps
from viewer.source import BAND, Source

LIMIT = "GL_MAX_SHADER_STORAGE_BLOCK_SIZE"


class Thing:
    """A buffer or a texture that holds nothing."""

    def __init__(self, driver: Scarce, size: int) -> None:
        self.driver, self.size, self.released = driver, size, False

    def write(self, *_, **__) -> None:
        if self.driver.full_when_written:
            self.driver.errors.append("GL_OUT_OF_MEMORY")

    def bind_to_storage_buffer(self, *_) -> None:
        pass

    def release(self) -> None:
        assert not self.released
        self.released = True


class Scarce:
    """A context with room for so many buffers or textures; `raises` as moderngl sometimes does."""

    def __init__(self, room: int, raises: bool = False, errors: tuple[str, ...] = ()) -> None:
        self.info = {LIMIT: 1 << 27, "GL_MAX_TEXTURE_SIZE": 1 << 14}
        self.room, self.raises, self.errors = room, raises, list(errors)
        self.made: list[Thing] = []
        self.full_when_written = False

    def buffer(self, data=None, *, reserve: int = 0) -> Thing:
        return self._make(reserve if data is None else data.nbytes)

    def texture(self, size: tuple[int, int], components: int) -> Thing:
        return self._make(size[0] * size[1] * components)

    @property
    def error(self) -> str:
        return self.errors.pop(0) if self.errors else "GL_NO_ERROR"

    @property
    def held(self) -> int:
        return sum(not thing.released for thing in self.made)

    def _make(self, size: int) -> Thing:
        if self.held >= self.room:
            if self.raises:
                raise moderngl.Error("cannot create buffer")
            self.errors.append("GL_OUT_OF_MEMORY")
        self.made.append(Thing(self, size))
        return self.made[-1]


def test_a_real_driver_that_is_full_is_heard(gl_context):
    with pytest.raises(BackendError, match=r"out of memory; .* --backend cpu"):
        with_room(gl_context, gl_context.buffer, reserve=1 << 45)
    assert gl_context.error == "GL_NO_ERROR"


@pytest.mark.parametrize("raises", [False, True])
def test_of_several_buffers_all_are_made_or_none(raises):
    driver = Scarce(3, raises)
    sizes = [buffer.size for buffer in allocate(driver, [100, np.zeros(7, np.uint32), 0])]
    assert sizes == [100, 28, 32]
    driver = Scarce(2, raises)
    with pytest.raises(BackendError, match="out of memory"):
        allocate(driver, [100, np.zeros(7, np.uint32), 0, 5])
    assert driver.held == 0
    assert driver.errors == []


def test_errors_of_earlier_commands_are_not_blamed_on_the_next():
    driver = Scarce(1, errors=("GL_INVALID_VALUE", "GL_OUT_OF_MEMORY"))
    assert len(allocate(driver, [100])) == 1


def test_a_context_that_repeats_its_error_for_ever_does_not_stop_the_program():
    class Lost(Scarce):
        error = "GL_CONTEXT_LOST"

    assert len(allocate(Lost(1), [100])) == 1


def test_a_buffer_that_shaders_could_not_read_is_refused(gl_context, monkeypatch):
    monkeypatch.setitem(gl_context.info, LIMIT, LEAST_STORAGE)
    allocate(gl_context, [LEAST_STORAGE])[0].release()
    with pytest.raises(BackendError, match=r"16 MiB .* need 17 MiB; make smaller tiles"):
        allocate(gl_context, [32, LEAST_STORAGE + (1 << 20)])


@pytest.mark.parametrize(
    ("limit", "most"), [(1 << 27, tiles.MOST), (1 << 24, 139_810), (-1, 139_810), (1 << 31, None)]
)
def test_a_tile_holds_what_the_drivers_buffers_do(gl_context, monkeypatch, limit, most):
    monkeypatch.setitem(gl_context.info, LIMIT, limit)
    assert gl.GlRasterizer(gl_context).most == (most or tiles.MOST)


@pytest.mark.parametrize("quality", ["screen", "export"])
def test_no_buffer_of_a_tile_is_larger_than_is_reckoned(monkeypatch, quality):
    monkeypatch.setattr(cells, "SHORT", 1)  # so that entries are wide
    count = 20_000
    packed = tiles.pack(random_field(count, (100, 100), largest_std=1.5), quality)
    sizes = [a.nbytes for level in packed.levels for a in (level.lists, level.entries)]
    sizes.append(packed.records.data.nbytes)
    assert all(level.wide for level in packed.levels)
    reckoned = 4 * cells.ENTRIES_PER_GAUSSIAN * count
    assert 0.3 * reckoned < max(sizes) <= reckoned


def test_a_picture_is_drawn_in_tiles_that_the_driver_takes(gl_context, monkeypatch):
    monkeypatch.setattr(gl, "storage_limit", lambda _: 4 * cells.ENTRIES_PER_GAUSSIAN * 50)
    seen = []
    pack = gl.pack
    monkeypatch.setattr(gl, "pack", lambda part, *rest: seen.append(len(part)) or pack(part, *rest))
    monkeypatch.setattr(gl, "_headless", lambda: gl.GlRasterizer(gl.create_context(), index=False))
    field = random_field(230, (9, 9))
    view = View((0.0, 0.0), (4.0, 4.0), (36, 36))
    drawn = gl.render(field, view)
    assert seen[:4] == [50] * 4 and max(seen) == 50
    assert np.abs(drawn - reference.render(field, view).numpy()).max() < 1e-4


def test_sums_that_cannot_grow_stay_as_they_are(gl_context, monkeypatch):
    scan = gl_index.PrefixSum(gl_context)
    values = gl_context.buffer(np.ones(5000, np.uint32))
    scan.run(values, 0, 100)

    def refuse(*_):
        raise BackendError("Full.")

    with monkeypatch.context() as full:
        full.setattr(gl_index, "allocate", refuse)
        with pytest.raises(BackendError):
            scan.run(values, 0, 5000)
    values.write(np.ones(5000, np.uint32))
    scan.run(values, 0, 100)
    assert np.array_equal(np.frombuffer(values.read(400), np.uint32), np.arange(100))
    scan.release()


@pytest.mark.parametrize("raises", [False, True])
def test_a_picture_too_large_for_the_gpu_is_shown_coarsely(raises):
    pixels = np.zeros((1200, 1200, 4), np.uint8)
    levels = mipmaps(pixels)
    source = Source(driver := Scarce(len(levels.levels) - 1, raises), levels)
    assert source.loading
    with pytest.raises(BackendError, match="out of memory"):
        source.load(1.0)
    assert source.finest == 1
    assert not source.loading and not source.load(1.0)
    assert driver.held == len(levels.levels) - 1
    source.release()
    assert driver.held == 0


def test_a_band_of_a_picture_that_does_not_fit_is_told():
    levels = mipmaps(np.zeros((1000, 1000, 4), np.uint8))
    assert levels.levels[0].nbytes > 2 * BAND > 2 * levels.levels[1].nbytes
    source = Source(driver := Scarce(100), levels)
    assert not source.load(0.0)  # a first band
    driver.full_when_written = True
    with pytest.raises(BackendError):
        source.load(1.0)
    assert source.finest == 1 and not source.loading


def test_a_picture_for_which_there_is_no_room_at_all_leaves_nothing():
    driver = Scarce(3)
    with pytest.raises(BackendError):
        Source(driver, mipmaps(np.zeros((200, 200, 4), np.uint8)))
    assert driver.held == 0
