"""Pictures in and out: every kind of file, every way it can be wrong, and exact round trips."""

from __future__ import annotations

import os
import struct
import threading
import zlib
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from PIL import Image, ImageCms

from gsasr import image as gi
from gsasr.errors import ImageError
from gsasr.image import Picture, check_output, read, write

MANY = settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
SRGB = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()


def noise(*shape: int, bits: int = 8) -> np.ndarray:
    kind = np.uint8 if bits == 8 else np.uint16
    return np.random.default_rng(0).integers(0, 2**bits, shape).astype(kind)


def save(path: Path, pixels: np.ndarray, mode: str | None = None, **options) -> Path:
    image = Image.fromarray(pixels)
    (image.convert(mode) if mode else image).save(path, **options)
    return path


def png(path: Path, pixels: np.ndarray, extra: tuple[tuple[bytes, bytes], ...] = ()) -> Path:
    """A plain PNG encoder for (H, W, C) of 8 or 16 bits: an oracle beside the libraries."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        )

    height, width, channels = pixels.shape
    kind = {1: 0, 2: 4, 3: 2, 4: 6}[channels]
    header = struct.pack(">IIBBBBB", width, height, 8 * pixels.itemsize, kind, 0, 0, 0)
    rows = b"".join(b"\0" + row.astype(pixels.dtype.newbyteorder(">")).tobytes() for row in pixels)
    chunks = [(b"IHDR", header), *extra, (b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*c) for c in chunks))
    return path


def integers(picture: Picture) -> np.ndarray:
    """The picture's pixels as the file's integers, (H, W, 3 or 4)."""
    parts = [picture.color] + ([] if picture.alpha is None else [picture.alpha[..., None]])
    return np.rint(np.concatenate(parts, axis=2) * (2**picture.bits - 1)).astype(int)


# Reading, kind by kind


def test_rgb(tmp_path):
    pixels = noise(5, 7, 3)
    picture = read(save(tmp_path / "a.png", pixels))
    assert picture.color.dtype == np.float32
    assert picture.color.flags.c_contiguous
    assert picture.size == (5, 7)
    assert (picture.alpha, picture.gray, picture.bits, picture.icc) == (None, False, 8, None)
    assert picture.source == "a.png"
    assert np.array_equal(picture.color, np.float32(pixels) / np.float32(255))


@pytest.mark.parametrize(
    "suffix", [".png", ".jpg", ".webp", ".tif", ".bmp", ".gif", ".ppm", ".avif"]
)
def test_formats(tmp_path, suffix):
    ramp = np.linspace(0, 255, 32 * 32 * 3).reshape(32, 32, 3).astype(np.uint8)
    picture = read(save(tmp_path / f"a.{suffix}", ramp))
    assert picture.size == (32, 32)
    assert np.abs(picture.color - ramp / 255).max() < 0.1


def test_gray(tmp_path):
    pixels = noise(5, 7)
    picture = read(save(tmp_path / "a.png", pixels))
    assert picture.gray
    assert np.array_equal(integers(picture), np.repeat(pixels[..., None], 3, axis=2))


def test_black_and_white(tmp_path):
    pixels = np.eye(4, dtype=bool)
    picture = read(save(tmp_path / "a.png", pixels))
    assert picture.gray
    assert np.array_equal(picture.color[..., 0], pixels)


def test_gray_with_alpha(tmp_path):
    pixels = np.maximum(noise(5, 7, 2), 1)
    picture = read(save(tmp_path / "a.png", pixels))
    assert picture.gray
    assert np.array_equal(integers(picture)[..., 2:], pixels)


def test_rgba(tmp_path):
    pixels = np.maximum(noise(5, 7, 4), 1)
    picture = read(save(tmp_path / "a.png", pixels))
    assert not picture.gray
    assert np.array_equal(integers(picture), pixels)


def test_palette(tmp_path):
    image = Image.fromarray(noise(5, 7, 3)).quantize(8)
    image.save(tmp_path / "a.png")
    picture = read(tmp_path / "a.png")
    assert picture.alpha is None
    assert np.array_equal(integers(picture), np.asarray(image.convert("RGB")))


def test_palette_with_transparency(tmp_path):
    image = Image.new("P", (2, 1))
    image.putpalette([10, 20, 30, 40, 50, 60])
    image.putpixel((1, 0), 1)
    image.save(tmp_path / "a.png", transparency=bytes([255, 128]))
    picture = read(tmp_path / "a.png")
    assert integers(picture).tolist() == [[[10, 20, 30, 255], [40, 50, 60, 128]]]


@pytest.mark.parametrize("bits", [8, 16])
def test_one_colour_declared_transparent(tmp_path, bits):
    """PNG may name one colour, without an alpha channel."""
    pixels = np.array([[[1, 2, 3], [4, 5, 6]]], f"u{bits // 8}")
    rgb = read(png(tmp_path / "rgb.png", pixels, ((b"tRNS", struct.pack(">HHH", 4, 5, 6)),)))
    gray = read(png(tmp_path / "gray.png", pixels[..., :1], ((b"tRNS", struct.pack(">H", 4)),)))
    assert rgb.bits == gray.bits == bits
    assert rgb.alpha.tolist() == gray.alpha.tolist() == [[1, 0]]
    assert gray.gray and not rgb.gray


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_16_bit_png(tmp_path, channels):
    pixels = np.maximum(noise(5, 7, channels, bits=16), 1)
    picture = read(png(tmp_path / "a.png", pixels))
    assert picture.bits == 16
    assert picture.gray == (channels < 3)
    color = pixels[..., :3] if channels > 2 else np.repeat(pixels[..., :1], 3, axis=2)
    assert np.array_equal(integers(picture)[..., :3], color)
    if channels in (2, 4):
        assert np.array_equal(integers(picture)[..., 3], pixels[..., -1])


def test_16_bit_gray_tiff(tmp_path):
    pixels = noise(5, 7, bits=16)
    picture = read(save(tmp_path / "a.tif", pixels))
    assert (picture.gray, picture.bits) == (True, 16)
    assert np.array_equal(integers(picture)[..., 0], pixels)


def test_16_bit_tiff_where_white_is_zero(tmp_path):
    path = save(tmp_path / "a.tif", np.array([[0, 1000, 65535]], np.uint16))
    tag = struct.pack("<HHI", 262, 3, 1)  # PhotometricInterpretation
    assert tag + b"\1" in path.read_bytes()
    path.write_bytes(path.read_bytes().replace(tag + b"\1", tag + b"\0"))
    assert integers(read(path))[0, :, 0].tolist() == [65535, 64535, 0]


def test_16_bit_tiff_with_an_extra_channel_that_is_no_alpha(tmp_path):
    pixels = noise(5, 7, 4, bits=16)
    path = tmp_path / "a.tif"
    write(path, pixels[..., :3] / 65535, alpha=pixels[..., 3] / 65535, bits=16)
    tag = struct.pack("<HHI", 338, 3, 1)  # ExtraSamples
    assert tag + b"\2" in path.read_bytes()
    path.write_bytes(path.read_bytes().replace(tag + b"\2", tag + b"\0"))
    picture = read(path)
    assert picture.alpha is None
    assert np.array_equal(integers(picture), pixels[..., :3])


def test_16_bit_pgm(tmp_path):
    pixels = noise(5, 7, bits=16)
    (tmp_path / "a.pgm").write_bytes(b"P5 7 5 65535\n" + pixels.astype(">u2").tobytes())
    picture = read(tmp_path / "a.pgm")
    assert (picture.gray, picture.bits) == (True, 16)
    assert np.array_equal(integers(picture)[..., 0], pixels)


def test_cmyk_jpeg_without_profile(tmp_path):
    """Adobe writes CMYK inverted; Pillow reads and writes that convention."""
    Image.new("CMYK", (8, 8), (0, 255, 255, 0)).save(tmp_path / "a.jpg", quality=100)
    picture = read(tmp_path / "a.jpg")
    assert np.allclose(picture.color, (1, 0, 0), atol=0.03)
    assert picture.icc is None


def cmyk_profile(lab_of_ink: tuple[int, int, int]) -> bytes:
    """A tiny profile: white paper, any full cyan is `lab_of_ink` (8-bit Lab), linear between."""
    corners = [lab_of_ink if corner & 8 else (255, 128, 128) for corner in range(16)]
    linear = bytes(range(256))
    table = b"mft1" + bytes(4) + bytes([4, 3, 2, 0])
    table += struct.pack(">9i", 65536, 0, 0, 0, 65536, 0, 0, 0, 65536)
    table += linear * 4 + bytes(sum(corners, ())) + linear * 3
    text = b"desc" + bytes(4) + struct.pack(">I", 5) + b"tiny\0" + bytes(78)
    white = b"XYZ " + bytes(4) + struct.pack(">3i", 63190, 65536, 54061)
    tags, body, offset = b"", b"", 128 + 4 + 12 * 3
    for name, data in ((b"desc", text), (b"wtpt", white), (b"A2B0", table)):
        data += bytes(-len(data) % 4)
        tags += name + struct.pack(">II", offset + len(body), len(data))
        body += data
    header = struct.pack(
        ">I4sI4s4s4s", offset + len(body), b"tiny", 0x02400000, b"prtr", b"CMYK", b"Lab "
    )
    header += bytes(12) + b"acsp" + bytes(28) + struct.pack(">3i", 63190, 65536, 54061)
    return header.ljust(128, b"\0") + struct.pack(">I", 3) + tags + body


def test_cmyk_jpeg_through_its_profile(tmp_path):
    """This profile's "cyan" is a dark neutral, which the plain formula would show as cyan."""
    profile = cmyk_profile((128, 128, 128))
    ink = Image.new("CMYK", (8, 8), (255, 0, 0, 0))
    ink.save(tmp_path / "a.jpg", quality=100, icc_profile=profile)
    picture = read(tmp_path / "a.jpg")
    assert picture.icc is None
    assert np.ptp(picture.color, axis=2).max() < 0.02
    assert 0.3 < picture.color.mean() < 0.6


