"""Read and write pictures: float32 in, float32 out, and written in the kind they came in.

Pillow reads and writes everything of 8 bits. It has no 16-bit colour (it silently keeps the high
byte), so 16-bit PNG and TIFF go through OpenImageIO, both ways.
"""

from __future__ import annotations

import os
import threading
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image, ImageCms, UnidentifiedImageError

from .errors import ImageError
from .files import check_writable, require_file, writing

MAX_PIXELS = 256 * 1024**2  # a float32 picture of this size takes 3 GiB
# Only decoders that work on the bytes alone: EPS, for one, would start Ghostscript.
READABLE = ("PNG", "JPEG", "WEBP", "TIFF", "AVIF", "BMP", "GIF", "PPM", "TGA", "JPEG2000")


@dataclass(frozen=True)
class Picture:
    """A picture, and what it takes to write its enlargement in the same kind.

    color: (H, W, 3) float32 in [0, 1], sRGB-encoded (or as `icc` says), not premultiplied.
        Where alpha is 0 the stored colour is invisible and often arbitrary; it is replaced by
        the colours around it, so that no edge grows a fringe when colour and alpha are each
        upscaled on their own.
    alpha: (H, W) float32 in [0, 1], or None for an opaque picture.
    gray: color has three equal channels, and the file one.
    bits: 8 or 16 per channel in the file.
    icc: the file's RGB or gray profile. Its numbers are kept as they are and the profile is
        written again, so an enlargement looks like its original. CMYK is converted to sRGB
        through its profile and carries none.
    source: file name, without folders.
    """

    color: np.ndarray
    alpha: np.ndarray | None = None
    gray: bool = False
    bits: int = 8
    icc: bytes | None = None
    source: str = ""

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) in pixels."""
        return self.color.shape[0], self.color.shape[1]


def read(path: str | os.PathLike) -> Picture:
    """The picture in a file, upright (EXIF orientation applied); of an animation, the first frame.

    Other metadata is dropped. Raises ImageError, in one sentence, for a path that cannot be read,
    a file that is damaged or no picture, and one of more than MAX_PIXELS pixels.
    """
    path = require_file(path, ImageError)
    try:
        with path.open("rb") as file:
            if not file.read(1):
                raise ImageError(f"{path} is empty; save or download the picture again.")
            file.seek(0)
            return _decode(path, _open(path, file))
    except OSError as error:
        raise ImageError(f"Cannot read {path}: {error.strerror or error}; copy it anew.") from error


def write(
    path: str | os.PathLike,
    color: np.ndarray,
    like: Picture | None = None,
    alpha: np.ndarray | None = None,
    bits: int | None = None,
) -> None:
    """Write a picture as PNG, TIFF, JPEG (quality 95, 4:4:4) or WebP (lossless), by its suffix.

    color: (H, W, 3) float32, clamped to [0, 1] and rounded to the nearest step.
    like: the picture this was made from; gives gray, depth and colour profile.
    alpha: (H, W) float32 in [0, 1], already at this size; None writes an opaque picture.
    bits: 8 or 16; by default as in `like`, where the format can, else 8.

    Raises ImageError for values that are not finite, for what the format cannot hold, and for a
    file that cannot be written; no partial file is left, and an older one stays as it was.
    """
    path = Path(path)
    form = _format(path)
    color, alpha = _checked(path, color, alpha)
    check_output(path, color.shape[:2], alpha is not None)
    if bits is None:
        bits = min(like.bits if like else 8, form.bits)
    if bits not in (8, 16):
        raise ImageError(f"A picture has 8 or 16 bits per channel, not {bits}.")
    if bits > form.bits:
        raise ImageError(f"{form.name} holds 8 bits per channel; write {path.stem}.png instead.")
    gray = like is not None and like.gray and form.gray
    if gray and alpha is not None and bits == 16 and form.name == "TIFF":
        gray = False  # few readers, and not Pillow, know that variant
    channels = [color.mean(axis=2, keepdims=True) if gray else color]
    if alpha is not None:
        channels.append(alpha[..., None])
    top = 2**bits - 1
    pixels = np.rint(np.clip(np.concatenate(channels, axis=2), 0, 1) * top)
    pixels = pixels.astype(np.uint16 if bits == 16 else np.uint8)
    icc = like.icc if like and _fits(like.icc, gray) else None
    with writing(path, ImageError) as beside:
        if bits == 16:
            _encode16(beside, pixels, icc)
        else:
            flat = pixels[..., 0] if pixels.shape[2] == 1 else pixels
            Image.fromarray(flat).save(beside, form.name, icc_profile=icc, **form.options)


def check_output(
    path: str | os.PathLike, size: tuple[int, int] = (1, 1), alpha: bool = False
) -> None:
    """Raise the ImageError now that `write` would raise after minutes of work.

    size: (height, width) of the picture to come; alpha: will it be transparent somewhere?
    """
    path = Path(path)
    form = _format(path)
    check_writable(path, ImageError)
    if alpha and not form.alpha:
        raise ImageError(f"{form.name} holds no transparency; write {path.stem}.png instead.")
    if max(size) > form.side:
        raise ImageError(
            f"{form.name} holds at most {form.side} pixels per side; write {path.stem}.png instead."
        )


# Reading

_opening = threading.Lock()


def _open(path: Path, file) -> Image.Image:
    """The picture's header, its size checked before anything is decoded."""
    try:
        with _opening:
            # Pillow's own limit warns or fails at other sizes than ours, and only a
            # process-wide variable changes it; it is back before any pixel is decoded.
            limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
            try:
                image = Image.open(file, formats=READABLE)
            finally:
                Image.MAX_IMAGE_PIXELS = limit
    except UnidentifiedImageError as error:
        raise ImageError(
            f"{path} is no picture that can be read; use PNG, JPEG, WebP, TIFF, AVIF, BMP or GIF."
        ) from error
    except Exception as error:  # on damaged files Pillow's plugins raise nearly anything
        raise ImageError(f"{path} is damaged; save or download it again.") from error
    if image.width * image.height > MAX_PIXELS:
        raise ImageError(
            f"{path} has {image.width}x{image.height} pixels; "
            f"crop it to at most {MAX_PIXELS // 1024**2} megapixels."
        )
    return image


