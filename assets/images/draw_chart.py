"""Draw chart.png: what an enlargement finds hard, with shapes that are known exactly.

    python assets/images/draw_chart.py [PATH]

256x256 pixels: zone plate, Siemens star; slanted edges, line pairs, rings, a disc with a glint;
text, colour patches, gradients. Every shape is a function of continuous coordinates, averaged
over each pixel.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

SAMPLES = 8  # per pixel and axis
Shape = Callable[[np.ndarray, np.ndarray], np.ndarray]  # x, y (h, w), pixels -> gray or RGB


def zone_plate(x, y):
    """Rings whose frequency grows from 0 at the centre to 0.45 cycles per pixel at the edge."""
    r2 = (x - 64) ** 2 + (y - 64) ** 2
    return np.where(r2 < 62**2, 0.5 + 0.5 * np.cos(np.pi * 0.45 * r2 / 62), 0.5)


def siemens_star(x, y):
    """36 black spokes on white."""
    angle, r = np.arctan2(y - 64, x - 64), np.hypot(x - 64, y - 64)
    return np.where((np.sin(36 * angle) > 0) & (r < 60), 0.0, 1.0)


def slanted_edges(x, y):
    """Two edges 5 degrees off the axes, as sharpness is measured; the lower one in colour."""
    black = x - 32 > (y - 16) * np.tan(np.radians(5))
    red = y - 48 > (x - 32) * np.tan(np.radians(5))
    upper = np.where(black, 0.1, 0.9)[..., None] * np.ones(3)
    lower = np.where(red[..., None], (0.8, 0.15, 0.1), (0.1, 0.35, 0.6))
    return np.where((y < 32)[..., None], upper, lower)


def line_pairs(x, y):
    """Upright lines above, slanted ones below; the period falls from 8 to 2 pixels."""
    period = np.array([8, 6, 4, 3, 2.5, 2])[np.clip(x * 6 // 64, 0, 5).astype(int)]
    along = np.where(y < 32, x, x * np.cos(0.6) + y * np.sin(0.6))
    return np.where(along % period < period / 2, 0.05, 0.95)


def rings(x, y):
    """Thin circles, 1.2 pixels wide, on a pale ground."""
    r = np.hypot(x - 32, y - 32)
    ring = (np.abs(r % 7 - 3.5) < 0.6) & (r < 29)
    return np.where(ring[..., None], (0.05, 0.1, 0.3), (0.98, 0.95, 0.88))


def ball(x, y):
    """A shaded ball with a small glint: soft and sharp in one place."""
    r = np.hypot(x - 32, y - 32)
    shade = np.clip(1 - np.hypot(x - 24, y - 22) / 42, 0, 1)[..., None]
    glint = (np.hypot((x - 22) / 1.5, y - 19) < 3)[..., None]
    lit = np.where(glint, 1.0, shade * np.array([0.95, 0.6, 0.15]))
    return np.where((r < 27)[..., None], lit, (0.12, 0.14, 0.2))


def patches(x, y):
    """Primaries, secondaries, skin, sky, foliage and grays."""
    colors = np.array(
        [
            [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1)],
            [(0, 1, 1), (1, 0, 1), (1, 1, 0), (0.6, 0.6, 0.6)],
            [(0.76, 0.58, 0.51), (0.38, 0.48, 0.61), (0.34, 0.42, 0.26), (0.3, 0.3, 0.3)],
            [(0.45, 0.32, 0.27), (0.52, 0.5, 0.69), (0.4, 0.74, 0.67), (0, 0, 0)],
        ]
    )
    return colors[(y // 16).astype(int), (x // 16).astype(int)]


def gradients(x, y):
    """Black to white, three primaries to black, and all hues."""
    t = (x / 64)[..., None]
    hues = np.clip(np.abs((t * 6 + np.array([0, 4, 2])) % 6 - 3) - 1, 0, 1)
    rows = [t * np.ones(3), t * (1, 0, 0), t * (0, 1, 0), t * (0, 0, 1), hues]
    return np.choose(np.clip(y * 5 // 64, 0, 4).astype(int)[..., None], rows)


def area(shape: Shape, height: int, width: int) -> np.ndarray:
    """(height, width, 3) means of a shape over each pixel."""
    y, x = (np.mgrid[: height * SAMPLES, : width * SAMPLES] + 0.5) / SAMPLES
    values = shape(x, y)
    values = values[..., None] * np.ones(3) if values.ndim == 2 else values
    return values.reshape(height, SAMPLES, width, SAMPLES, 3).mean(axis=(1, 3))


def text(height: int, width: int) -> np.ndarray:
    """(height, width, 3) lines of Pillow's bitmap font at its own size, 3/4 and 1/2 of it."""
    page, font, top = np.full((height, width), 255, np.uint8), ImageFont.load_default_imagefont(), 3
    for scale, words in (
        (1, "Sphinx of black"),
        (1, "quartz, judge my vow"),
        (0.75, "0123456789 (GSASR) @#%&"),
        (0.75, "Pack my box with five dozen"),
        (0.5, "Quick brown foxes jump over the lazy dog"),
    ):
        rows, columns = round(11 * scale), width - 6
        line = Image.new("L", (round(columns / scale), 11), 255)
        ImageDraw.Draw(line).text((0, 0), words, fill=0, font=font)
        page[top : top + rows, 3 : 3 + columns] = line.resize((columns, rows), Image.Resampling.BOX)
        top += rows + 3
    return np.repeat(page[..., None] / 255, 3, axis=2)


def draw() -> np.ndarray:
    """The chart, (256, 256, 3) uint8."""
    top = [area(zone_plate, 128, 128), area(siemens_star, 128, 128)]
    middle = [area(shape, 64, 64) for shape in (slanted_edges, line_pairs, rings, ball)]
    bottom = [text(64, 128), area(patches, 64, 64), area(gradients, 64, 64)]
    chart = np.concatenate([np.concatenate(row, axis=1) for row in (top, middle, bottom)])
    return np.rint(255 * np.clip(chart, 0, 1)).astype(np.uint8)


if __name__ == "__main__":
    path = sys.argv[1] if len(sys.argv) > 1 else Path(__file__).with_name("chart.png")
    Image.fromarray(draw()).save(path, optimize=True)
