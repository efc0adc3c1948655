"""Errors in frames that are fitted to the rows themselves: as large as those in the frames that are right."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.calibrated_ur5 import NOISE, calibrated_ur5, measured
from testing.closeness import assert_close
from testing.models import no_type_checker
from testing.refusals import refused

from pisigma.files.errors import MeasurementError
from pisigma.model.calibrated_model import poses_of_rows
from pisigma.robot.se3 import transform_from_xyz_zyx
from pisigma.validation.held_out.frames.fitted_frames import (
    MIN_CONFIGURATIONS,
    errors_in_fitted_frames,
    fitted_remark,
)

pytestmark = pytest.mark.usefixtures("without_type_checker")
BASE = transform_from_xyz_zyx(torch.tensor([1.3, -0.2, 0.1, 0.5, 0.2, -0.3], dtype=torch.float64))
TOOL = transform_from_xyz_zyx(torch.tensor([0.03, -0.02, 0.05, 0.2, 0.1, 0.0], dtype=torch.float64))
EYE = torch.eye(4, dtype=torch.float64)


@pytest.fixture(scope="module")
def arm():
    """The geometric calibration of a simulated UR5, and new joint values and poses of it."""
    with no_type_checker():
        return calibrated_ur5(240)


def elsewhere(q, T, fitted, turned=False):
    """Rows with noise, with the base and the tool elsewhere that are fitted."""
    rows = measured(q, (BASE if "base" in fitted else EYE) @ T @ (TOOL if "tool" in fitted else EYE), turned)
    return replace(rows, frame=("east",) * len(q), target=("ball",) * len(q))


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("fitted", [("base",), ("tool",), ("base", "tool")])
def test_six_rows_err_by_the_noise(arm, fitted, turned):
    """What is fitted makes errors smaller; divided by the degrees of freedom, they are as large as the noise."""
    model, q, T = arm
    rows = elsewhere(q, T, fitted, turned)
    squares = [
        float(errors_in_fitted_frames(model, rows.select(some), fitted).position.square().mean())
        for some in torch.arange(len(q)).split(MIN_CONFIGURATIONS)
    ]
    assert_close(np.sqrt(np.mean(squares)), NOISE, rtol=0.12)


def test_every_frame_and_target_is_fitted_for_itself(arm):
    model, q, T = arm
    rows = elsewhere(q[:40], T[:40], ("base", "tool"))
    rows = replace(rows, frame=("east", "west") * 20, target=("ball",) * 20 + ("nest",) * 20)
    rows.position[1::2] += 0.2
    errors = errors_in_fitted_frames(model, rows, ("base", "tool"))
    assert errors.rotation is None
    assert_close(float(errors.position.square().mean().sqrt()), NOISE, rtol=0.2)


def test_exact_rows_are_met_exactly(arm):
    model, q, T = arm
    rows = elsewhere(q[:8], T[:8], (), turned=True)
    T = BASE @ poses_of_rows(model, replace(rows, frame=("",) * 8, target=("",) * 8)) @ TOOL
    exact = replace(rows, position=T[:, :3, 3].clone(), rotation=T[:, :3, :3].clone())
    errors = errors_in_fitted_frames(model, exact, ("base", "tool"))
    assert_close(errors.position, torch.zeros(8, 3), atol=1e-9)
    assert_close(errors.rotation, torch.zeros(8, 3), atol=1e-7)


def test_equal_joint_values_count_once(arm):
    model, q, T = arm
    once = elsewhere(q[:8], T[:8], ("base",))
    twice = once.select(torch.arange(8).repeat(2))
    assert_close(
        errors_in_fitted_frames(model, twice, ("base",)).position[:8],
        errors_in_fitted_frames(model, once, ("base",)).position,
        atol=1e-12,
    )
    (remark,) = fitted_remark(twice, ("base",))
    assert re.findall(r"\d+", remark) == [
        "6",
        "18",
        "24",
        "6",
    ]  # parameters, degrees of freedom, values, parameters


@pytest.mark.parametrize("targets", [2, 4])
def test_targets_at_equal_joint_values_are_separate_values(arm, targets):
    model, q, T = arm
    T_tools = TOOL.repeat(targets, 1, 1)
    T_tools[:, :3, 3] += 0.1 * torch.eye(4, dtype=torch.float64)[:targets, :3]
    rows = measured(q.repeat_interleave(targets, 0), (BASE @ T[:, None] @ T_tools).flatten(0, 1), False)
    rows = replace(rows, target=tuple(map(str, range(targets))) * len(q), frame=("east",) * rows.rows)
    squares = [
        float(errors_in_fitted_frames(model, rows.select(some), ("base", "tool")).position.square().mean())
        for some in torch.arange(rows.rows).split(MIN_CONFIGURATIONS * targets)
    ]
    assert_close(np.sqrt(np.mean(squares)), NOISE, rtol=0.15)


def test_what_is_fitted_needs_poses(arm):
    model, q, T = arm
    rows = elsewhere(q[:11], T[:11], ("base",))
    few = replace(rows, frame=("east",) * 6 + ("west",) * 5)
    with refused(MeasurementError, expected="6 or more joint vectors of frame 'west'", value=5):
        errors_in_fitted_frames(model, few, ("base",))
    with refused(MeasurementError, expected="6 or more joint vectors of target 'ball'", value=5):
        errors_in_fitted_frames(model, replace(rows.select(torch.arange(5)), frame=("",) * 5), ("tool",))
    with refused(MeasurementError, expected="positions"):
        errors_in_fitted_frames(model, replace(rows, position=None), ("base",))