def _decode(path: Path, image: Image.Image) -> Picture:
    try:
        icc = image.info.get("icc_profile") or None
        pixels = _pixels16(path, image) if _is_16_bit(image) else _pixels8(path, image, icc)
        pixels = _upright(pixels, image.getexif().get(ExifTags.Base.Orientation, 1))
    except (ImageError, MemoryError):
        raise
    except Exception as error:  # as above
        raise ImageError(f"{path} is truncated or damaged; save or download it again.") from error
    channels = pixels.shape[2]
    values = np.divide(pixels, np.float32(np.iinfo(pixels.dtype).max), dtype=np.float32)
    gray = channels <= 2
    color = np.repeat(values[..., :1], 3, axis=2) if gray else values[..., :3]
    alpha = values[..., -1].copy() if channels in (2, 4) else None
    if alpha is not None and not alpha.all() and alpha.any():
        color = _fill_hidden(color, alpha > 0)
    return Picture(
        color=np.ascontiguousarray(color),
        alpha=alpha,
        gray=gray,
        bits=8 * pixels.itemsize,
        icc=icc if _fits(icc, gray) else None,
        source=path.name,
    )


def _is_16_bit(image: Image.Image) -> bool:
    """Is this a gray or RGB picture that Pillow would cut to its high bytes?"""
    if image.format == "PNG":
        return any(";16" in str(tile.args) for tile in image.tile)
    if image.format != "TIFF" or image.mode not in ("I;16", "I;16B", "RGB", "RGBA"):
        return False
    tags = image.tag_v2
    premultiplied = tags.get(338) == (1,)  # Pillow divides by alpha, OpenImageIO leaves it
    return tags.get(258, (1,))[0] == 16 and tags.get(339, (1,))[0] == 1 and not premultiplied


def _pixels8(path: Path, image: Image.Image, icc: bytes | None) -> np.ndarray:
    """(H, W, C) uint8, C = 1 gray, 2 gray + alpha, 3 RGB, 4 RGBA; uint16 for a 16-bit gray."""
    image.load()
    if image.mode.startswith("I"):
        values = np.asarray(image)
        if values.min() < 0 or values.max() > 65535:
            raise ImageError(f"{path} holds 32-bit numbers; save it with 8 or 16 bits per channel.")
        return values.astype(np.uint16)[..., None]
    if image.mode == "F":
        raise ImageError(
            f"{path} holds floating-point numbers; save it with 8 or 16 bits per channel."
        )
    if image.mode == "CMYK" and icc:
        image = _cmyk_to_srgb(image, icc)
    gray = image.mode in ("1", "L", "LA", "La")
    if image.has_transparency_data:
        if image.mode == "La":
            image = image.convert("LA")
        elif image.mode != "LA":
            image = image.convert("RGBA")
            if gray:
                image = Image.merge("LA", (image.getchannel("R"), image.getchannel("A")))
    else:
        image = image.convert("L" if gray else "RGB")
    return np.atleast_3d(np.asarray(image))


def _cmyk_to_srgb(image: Image.Image, icc: bytes) -> Image.Image:
    try:
        return ImageCms.profileToProfile(
            image,
            ImageCms.ImageCmsProfile(BytesIO(icc)),
            ImageCms.createProfile("sRGB"),
            renderingIntent=ImageCms.Intent.RELATIVE_COLORIMETRIC,
            outputMode="RGB",
            flags=ImageCms.Flags.BLACKPOINTCOMPENSATION,
        )
    except (ImageCms.PyCMSError, OSError):
        return image  # a broken profile; the plain formula does as well as it can


