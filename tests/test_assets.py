"""The sample pictures: readable, and the chart is what its script draws."""

from __future__ import annotations

import runpy

import numpy as np
import pytest
from PIL import Image

from gsasr.files import shipped
from gsasr.image import read


@pytest.mark.parametrize("name", ["astronaut.png", "cat.png", "chart.png"])
def test_samples(name):
    picture = read(shipped(f"assets/images/{name}"))
    assert max(picture.size) <= 300
    assert picture.alpha is None


def test_the_script_draws_the_chart():
    draw = runpy.run_path(str(shipped("assets/images/draw_chart.py")))["draw"]
    with Image.open(shipped("assets/images/chart.png")) as chart:
        difference = np.asarray(chart).astype(int) - draw()
    assert np.abs(difference).max() <= 1  # sin and exp may round differently elsewhere
