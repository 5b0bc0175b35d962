"""What the driver is asked, by a driver that answers as those of several makers do."""

from __future__ import annotations

import ctypes
from types import SimpleNamespace

import pytest

from gsasr.rasterize import driver

KIB_OF_2_GIB = 2 << 20


class FakeDriver:
    """A context whose glGetIntegerv and glGetGraphicsResetStatus are ours."""

    def __init__(
        self, extensions=(), answers=None, renderer="A card", status=0, there=True, version=460
    ):
        def ask(name, where):
            ctypes.cast(where, ctypes.POINTER(ctypes.c_int))[0] = (answers or {}).get(name, 0)

        self.functions = {
            "glGetIntegerv": driver._SIGNATURE(None, ctypes.c_uint, ctypes.c_void_p)(ask),
            "glGetGraphicsResetStatus": driver._SIGNATURE(ctypes.c_uint)(lambda: status),
        }
        self.extensions = set(extensions)
        self.info = {"GL_RENDERER": renderer}
        self.version_code = version
        self.asked_for = []  # names of functions
        loader = SimpleNamespace(load=self.address) if there else SimpleNamespace()
        self.mglo = SimpleNamespace(_context=loader)

    def address(self, name: str) -> int:
        self.asked_for.append(name)
        return ctypes.cast(self.functions[name], ctypes.c_void_p).value


def test_nvidia_tells_what_there_is_and_what_is_free():
    ctx = FakeDriver(["GL_NVX_gpu_memory_info"], {0x9047: 4 * KIB_OF_2_GIB, 0x9049: KIB_OF_2_GIB})
    memory = driver.video_memory(ctx)
    assert (memory.total, memory.free) == (8 << 30, 2 << 30)
    assert (1 << 30) < memory.budget < (2 << 30)  # some is left for others


def test_amd_tells_what_is_free():
    memory = driver.video_memory(FakeDriver(["GL_ATI_meminfo"], {0x87FB: KIB_OF_2_GIB}))
    assert (memory.total, memory.free) == (None, 2 << 30)
    assert (1 << 30) < memory.budget < (2 << 30)


@pytest.mark.parametrize(
    "ctx",
    [
        FakeDriver(),
        FakeDriver(["GL_NVX_gpu_memory_info"]),  # that answers 0
        FakeDriver(["GL_NVX_gpu_memory_info"], {0x9049: KIB_OF_2_GIB}, there=False),
    ],
)
def test_where_nothing_is_told_there_is_a_default(ctx):
    assert driver.video_memory(ctx) == driver.VideoMemory(None, None, driver.UNKNOWN)


def test_software_uses_a_share_of_main_memory(monkeypatch):
    monkeypatch.setattr(driver, "available", lambda: 10 << 30)
    budget = driver.video_memory(FakeDriver(renderer="llvmpipe (LLVM 15)")).budget
    assert budget == int(driver.SOFTWARE_SHARE * (10 << 30))


def test_a_reset_is_told_from_none():
    assert driver.lost(FakeDriver(status=0x8253))
    assert not driver.lost(FakeDriver())
    assert not driver.lost(FakeDriver(status=0x8253, there=False))


def test_a_driver_that_promises_no_answer_is_not_asked():
    assert not driver.lost(FakeDriver(status=0x8253, version=440))
    assert driver.lost(FakeDriver(["GL_KHR_robustness"], status=0x8253, version=440))


def test_the_function_that_tells_of_resets_is_looked_up_once():
    ctx = FakeDriver()
    for _ in range(3):
        driver.lost(ctx)
    assert len(ctx.asked_for) == 1


def test_a_real_context_answers(gl_context):
    assert driver.video_memory(gl_context).budget >= driver.LEAST
    assert not driver.lost(gl_context)
    asked = driver._kibibytes(gl_context, 0x0D33)  # GL_MAX_TEXTURE_SIZE
    assert asked == 1024 * gl_context.info["GL_MAX_TEXTURE_SIZE"]
