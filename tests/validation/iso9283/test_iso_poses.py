"""Pose criteria of ISO 9283 on examples worked out by hand."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import MeasurementError
from pisigma.robot.se3 import rotation_from_vector
from pisigma.validation.iso9283.pose import (
    accuracy_drift,
    angular_deviations,
    barycentre,
    directional_orientation_variation,
    directional_position_variation,
    orientation_accuracy,
    orientation_repeatability,
    position_accuracy,
    position_repeatability,
    repeatability_drift,
)

EXACT = 1e-12


def tensor(values: list) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


COMMAND = tensor([1.0, 2.0, 3.0])
SQUARE = (
    COMMAND + tensor([2e-3, 3e-3, 6e-3]) + 1e-3 * tensor([[3, 4, 0], [-3, -4, 0], [0, 5, 12], [0, -5, -12]])
)
"""Four repeats about a barycentre that is 2, 3, 6 mm off; they are 5, 5, 13 and 13 mm from it."""


def test_pose_accuracy_by_hand():
    found = position_accuracy(SQUARE, COMMAND)
    assert_close(found.axes, [2e-3, 3e-3, 6e-3], atol=EXACT)
    assert_close(found.length, 7e-3, atol=EXACT)  # √(4 + 9 + 36)


def test_pose_repeatability_by_hand():
    # mean of 5, 5, 13, 13 is 9; deviations 4, 4, 4, 4: S = √(64 / 3)
    assert_close(position_repeatability(SQUARE), 9e-3 + 3e-3 * math.sqrt(64 / 3), atol=EXACT)
    same = COMMAND.expand(5, 3)
    assert_close(position_repeatability(same), 0.0)


def test_orientation_by_hand():
    angles = tensor([[0.10, -0.2, 0.0], [0.12, -0.2, 0.3], [0.14, -0.2, -0.3]])
    command = tensor([0.1, -0.1, 0.0])
    assert_close(orientation_accuracy(angles, command), [0.02, -0.1, 0.0], atol=EXACT)
    # deviations -0.02, 0, 0.02: S = √(8e-4 / 2) = 0.02
    assert_close(orientation_repeatability(angles), [0.06, 0.0, 0.9], atol=EXACT)


def test_a_full_turn_has_no_effect():
    angles = tensor([[math.pi - 0.01] * 3, [-math.pi + 0.03] * 3])
    assert_close(orientation_accuracy(angles, tensor([math.pi] * 3)), [0.01] * 3, atol=EXACT)
    assert_close(orientation_repeatability(angles), [3 * math.sqrt(2 * 0.02**2)] * 3, atol=EXACT)
    ways = torch.stack([angles, angles + 0.2])
    assert_close(directional_orientation_variation(ways), [0.2] * 3, atol=EXACT)


def test_directions_by_hand():
    shifts = 1e-3 * tensor([[0, 0, 0], [3, 4, 0], [3, 4, 12]])  # 5, 12 and 13 mm apart
    attained = SQUARE + shifts[:, None]
    assert_close(directional_position_variation(attained), 13e-3, atol=EXACT)
    turned = tensor([[[0.01, 0, 0]], [[0.04, -0.02, 0]], [[-0.01, 0.03, 0]]]).expand(3, 4, 3)
    assert_close(directional_orientation_variation(turned), [0.05, 0.05, 0.0], atol=EXACT)


def test_drift_by_hand():
    accuracy = tensor([1.0e-3, 1.5e-3, 0.4e-3])
    assert_close(accuracy_drift(accuracy), [0.0, 0.5e-3, 0.6e-3], atol=EXACT)
    angles = tensor([[0.1, 0.2, 0.3], [0.05, 0.4, 0.3]])
    assert_close(accuracy_drift(angles)[-1], [0.05, 0.2, 0.0], atol=EXACT)
    assert_close(repeatability_drift(accuracy), [0.0, -0.5e-3, 0.6e-3], atol=EXACT)


@pytest.mark.parametrize("batch", [(), (1,), (3, 1, 2)])
def test_a_batch_is_as_one_by_one(batch, generator):
    attained = torch.randn(*batch, 7, 3, generator=generator, dtype=torch.float64)
    command = torch.randn(*batch, 3, generator=generator, dtype=torch.float64)
    pairs = list(zip(attained.reshape(-1, 7, 3), command.reshape(-1, 3), strict=True))
    for function in (
        lambda x, c: position_accuracy(x, c).length,
        lambda x, c: position_accuracy(x, c).axes,
        orientation_accuracy,
        lambda x, c: position_repeatability(x),
        lambda x, c: orientation_repeatability(x),
    ):
        found = function(attained, command)
        assert found.shape[: len(batch)] == batch
        single = torch.stack([function(x, c) for x, c in pairs])
        assert_close(found.reshape(single.shape), single, atol=EXACT)


@given(st.floats(-math.pi, math.pi), st.floats(-1, 1), st.floats(-10, 10))
def test_repeatability_does_not_depend_on_where_the_frame_stands(turn: float, tilt: float, shift: float):
    R = rotation_from_vector(tensor([tilt, 0.3, turn]))
    moved = SQUARE @ R.mT + shift
    assert_close(position_repeatability(moved), position_repeatability(SQUARE), atol=1e-13)
    assert_close(barycentre(moved), barycentre(SQUARE) @ R.mT + shift, atol=1e-13)
    found = position_accuracy(moved, COMMAND @ R.mT + shift)
    assert_close(found.length, 7e-3, atol=1e-13)


def test_angles_of_rotations_are_about_the_axes_of_the_frame():
    command = rotation_from_vector(tensor([0.3, -1.2, 2.0]))
    turns = tensor([[0.01, 0, 0], [0, -0.02, 0], [0, 0, 0.03]])
    found = angular_deviations(rotation_from_vector(turns) @ command, command)
    assert_close(found, turns, atol=1e-12)
    assert_close(orientation_accuracy(found, torch.zeros(3).double()), turns.mean(0), atol=1e-12)


def test_one_repeat_does_not_determine_repeatability():
    for function in (position_repeatability, orientation_repeatability):
        with refused(MeasurementError, option="attained", value=1):
            function(COMMAND[None])


def test_dtype_follows_the_input():
    assert position_repeatability(SQUARE.float()).dtype == torch.float32
    assert position_accuracy(SQUARE.float(), COMMAND.float()).length.dtype == torch.float32
