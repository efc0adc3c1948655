"""Distance criteria of ISO 9283 on examples worked out by hand."""

import math

import torch
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import MeasurementError
from pisigma.validation.iso9283.distance import (
    angular_distance_accuracy,
    angular_distance_repeatability,
    distance_accuracy,
    distance_repeatability,
)

EXACT = 1e-12
COMMANDS = torch.zeros(3, dtype=torch.float64), torch.tensor([0.3, -0.4, 0.0], dtype=torch.float64)
"""Half a metre apart."""
FIRST = torch.tensor([[0.0, 0, 0], [0.001, 0, 0], [0, 0, 0]], dtype=torch.float64)
SECOND = FIRST + torch.tensor(
    [[0.3, -0.4, 0.0], [0.303, -0.404, 0.0], [0.306, -0.408, 0.0]], dtype=torch.float64
)
"""0.500, 0.505 and 0.510 m apart."""


def test_distance_accuracy_by_hand():
    found = distance_accuracy(FIRST, SECOND, *COMMANDS)
    assert_close(found.length, 0.005, atol=EXACT)
    assert_close(found.axes, [0.003, 0.004, 0.0], atol=EXACT)
    swapped = distance_accuracy(SECOND, FIRST, *COMMANDS[::-1])
    assert_close(swapped.length, found.length, atol=EXACT)
    assert_close(swapped.axes, found.axes, atol=EXACT)


def test_too_short_is_below_zero():
    found = distance_accuracy(FIRST, FIRST + 0.9 * COMMANDS[1], *COMMANDS)
    assert_close(found.length, -0.05, atol=EXACT)
    assert_close(found.axes, [-0.03, -0.04, 0.0], atol=EXACT)


def test_distance_repeatability_by_hand():
    found = distance_repeatability(FIRST, SECOND)
    assert_close(found.length, 3 * 0.005, atol=EXACT)  # deviations -5, 0, 5 mm: S = √(50 / 2) = 5 mm
    assert_close(found.axes, [3 * 0.003, 3 * 0.004, 0.0], atol=EXACT)


def test_a_place_that_both_share_does_not_matter(generator):
    shift = torch.randn(3, 1, 3, generator=generator, dtype=torch.float64)
    found = distance_repeatability(FIRST + shift, SECOND + shift)
    assert found.length.shape == (3,)
    assert_close(found.length, distance_repeatability(FIRST, SECOND).length.expand(3), atol=1e-14)


def test_angles_by_hand():
    first = torch.tensor([[math.pi - 0.01, 0, 0], [math.pi - 0.01, 0, 0]], dtype=torch.float64)
    second = torch.tensor([[-math.pi + 0.10, 0.2, 0], [-math.pi + 0.12, 0.2, 0]], dtype=torch.float64)
    commands = torch.tensor([[math.pi, 0, 0], [-math.pi + 0.1, 0.25, 0]], dtype=torch.float64)
    assert_close(angular_distance_accuracy(first, second, *commands), [0.02, -0.05, 0.0], atol=EXACT)
    spread = 3 * math.sqrt(2 * 0.01**2)
    assert_close(angular_distance_repeatability(first, second), [spread, 0.0, 0.0], atol=EXACT)


def test_one_repeat_does_not_determine_repeatability():
    for function in (distance_repeatability, angular_distance_repeatability):
        with refused(MeasurementError, option="attained", value=1):
            function(FIRST[:1], SECOND[:1])
