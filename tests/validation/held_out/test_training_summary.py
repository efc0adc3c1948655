"""The verdict of a cross-validation, in a sentence."""

import pytest
import torch

from pisigma.validation.held_out.pose_statistics import Comparison, PoseErrors
from pisigma.validation.held_out.training_summary import ComparisonFigures


def verdict(position: float, rotation: float | None, largest: float | None = None) -> str:
    one = torch.ones(4, dtype=torch.float64)
    turn = None if rotation is None else one
    moved = position * one
    if largest is not None:
        moved[0] = largest
    after = PoseErrors(moved, None if rotation is None else rotation * one)
    return ComparisonFigures.of(Comparison(PoseErrors(one, turn), after, 0), folds=2).verdict


@pytest.mark.parametrize(
    ("position", "rotation", "said"),
    [
        (0.5, None, "lowers the position error (1000.000 to 500.000 mm RMS)."),
        (
            1.01,
            None,
            "does not change the position error (1000.000 to 1010.000 mm RMS, but the largest rises from "
            "1000.000 to 1010.000 mm); do not use it.",
        ),
        (
            2.0,
            None,
            "raises the position error (1000.000 to 2000.000 mm RMS, and the largest rises from 1000.000 to "
            "2000.000 mm); do not use it.",
        ),
        (0.5, 0.5, "and lowers the orientation error (57.296 to 28.648 deg RMS)."),
        (
            0.5,
            2.0,
            "and raises the orientation error (57.296 to 114.592 deg RMS, and the largest rises from 57.296 to "
            "114.592 deg); use it with care.",
        ),
        (1.0, 1.0, "and does not change the orientation error (57.296 to 57.296 deg RMS); do not use it."),
    ],
)
def test_the_verdict_is_honest(position, rotation, said):
    assert verdict(position, rotation).startswith("On held-out rows the correction ")
    assert verdict(position, rotation).endswith(said)


def test_a_largest_error_that_rises_is_said():
    assert verdict(0.1, None, 1.04).endswith(
        "lowers the position error (1000.000 to 527.162 mm RMS, but the largest rises from 1000.000 to 1040.000 "
        "mm); use it with care."
    )
    assert verdict(0.1, None, 1 + 1e-9).endswith("lowers the position error (1000.000 to 507.445 mm RMS).")
