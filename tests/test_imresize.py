"""MATLAB's bicubic downscaling: numbers known by hand, and the benchmarks' own pictures."""

import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gsasr.imresize import downscale


def test_a_flat_picture_stays_flat_and_is_cut_to_a_multiple():
    small = downscale(np.full((11, 7, 3), 93, np.uint8), 3)
    assert small.shape == (3, 2, 3) and small.dtype == np.uint8 and (small == 93).all()


def test_an_edge_takes_the_values_worked_out_by_hand():
    # Factor 2: taps at the distances 0.25, 0.75, 1.25 and 1.75 (in output pixels), one on each
    # side, weigh 111, 29, -9 and -3 of 256.
    step = np.zeros((2, 12, 1), np.uint8)
    step[:, 6:] = 200
    # Left of the edge 200 * -3 / 256, cut to 0, and 200 * (29 - 9 - 3) / 256 = 13.3; right of it
    # what is missing there: 186.7 and 202.3.
    assert downscale(step, 2)[0, :, 0].tolist() == [0, 0, 13, 187, 202, 200]
    impulse = np.zeros((2, 16, 1), np.uint8)
    impulse[:, 8] = 255
    # Pixel 8 (centre 8.5) is 1.75, 0.75, 0.25 and 1.25 output pixels from the outputs 2 to 5,
    # whose centres are 5, 7, 9 and 11.
    weights = np.array([-3, 29, 111, -9]) / 256
    expected = np.floor(np.clip(255 * weights, 0, 255) + 0.5)
    assert downscale(impulse, 2)[0, 2:6, 0].tolist() == expected.tolist()


def test_pixels_beyond_the_edge_repeat_the_last_one():
    # Half of output 0's taps fall on the pixels -3 to 0, all of which are or repeat pixel 0:
    # -3 - 9 + 29 + 111 = 128 of 256.
    row = np.zeros((2, 8, 1), np.uint8)
    row[:, 0] = 100
    assert downscale(row, 2)[0, 0, 0] == 50


def test_between_the_two_passes_levels_are_rounded():
    picture = np.zeros((8, 8, 1), np.uint8)
    picture[2, 2:4] = 4  # 4 * 29 / 256 = 0.45 in row 0, 4 * 111 / 256 = 1.7 -> 2 in row 1
    assert downscale(picture, 2)[:, 1, 0].tolist() == [0, 2, 0, 0]


@pytest.mark.parametrize("name", ["Set5", "Set14"])
def test_the_benchmarks_pictures_come_out_equal_to_the_bit(name):
    if "GSASR_DATA" not in os.environ:
        pytest.skip("Set GSASR_DATA to a folder that holds test/Set5 and test/Set14.")
    folder = Path(os.environ["GSASR_DATA"]) / "test" / name
    pictures = sorted(folder.glob("HR/*.png"))
    assert pictures, f"There is no {folder}/HR/*.png."
    for path in pictures:
        truth = np.atleast_3d(np.asarray(Image.open(path)))
        for factor in (2, 3, 4):
            given = np.atleast_3d(np.asarray(Image.open(folder / f"LR/x{factor}" / path.name)))
            assert np.array_equal(downscale(truth, factor), given), (path.name, factor)
