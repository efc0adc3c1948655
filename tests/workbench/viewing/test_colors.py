"""Colours of errors."""

import math

import numpy as np
import pytest
from testing.closeness import assert_close

from pisigma.workbench.viewing.colors import RAMP, UNJUDGED, error_colors, round_up


def test_colours_run_from_no_error_to_the_end_of_the_scale():
    colors = error_colors(np.array([0.0, 1e-3, 5e-3, math.nan]), max_error=1e-3)
    expected = [tuple(bytes.fromhex(color[1:])) for color in (RAMP[0], RAMP[-1], RAMP[-1])]
    assert_close(colors, np.array([*expected, UNJUDGED]))


@pytest.mark.parametrize(
    ("value", "expected"), [(0.0003, 5e-4), (5e-4, 5e-4), (0.9, 1.0), (11.0, 20.0), (0.0, 1.0)]
)
def test_scales_end_at_a_round_value(value, expected):
    assert_close(round_up(value), expected, rtol=1e-12)