def test_cmyk_with_a_broken_profile_is_still_read(tmp_path):
    ink = Image.new("CMYK", (8, 8), (0, 255, 255, 0))
    ink.save(tmp_path / "a.jpg", quality=100, icc_profile=b"broken")
    assert np.allclose(read(tmp_path / "a.jpg").color, (1, 0, 0), atol=0.03)


@pytest.mark.parametrize("suffix", [".png", ".tif", ".jpg", ".webp"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientation(tmp_path, suffix, orientation):
    stored = np.kron(np.array([[0, 60, 120], [180, 220, 255]]), np.ones((16, 16))).astype(np.uint8)
    stored = np.repeat(stored[..., None], 3, axis=2)
    upright = {
        1: stored,
        2: np.fliplr(stored),
        3: np.rot90(stored, 2),
        4: np.flipud(stored),
        5: stored.swapaxes(0, 1),
        6: np.rot90(stored, -1),
        7: np.rot90(stored, 2).swapaxes(0, 1),
        8: np.rot90(stored),
    }[orientation]
    exif = Image.Exif()
    exif[0x0112] = orientation
    picture = read(save(tmp_path / f"a{suffix}", stored, exif=exif))
    assert picture.size == upright.shape[:2]
    assert np.abs(picture.color - upright / 255).max() < 0.06


def test_orientation_of_16_bits(tmp_path):
    pixels = noise(3, 4, 3, bits=16)
    exif = Image.Exif()
    exif[0x0112] = 6
    path = png(tmp_path / "a.png", pixels, ((b"eXIf", exif.tobytes()[6:]),))
    assert np.array_equal(integers(read(path)), np.rot90(pixels, -1))


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (9, 1), (3000, 4000)])
def test_sizes(tmp_path, size):
    pixels = np.zeros((*size, 3), np.uint8)
    pixels[-1, -1] = 1, 2, 3
    picture = read(save(tmp_path / "a.png", pixels, compress_level=1))
    assert picture.size == size
    assert np.array_equal(integers(picture)[-1, -1], (1, 2, 3))