def _pixels16(path: Path, image: Image.Image) -> np.ndarray:
    """(H, W, C) uint16, C = 1 gray, 2 gray + alpha, 3 RGB, 4 RGBA."""
    import OpenImageIO as oiio

    wanted = oiio.ImageSpec()
    wanted.attribute("oiio:UnassociatedAlpha", 1)  # else it multiplies colour by alpha
    file = oiio.ImageInput.open(str(path), wanted)
    pixels = file and file.read_image(0, 0, 0, file.spec().nchannels, oiio.UINT16)
    if pixels is None:
        raise OSError(file.geterror() if file else oiio.geterror())
    if image.format == "TIFF" and image.tag_v2.get(262) == 0:  # "white is zero"
        pixels = 65535 - pixels
    if file.spec().alpha_channel < 0 and pixels.shape[2] in (2, 4):
        pixels = pixels[..., :-1]  # an extra channel of no declared meaning
    return pixels[..., :4]


def _upright(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Pixels (H, W, C) turned as EXIF orientation 1 to 8 says; any other number is ignored."""
    if orientation in (5, 6, 7, 8):
        pixels = pixels.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return pixels


def _fill_hidden(color: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """Colours (H, W, 3), those not visible (H, W) replaced by a mean of visible ones nearby.

    Means over squares of 2, 4, 8, ... pixels; each hidden pixel takes the smallest that has any.
    """
    if visible.all():
        return color
    height, width = visible.shape
    padding = (0, height % 2), (0, width % 2)
    weight = np.pad(visible.astype(np.float32), padding)[..., None]
    total = np.pad(color, (*padding, (0, 0))) * weight
    total, weight = (
        array.reshape(array.shape[0] // 2, 2, array.shape[1] // 2, 2, -1).sum(axis=(1, 3))
        for array in (total, weight)
    )
    coarse = _fill_hidden(total / np.maximum(weight, 1), weight[..., 0] > 0)
    around = coarse.repeat(2, axis=0).repeat(2, axis=1)[:height, :width]
    return np.where(visible[..., None], color, around)


# Writing


@dataclass(frozen=True)
class _Format:
    """What a file format can hold, and how Pillow should write it."""

    name: str
    bits: int
    alpha: bool
    gray: bool
    side: float
    options: dict


_JPEG = _Format("JPEG", 8, False, True, 65500, {"quality": 95, "subsampling": "4:4:4"})
_TIFF = _Format("TIFF", 16, True, True, np.inf, {"compression": "tiff_adobe_deflate"})
_FORMATS = {
    ".png": _Format("PNG", 16, True, True, np.inf, {}),
    ".jpg": _JPEG,
    ".jpeg": _JPEG,
    ".webp": _Format("WEBP", 8, True, False, 16383, {"lossless": True, "exact": True}),
    ".tif": _TIFF,
    ".tiff": _TIFF,
}


def _format(path: Path) -> _Format:
    try:
        return _FORMATS[path.suffix.lower()]
    except KeyError:
        raise ImageError(f"{path} must end in {', '.join(_FORMATS)}.") from None


def _checked(path: Path, color, alpha) -> tuple[np.ndarray, np.ndarray | None]:
    """Both as float32 arrays of matching shapes and finite values, or ImageError."""
    color = np.asarray(color, np.float32)
    if color.ndim != 3 or color.shape[2] != 3 or not color.size:
        raise ImageError(f"A picture must have shape (H, W, 3), but has {color.shape}.")
    if alpha is not None:
        alpha = np.asarray(alpha, np.float32)
        if alpha.shape != color.shape[:2]:
            raise ImageError(f"Alpha must have shape {color.shape[:2]}, but has {alpha.shape}.")
    if not all(np.isfinite(array).all() for array in (color, alpha) if array is not None):
        raise ImageError(f"{path} is not written: the picture holds values that are not finite.")
    return color, alpha


def _encode16(path: Path, pixels: np.ndarray, icc: bytes | None) -> None:
    """Pixels (H, W, C) uint16, C as in `_pixels16`, as PNG or TIFF."""
    import OpenImageIO as oiio

    height, width, channels = pixels.shape
    spec = oiio.ImageSpec(width, height, channels, oiio.UINT16)
    spec.channelnames = {1: "Y", 2: "YA", 3: "RGB", 4: "RGBA"}[channels]
    spec.alpha_channel = channels - 1 if channels in (2, 4) else -1
    spec.attribute("oiio:UnassociatedAlpha", 1)
    spec.attribute("compression", "zip")
    spec.attribute("png:compressionLevel", 6)
    # With a profile, no sRGB mark beside it that would contradict it.
    spec.attribute("oiio:ColorSpace", "unknown" if icc else "sRGB")
    if icc:
        kind = oiio.TypeDesc(f"uint8[{len(icc)}]")
        spec.attribute("ICCProfile", kind, np.frombuffer(icc, np.uint8))
    file = oiio.ImageOutput.create(str(path))
    if not (file and file.open(str(path), spec) and file.write_image(pixels) and file.close()):
        raise OSError(file.geterror() if file else oiio.geterror())


def _fits(icc: bytes | None, gray: bool) -> bool:
    """Is this a profile for gray (or else RGB) pixels? Its header says so in bytes 16 to 20."""
    return icc is not None and icc[16:20] == (b"GRAY" if gray else b"RGB ")
