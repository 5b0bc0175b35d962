"""Source pixels to output pixels and back."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsasr.errors import RequestError
from gsasr.view import View, output_length


def test_output_sizes_are_floored_without_rounding_accidents():
    assert output_length(10, 2.3) == 23  # 2.3 * 10 is 22.999999999999996
    assert output_length(100, 3.7) == 370
    assert output_length(3, 2.5) == 7
    assert View.at_scale((100, 75), 3.3).size == (330, 247)


def test_the_first_output_pixel_samples_half_an_output_pixel_inside():
    view = View.at_scale((10, 10), 4)
    assert view.to_source(0.5, 0.5) == (0.125, 0.125)
    assert view.to_output(0.5, 0.5) == (2.0, 2.0)


def test_an_exact_size_has_its_own_scale_per_axis():
    view = View.to_size((10, 20), (25, 30))
    assert view.scale == (1.5, 2.5)
    assert view.to_source(30, 25) == (20, 10)


@given(st.floats(-1e4, 1e4), st.floats(-1e4, 1e4), st.floats(1e-2, 1e4), st.floats(-5000, 5000))
def test_mapping_there_and_back_returns_to_the_same_point(x, y, scale, point):
    view = View((x, y), (scale, scale), (10, 10))
    there = view.to_output(*view.to_source(point, -point))
    assert there == pytest.approx((point, -point), abs=1e-6 * max(1, scale))


@pytest.mark.parametrize("scale", [0, -1, math.nan, math.inf])
def test_scales_that_make_no_picture_are_refused(scale):
    with pytest.raises(RequestError, match="above 0"):
        View.at_scale((4, 4), scale)


def test_a_scale_that_leaves_no_pixel_says_which_one_would_do():
    with pytest.raises(RequestError, match=r"use at least 0\.25"):
        View.at_scale((4, 100), 0.1)


def test_bad_regions_and_sizes_are_refused():
    for region in ((0, 0, 0, 5), (0, 0, 5, -1), (math.nan, 0, 5, 5)):
        with pytest.raises(RequestError, match="region"):
            View.region_at_scale(region, 2)
    with pytest.raises(RequestError, match="at least 1x1"):
        View.to_size((4, 4), (0, 5))
    with pytest.raises(RequestError, match="finite"):
        View((math.inf, 0), (1, 1), (1, 1))