def test_animation_gives_its_first_frame(tmp_path):
    frames = [Image.new("RGB", (4, 3), color) for color in ("red", "blue")]
    frames[0].save(tmp_path / "a.gif", save_all=True, append_images=frames[1:])
    assert np.array_equal(read(tmp_path / "a.gif").color, np.broadcast_to((1, 0, 0), (3, 4, 3)))


def test_colour_under_zero_alpha_comes_from_around(tmp_path):
    """One red pixel among invisible black ones: the black must not leak into its edge."""
    pixels = np.zeros((5, 6, 4), np.uint8)
    pixels[2, 3] = 200, 10, 10, 128
    picture = read(save(tmp_path / "a.png", pixels))
    assert np.array_equal(picture.alpha * 255, pixels[..., 3])
    assert np.allclose(picture.color * 255, (200, 10, 10), atol=0.01)


def test_fully_transparent_keeps_its_colours(tmp_path):
    pixels = noise(4, 4, 4)
    pixels[..., 3] = 0
    assert np.array_equal(integers(read(save(tmp_path / "a.png", pixels))), pixels)


# Reading what cannot be read


def fails(path: Path, *words: str) -> None:
    with pytest.raises(ImageError) as caught:
        read(path)
    message = str(caught.value)
    assert "\n" not in message and message.endswith(".")
    assert path.name in message
    for word in words:
        assert word in message


