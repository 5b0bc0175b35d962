"""The commands, as subprocesses and as a user calls them."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from fields import random_field
from PIL import Image

from gsasr import cli, image
from gsasr.gaussians import Gaussians
from gsasr.model import load_model, save_model
from gsasr.picture import render
from gsasr.view import View


def gsasr(*arguments) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "gsasr.cli", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True)


@pytest.fixture
def run(capsys):
    """Calls a command in this process: (exit code, stdout, stderr)."""

    def call(*arguments) -> tuple[int, str, str]:
        try:
            code = cli.main([str(argument) for argument in arguments])
        except SystemExit as stopped:
            code = int(stopped.code)
        out, err = capsys.readouterr()
        return code, out, err

    return call


@pytest.fixture
def tiny(tiny_model, tmp_path):
    """A model file that runs in no time."""
    path = tmp_path / "tiny.safetensors"
    save_model(tiny_model, path)
    return path


@pytest.fixture
def picture(tmp_path, images):
    path = tmp_path / "in.png"
    Image.open(images / "cat.png").convert("RGB").crop((90, 30, 113, 47)).save(path)
    return path


def test_upscaling_a_photograph_with_the_shipped_model_is_a_success_and_silent(picture, tmp_path):
    out = tmp_path / "out.png"
    done = gsasr("upscale", picture, "-o", out, "--scale", "3.7")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    made = Image.open(out)
    assert made.size == (85, 62)  # floor(3.7 * 23) x floor(3.7 * 17)
    original = Image.open(picture).resize((85, 62), Image.Resampling.BICUBIC)
    difference = np.abs(np.asarray(made, float) - np.asarray(original, float))
    assert difference.mean() < 12  # the same picture, sharper


def test_predicting_then_rendering_equals_the_python_interface(run, picture, tiny, tmp_path):
    field, out = tmp_path / "f.safetensors", tmp_path / "o.png"
    assert run("predict", picture, "-o", field, "--model", tiny, "--scale", 3)[0] == 0
    assert run("render", field, "-o", out, "--scale", 2.5, "--backend", "cpu")[0] == 0
    loaded = Gaussians.load(field)
    assert (loaded.source, loaded.scale, loaded.size) == ("in.png", 3.0, (17, 23))
    expected = np.rint(render(loaded, scale=2.5, backend="cpu").clip(0, 1) * 255)
    assert np.array_equal(np.asarray(Image.open(out)), expected.astype(np.uint8))


def test_a_region_and_an_exact_size_are_what_was_asked_for(run, tmp_path):
    random_field(200, (9, 13)).save(tmp_path / "f.safetensors")
    field = Gaussians.load(tmp_path / "f.safetensors")
    out = tmp_path / "o.png"
    options = ("--backend", "reference")
    for arguments, view in (
        (("--size", "40x30"), View.to_size((9, 13), (30, 40))),
        (("--scale", "3", "--region", "2,-1,5,4"), View((2, -1), (3, 3), (12, 15))),
        (("--size", "10x8", "--region", "2,1,5,4"), View((2, 1), (2, 2), (8, 10))),
    ):
        assert run("render", tmp_path / "f.safetensors", "-o", out, *arguments, *options)[0] == 0
        expected = np.rint(render(field, view=view, backend="reference").clip(0, 1) * 255)
        assert np.array_equal(np.asarray(Image.open(out)), expected.astype(np.uint8))


def test_every_kind_of_picture_comes_out_in_its_kind(run, tiny, tmp_path):
    values = (np.random.default_rng(0).random((9, 7, 4)) * 255).astype(np.uint8)
    pictures = {
        "rgb": Image.fromarray(values[..., :3]),
        "gray": Image.fromarray(values[..., 0]),
        "alpha": Image.fromarray(values),
        "palette": Image.fromarray(values[..., :3]).quantize(16),
        "dot": Image.fromarray(values[:1, :1, :3]),
        "line": Image.fromarray(values[:1, :, :3]),
    }
    modes = {"gray": "L", "alpha": "RGBA"}
    for name, original in pictures.items():
        original.save(tmp_path / "in.png")
        out = tmp_path / "out.png"
        enlarge = ["upscale", tmp_path / "in.png", "-o", out, "--scale", 2, "--model", tiny]
        code, _, said = run(*enlarge)
        assert (code, said) == (0, "")
        made = Image.open(out)
        assert made.mode == modes.get(name, "RGB"), name
        assert made.size == (2 * original.width, 2 * original.height), name


def test_sixteen_bit_pictures_stay_sixteen_bit(run, tiny, tmp_path):
    color = np.random.default_rng(0).random((6, 5, 3), np.float32)
    image.write(tmp_path / "in.png", color, bits=16)
    code, _, _ = run(
        "upscale", tmp_path / "in.png", "-o", tmp_path / "out.png", "--scale", 2, "--model", tiny
    )
    made = image.read(tmp_path / "out.png")
    assert code == 0 and made.bits == 16 and made.size == (12, 10)


def test_info_names_what_is_in_a_file(run, picture, tiny, tmp_path):
    random_field(20, (2, 5)).save(tmp_path / "f.safetensors")
    for path, words in (
        (picture, ["picture", "23x17", "RGB"]),
        (tmp_path / "f.safetensors", ["Gaussians", "5x2", "20 (2.00 per pixel)"]),
        (tiny, ["network", "EDSR, 8 channels", "window 4"]),
    ):
        code, out, _ = run("info", path)
        assert code == 0
        for word in words:
            assert word in out


def mistakes(folder: Path) -> dict[str, tuple[list, str]]:
    """Name -> (arguments, words of the answer); files are in `folder`."""
    out = ["-o", folder / "out.png"]
    upscale, predict = ["upscale", folder / "in.png"], ["predict", folder / "in.png"]
    return {
        "missing picture": (["upscale", folder / "no.png", *out, "--scale", 2], "does not exist"),
        "empty picture": (["upscale", folder / "empty.png", *out, "--scale", 2], "empty"),
        "cut picture": (["upscale", folder / "cut.png", *out, "--scale", 2], "truncated"),
        "no picture": (["upscale", folder / "text.png", *out, "--scale", 2], "picture"),
        "folder": (["upscale", folder, *out, "--scale", 2], "folder"),
        "no such folder": ([*upscale, "-o", folder / "no/out.png", "--scale", 2], "not exist"),
        "unknown format": ([*upscale, "-o", folder / "out.xyz", "--scale", 2], "must end in"),
        "scale 0": ([*upscale, *out, "--scale", 0], "above 0"),
        "scale negative": ([*upscale, *out, "--scale=-3"], "above 0"),
        "scale nan": ([*upscale, *out, "--scale", "nan"], "above 0"),
        "scale word": ([*upscale, *out, "--scale", "big"], "--scale"),
        "scale tiny": ([*upscale, *out, "--scale", 1e-4], "leaves no pixel"),
        "scale huge": ([*upscale, *out, "--scale", 1e6], "GiB"),
        "scale infinite": ([*upscale, *out, "--scale", 1e308], "smaller scale"),
        "device": (["predict", folder / "in.png", "-o", "/dev/null"], "must end in"),
        "field into a picture": ([*predict, "-o", folder / "f.png"], "must end in"),
        "long name": (
            [*upscale, "-o", folder / ("x" * 300 + ".png"), "--scale", 2],
            "Cannot write",
        ),
        "alpha into jpeg": (
            ["upscale", folder / "clear.png", "-o", folder / "o.jpg", "--scale", 2],
            "no transparency",
        ),
        "condition": ([*upscale, *out, "--scale", 2, "--condition", 1e-42], "lie in"),
        "no scale": ([*upscale, *out], "--scale"),
        "no model": ([*upscale, *out, "--scale", 2, "--model", "nope"], "no model nope"),
        "other model": (
            [*upscale, *out, "--scale", 2, "--model", folder / "f.safetensors"],
            "no GSASR network",
        ),
        "no cuda": ([*upscale, *out, "--scale", 2, "--backend", "cuda"], "cuda"),
        "field without folder": ([*predict, "-o", folder / "no/f.safetensors"], "not exist"),
        "nan field": (["render", folder / "nan.safetensors", *out, "--scale", 2], "not finite"),
        "no field": (["render", folder / "in.png", *out, "--scale", 2], "no file of Gaussians"),
        "no size": (["render", folder / "f.safetensors", *out], "either --scale or --size"),
        "bad size": (["render", folder / "f.safetensors", *out, "--size", "4by4"], "WxH"),
        "bad region": (
            ["render", folder / "f.safetensors", *out, "--scale", 2, "--region", "1,2,0,4"],
            "region",
        ),
        "info on nothing": (["info", folder / "none.safetensors"], "does not exist"),
        "no data": (["train", "--data", folder / "no", "--out", folder / "r"], "no pictures"),
        "no benchmark": (["evaluate", folder], "HR/NAME"),
        "no command": ([], "COMMAND"),
    }


@pytest.fixture
def bad_files(tmp_path, images):
    photo = (images / "cat.png").read_bytes()
    Image.new("RGB", (8, 8)).save(tmp_path / "in.png")
    Image.new("RGBA", (8, 8)).save(tmp_path / "clear.png")
    (tmp_path / "empty.png").write_bytes(b"")
    (tmp_path / "cut.png").write_bytes(photo[: len(photo) // 2])
    (tmp_path / "text.png").write_text("not a picture")
    field = random_field(3, (4, 4))
    field.save(tmp_path / "f.safetensors")
    broken = field.mean.clone()
    broken[0, 0] = float("nan")
    Gaussians(**field.tensors() | {"mean": broken}, size=(4, 4)).save(tmp_path / "nan.safetensors")
    return tmp_path


@pytest.mark.parametrize("name", mistakes(Path()))
def test_a_mistake_gets_one_sentence_and_exit_code_2(run, bad_files, name):
    before = sorted(bad_files.iterdir())
    arguments, words = mistakes(bad_files)[name]
    code, out, said = run(*arguments)
    assert (code, out) == (2, "")
    assert words in said and said.count("\n") == 1 and said.startswith("gsasr")
    assert sorted(bad_files.iterdir()) == before


def test_a_mistake_ends_the_process_with_code_2_and_no_traceback(bad_files):
    done = gsasr("render", bad_files / "nan.safetensors", "-o", bad_files / "o.png", "--scale", 2)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr and done.stderr.count("\n") == 1


def test_a_reader_that_leaves_early_is_no_failure(bad_files):
    command = [sys.executable, "-m", "gsasr.cli", "info", str(bad_files / "in.png")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()  # as `| head -0` does
        assert process.stderr.read() == b""
    assert process.returncode == 141


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_an_unwritable_folder_is_refused_before_the_work(run, bad_files):
    closed = bad_files / "closed"
    closed.mkdir(mode=0o500)
    code, _, said = run("upscale", bad_files / "in.png", "-o", closed / "o.png", "--scale", 2)
    assert code == 2 and "not writable" in said


def test_help_of_every_command_works_without_loading_the_network():
    code = (
        "import sys\nfrom gsasr import cli\n"
        "for name in ('upscale', 'predict', 'render', 'info', 'evaluate', 'train'):\n"
        "    try: cli.main([name, '--help'])\n"
        "    except SystemExit as stopped: assert stopped.code == 0\n"
        "assert 'torch' not in sys.modules, 'torch was loaded'\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("usage: ") == 6


def test_the_shipped_model_is_small_and_trained(images):
    from gsasr.files import shipped

    path = shipped("assets/models/gsasr-lite.safetensors")
    assert path.stat().st_size < 8e6
    assert sum(p.numel() for p in load_model("lite").parameters()) < 2e6
