"""`gsasr doctor` says what there is, and what to do about what is missing."""

import moderngl
import pytest

from gsasr import doctor
from gsasr.errors import BackendError
from gsasr.rasterize import nvrtc, opengl


def findings() -> dict[str, doctor.Finding]:
    return {finding.name: finding for finding in doctor.examine()}


def test_everything_that_is_here_is_named_with_its_version():
    import numba
    import torch

    found = findings()
    assert torch.__version__ in found["PyTorch"].value
    assert numba.__version__ in found["numba"].value
    assert {"gsasr", "system", "OpenGL", "NVRTC"} <= found.keys()


def test_the_limits_of_opengl_are_asked_of_the_driver(gl_context):
    found = findings()
    assert gl_context.info["GL_RENDERER"] in found["OpenGL"].value
    assert f"{gl_context.info['GL_MAX_TEXTURE_SIZE']:,} pixels" in found["OpenGL limits"].value
    assert "the viewer fills up to" in found["GPU memory"].value


def test_shaders_that_a_driver_refuses_are_a_finding(gl_context, monkeypatch):
    assert "compiled in" in findings()["OpenGL shaders"].value

    def refuse(*_):
        raise moderngl.Error("GLSL Compiler failed\n\n0:1(1): error: no")

    monkeypatch.setattr("gsasr.rasterize.gl.GlRasterizer.warm_up", refuse)
    found = findings()["OpenGL shaders"]
    assert found.value == "0:1(1): error: no" and "driver" in found.advice


def test_what_is_missing_comes_with_advice(monkeypatch):
    def missing(*_):
        raise BackendError("Not here; install it.")

    monkeypatch.setattr(opengl, "driver_info", missing)
    monkeypatch.setattr(nvrtc, "supported", missing)
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    monkeypatch.setattr("torch.cuda.device_count", lambda: 0)
    monkeypatch.setattr("platform.system", lambda: "Linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    found = findings()
    assert found["OpenGL"].advice == found["NVRTC"].advice == "Not here; install it."
    assert "OpenGL limits" not in found
    assert "--snapshot" in found["display"].advice


def test_the_report_has_a_line_each_and_advice_below(monkeypatch, capsys):
    two = [doctor.Finding("one", "fine"), doctor.Finding("two", "none", "get one")]
    monkeypatch.setattr(doctor, "examine", lambda: iter(two))
    doctor.report()
    lines = capsys.readouterr().out.splitlines()
    assert [line.split() for line in lines] == [
        ["one:", "fine"],
        ["two:", "none"],
        ["->", "get", "one"],
    ]


@pytest.mark.parametrize("renderer", ["llvmpipe (LLVM 15)", "softpipe", "SwiftShader Device"])
def test_software_renderers_are_told_from_hardware(renderer):
    assert opengl.software({"GL_RENDERER": renderer})
    assert not opengl.software({"GL_RENDERER": "NVIDIA H200/PCIe/SSE2"})