def test_missing_folder_empty(tmp_path):
    (tmp_path / "empty.png").touch()
    fails(tmp_path / "none.png", "does not exist")
    fails(tmp_path, "folder")
    fails(tmp_path / "empty.png", "empty")
    fails(tmp_path / "empty.png" / "x.png")


def test_not_a_picture(tmp_path):
    (tmp_path / "a.png").write_text("hello, this is text")
    (tmp_path / "a.eps").write_text("%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n")
    fails(tmp_path / "a.png", "no picture", "PNG")
    fails(tmp_path / "a.eps", "no picture")


@pytest.mark.parametrize("name", ["8.png", "16.png", "a.jpg", "a.webp", "a.tif", "a.gif"])
@pytest.mark.parametrize("part", [0.05, 0.5, 0.9])
def test_truncated(tmp_path, name, part):
    path = tmp_path / name
    if name == "16.png":
        png(path, noise(64, 64, 3, bits=16))
    else:
        save(path, noise(64, 64, 3))
    path.write_bytes(path.read_bytes()[: int(part * path.stat().st_size)])
    fails(path)


@settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60, deadline=None
)
@given(st.sampled_from(["PNG", "JPEG", "WEBP", "TIFF", "GIF", "BMP"]), st.data())
@pytest.mark.filterwarnings("ignore::UserWarning")  # Pillow names some damage in passing
def test_damage_never_escapes(tmp_path, form, data):
    """Whatever bytes are changed: a picture or one ImageError, nothing else."""
    buffer = BytesIO()
    Image.fromarray(noise(16, 16, 3)).save(buffer, form)
    damaged = bytearray(buffer.getvalue())
    for _ in range(data.draw(st.integers(1, 8))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    (tmp_path / "a").write_bytes(damaged)
    try:
        picture = read(tmp_path / "a")
        assert np.isfinite(picture.color).all()
    except ImageError:
        pass


def test_absurdly_large_is_refused_by_its_header(tmp_path):
    header = struct.pack(">IIBBBBB", 60000, 60000, 8, 2, 0, 0, 0)
    bomb = png(tmp_path / "a.png", noise(1, 1, 3)).read_bytes()
    old = bomb[12:33]
    new = b"IHDR" + header
    new += struct.pack(">I", zlib.crc32(new))
    (tmp_path / "a.png").write_bytes(bomb.replace(old, new))
    limit = Image.MAX_IMAGE_PIXELS
    fails(tmp_path / "a.png", "60000x60000", "megapixels")
    assert limit == Image.MAX_IMAGE_PIXELS


def test_own_limit_holds_where_pillow_would_only_warn(tmp_path, monkeypatch, recwarn):
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 10)
    assert read(save(tmp_path / "a.png", noise(9, 9, 3))).size == (9, 9)
    assert not recwarn.list
    assert Image.MAX_IMAGE_PIXELS == 10
    monkeypatch.setattr(gi, "MAX_PIXELS", 80)
    fails(tmp_path / "a.png", "9x9")


