"""The verdict on a correction by a cross-validation."""

import pytest
import torch

from pisigma.validation.held_out.pose_statistics import Comparison, PoseErrors
from pisigma.validation.held_out.training_summary import ComparisonFigures

LOWERS, SAME, RAISES = "lowers", "does not change", "raises"


def figures(position: float, rotation: float | None, largest: float | None = None) -> ComparisonFigures:
    one = torch.ones(4, dtype=torch.float64)
    turn = None if rotation is None else one
    moved = position * one
    if largest is not None:
        moved[0] = largest
    after = PoseErrors(moved, None if rotation is None else rotation * one)
    return ComparisonFigures.from_comparison(Comparison(PoseErrors(one, turn), after, 0), folds=2)


@pytest.mark.parametrize(
    ("position", "rotation", "effects", "maxima", "recommendation"),
    [
        (0.5, None, [LOWERS], (), "use it"),
        (1.01, None, [SAME], ("position",), "do not use it"),
        (2.0, None, [RAISES], ("position",), "do not use it"),
        (0.5, 0.5, [LOWERS, LOWERS], (), "use it"),
        (0.5, 2.0, [LOWERS, RAISES], ("orientation",), "use it with care"),
        (1.0, 1.0, [SAME, SAME], (), "do not use it"),
    ],
)
def test_the_recommendation_follows_from_all_errors(position, rotation, effects, maxima, recommendation):
    found = figures(position, rotation)
    assert list(found.effects) == ["position", "orientation"][: len(effects)]
    assert list(found.effects.values()) == effects
    assert (found.increased_maxima, found.recommendation) == (maxima, recommendation)


def test_a_larger_maximum_needs_care():
    larger, same = figures(0.1, None, 1.04), figures(0.1, None, 1 + 1e-9)
    assert (larger.increased_maxima, larger.recommendation) == (("position",), "use it with care")
    assert (same.increased_maxima, same.recommendation) == ((), "use it")
    assert "527.162" in larger.verdict
    assert "1040.000" in larger.verdict