def test_permission_denied(tmp_path, monkeypatch):
    path = save(tmp_path / "a.png", noise(2, 2, 3))

    def refuse(*_args, **_kwargs):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", refuse)  # root could read it all the same
    fails(path, "permissions")


@pytest.mark.parametrize(("values", "word"), [(np.float32, "floating"), (np.int32, "32-bit")])
def test_unusual_numbers(tmp_path, values, word):
    fails(save(tmp_path / "a.tif", np.full((3, 3), -7, values)), word)


def test_many_threads(tmp_path):
    path = save(tmp_path / "a.png", noise(20, 20, 3))
    limit, results = Image.MAX_IMAGE_PIXELS, []
    threads = [threading.Thread(target=lambda: results.append(read(path))) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(results) == 8
    assert limit == Image.MAX_IMAGE_PIXELS


# Writing


@settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=40, deadline=None
)
@given(
    pixels=st.sampled_from([8, 16]).flatmap(
        lambda bits: arrays.arrays(
            f"u{bits // 8}",
            st.tuples(st.integers(1, 6), st.integers(1, 6), st.sampled_from([1, 2, 3, 4])),
        )
    ),
    suffix=st.sampled_from([".png", ".tif"]),
)
def test_lossless_round_trip(tmp_path, pixels, suffix):
    """Any picture written and read again, 8 and 16 bits, gray or not, with alpha or without."""
    bits, channels = 8 * pixels.itemsize, pixels.shape[2]
    if channels in (2, 4):
        pixels[..., -1] = np.maximum(pixels[..., -1], 1)
    values = pixels / (2**bits - 1)
    color = values[..., :3] if channels > 2 else np.repeat(values[..., :1], 3, axis=2)
    alpha = values[..., -1] if channels in (2, 4) else None
    like = Picture(color, alpha, gray=channels < 3, bits=bits)
    path = tmp_path / f"a{suffix}"
    write(path, color, like, alpha)
    back = read(path)
    assert back.bits == bits
    assert (back.alpha is None) == (alpha is None)
    assert np.array_equal(integers(back), integers(replace(like, color=color)))
    if not (suffix == ".tif" and bits == 16 and channels == 2):
        assert back.gray == like.gray


def test_16_bit_png_is_what_pillow_cannot_write(tmp_path):
    """The file itself holds 16-bit RGB: byte 24 is the depth, byte 25 the colour type."""
    write(tmp_path / "a.png", noise(3, 3, 3) / 255, bits=16)
    assert (tmp_path / "a.png").read_bytes()[24:26] == bytes([16, 2])


def test_gray_is_written_gray(tmp_path):
    like = Picture(np.zeros((2, 2, 3)), gray=True)
    for name, mode in (("a.png", "L"), ("a.jpg", "L"), ("a.tif", "L"), ("a.webp", "RGB")):
        write(tmp_path / name, np.full((4, 4, 3), (0.2, 0.4, 0.6)), like)
        with Image.open(tmp_path / name) as image:
            assert image.mode == mode
    assert np.array_equal(integers(read(tmp_path / "a.png")), np.full((4, 4, 3), 102))


def test_clamped_and_rounded_to_nearest(tmp_path):
    row = np.array([-1, 0.0019, 0.0021, 0.5, 0.998, 0.9981, 7], np.float32)
    write(tmp_path / "a.png", np.tile(row[None, :, None], (1, 1, 3)))
    assert integers(read(tmp_path / "a.png"))[0, :, 0].tolist() == [0, 0, 1, 128, 254, 255, 255]


def test_the_profile_is_kept(tmp_path):
    path = save(tmp_path / "a.png", noise(4, 4, 3), icc_profile=SRGB)
    picture = read(path)
    assert picture.icc == SRGB
    for name in ("b.png", "b.jpg", "b.webp", "b.tif"):
        write(tmp_path / name, picture.color, picture)
        assert read(tmp_path / name).icc == SRGB
    for name in ("c.png", "c.tif"):
        write(tmp_path / name, picture.color, picture, bits=16)
        assert read(tmp_path / name).icc == SRGB
    before_pixels = (tmp_path / "c.png").read_bytes().partition(b"IDAT")[0]
    assert struct.pack(">I", 1) + b"sRGB" not in before_pixels, "an sRGB mark beside the profile"


def test_a_profile_for_other_channels_is_dropped(tmp_path):
    assert read(save(tmp_path / "a.png", noise(4, 4), icc_profile=SRGB)).icc is None
    write(
        tmp_path / "b.png", np.zeros((2, 2, 3)), Picture(np.zeros((2, 2, 3)), True, True, icc=SRGB)
    )
    assert read(tmp_path / "b.png").icc is None


def test_alpha(tmp_path):
    color, alpha = noise(4, 5, 3) / 255, np.maximum(noise(4, 5), 1) / 255
    for name in ("a.png", "a.webp", "a.tiff"):
        write(tmp_path / name, color, alpha=alpha)
        back = read(tmp_path / name)
        assert np.allclose(back.alpha, alpha) and np.allclose(back.color, color)
    with pytest.raises(ImageError, match=r"transparency; write a\.png"):
        write(tmp_path / "a.jpg", color, alpha=alpha)
    with pytest.raises(ImageError, match="shape"):
        write(tmp_path / "a.png", color, alpha=alpha[1:])


def test_depth_follows_the_source_where_the_format_can(tmp_path):
    color = noise(4, 4, 3, bits=16) / 65535
    like = Picture(color, bits=16)
    write(tmp_path / "a.png", color, like)
    write(tmp_path / "a.jpg", color, like)
    write(tmp_path / "b.png", color, like, bits=8)
    assert [read(tmp_path / n).bits for n in ("a.png", "a.jpg", "b.png")] == [16, 8, 8]
    with pytest.raises(ImageError, match=r"write a\.png"):
        write(tmp_path / "a.jpg", color, bits=16)
    with pytest.raises(ImageError, match="8 or 16"):
        write(tmp_path / "a.png", color, bits=12)


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_values_that_are_not_finite(tmp_path, wrong):
    color = np.zeros((2, 2, 3), np.float32)
    color[1, 1, 1] = wrong
    with pytest.raises(ImageError, match="not finite"):
        write(tmp_path / "a.png", color)
    assert list(tmp_path.iterdir()) == []


def test_webp_side(tmp_path):
    with pytest.raises(ImageError, match="16383"):
        write(tmp_path / "a.webp", np.zeros((1, 16384, 3)))


@pytest.mark.parametrize("name", ["a", "a.xyz", "a.gif"])
def test_unknown_suffix(tmp_path, name):
    for attempt in (check_output, lambda path: write(path, np.zeros((2, 2, 3)))):
        with pytest.raises(ImageError, match=r"\.png, \.jpg, \.jpeg, \.webp, \.tif, \.tiff"):
            attempt(tmp_path / name)


def test_folders(tmp_path, monkeypatch):
    (tmp_path / "d.png").mkdir()
    (tmp_path / "file").touch()
    for attempt in (check_output, lambda path: write(path, np.zeros((2, 2, 3)))):
        for path in (tmp_path / "none" / "a.png", tmp_path / "d.png", tmp_path / "file" / "a.png"):
            with pytest.raises(ImageError) as caught:
                attempt(path)
            assert "\n" not in str(caught.value)
    check_output(tmp_path / "a.png")
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.raises(ImageError, match="not writable"):
        check_output(tmp_path / "a.png")


@pytest.mark.parametrize("bits", [8, 16])
def test_failure_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch, bits):
    path = save(tmp_path / "a.png", noise(2, 2, 3))
    old = path.read_bytes()

    def full(*_args, **_kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(ImageError, match="No space left"):
        write(path, np.zeros((9, 9, 3)), bits=bits)
    assert path.read_bytes() == old
    assert list(tmp_path.iterdir()) == [path]
