"""Joint offsets alone are exact for models with only offset errors, and their deviation is stated for others."""

import dataclasses

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.models import hand_made_model, joints_around
from testing.refusals import refused

from pisigma.deployment.export.joint_offsets import fit_joint_offsets, offsets_between
from pisigma.files.errors import ModelError, RobotError
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.robot import Robot
from pisigma.robot.coupling import Coupling, FourBar
from pisigma.robot.kinematics.forward import forward_kinematics


def geometric_model(name: str, calibrated: Robot) -> CalibratedModel:
    nominal = Robot.load(name)
    return CalibratedModel(
        name="made",
        kind="geometric_calibration",
        robot=nominal,
        network=None,
        domain=None,
        branches=(),
        starts=joints_around(name, 100, spread=0.6),
        calibrated=calibrated,
    )


def with_offsets(robot: Robot, offsets: list[float]) -> Robot:
    dh = robot.dh.copy()
    for joint, row, offset in zip(robot.joints, robot.joint_rows, offsets, strict=True):
        dh[row, 0 if joint.type == "revolute" else 1] += joint.direction * offset
    return robot.with_geometry(dh)


@pytest.mark.parametrize("name", ["kiro4", "ur10"])
def test_offsets_are_found_again(name):
    """Offsets of the first and the last joint are part of base and tool."""
    nominal = Robot.load(name)
    flipped = dataclasses.replace(
        nominal,
        rows=tuple(dataclasses.replace(row, direction=(-1) ** i) for i, row in enumerate(nominal.rows)),
    )
    offsets = [0.01, -0.02, 0.015, 0.03, -0.01, 0.02]
    model = dataclasses.replace(geometric_model(name, with_offsets(flipped, offsets)), robot=flipped)
    found = fit_joint_offsets(model)
    assert_close(found.values, [0, *offsets[1:5], 0], atol=1e-9)
    assert found.unobservable == ("theta_1", "theta_6")
    assert found.remaining_deviation.max_mm < 1e-6
    assert found.nominal.mean_mm > 1
    assert found.nominal.mean_mm < found.nominal.p95_mm < found.nominal.max_mm
    q = joints_around(name, 20)
    T = forward_kinematics(model.calibrated, q)
    assert_close(forward_kinematics(found.robot, q), T, atol=1e-9)
    shifted = flipped.with_geometry(base=found.robot.base, tool=found.robot.tool)
    assert_close(forward_kinematics(shifted, q + torch.from_numpy(found.values)), T, atol=1e-9)


def test_parallel_axes_have_unobservable_offsets():
    """On a SCARA only the second joint is distinguishable from base and tool, which share two directions."""
    model = geometric_model("kiro3", with_offsets(Robot.load("kiro3"), [0.0, 0.02, 0.0, 0.0]))
    found = fit_joint_offsets(model)
    assert found.unobservable == ("theta_1", "d_3", "theta_4")
    assert_close(found.values, [0, 0.02, 0, 0], atol=1e-6)
    assert found.remaining_deviation.max_mm < 1e-4
    assert np.abs(found.robot.base).max() < 0.1


@pytest.mark.parametrize("name", ["kiro3", "kiro4", "ur10"])
def test_a_learned_correction_is_approximated_in_part(name):
    found = fit_joint_offsets(hand_made_model(name))
    assert 0 < found.remaining_deviation.mean_mm < found.nominal.mean_mm
    assert found.departures()["off_the_whole_model"]["mean_mm"] == found.remaining_deviation.mean_mm


def test_a_model_without_a_region_is_refused():
    model = hand_made_model("kiro4")
    with refused(ModelError, value=0):
        fit_joint_offsets(dataclasses.replace(model, starts=model.starts[:0]))
    far = model.starts.clone()
    far[:] = torch.nan
    with refused(ModelError, value=1000):
        fit_joint_offsets(dataclasses.replace(model, starts=far))


def test_offsets_of_coupled_joints_are_those_of_the_axes():
    """The controller's zero of joint 2 moves joint 3 too."""
    nominal, matrix = Robot.load("ur10"), np.eye(6)
    matrix[2, 1], matrix[4, 4] = -1.0, 0.5
    driven = (matrix != 0) & np.array([[False, False, True, False, True, False]]).T
    coupling = Coupling(nominal.joints, (True,) * 6, matrix, np.full(6, 0.1), driven)
    coupled = dataclasses.replace(nominal, coupling=coupling)
    moved = with_offsets(coupled, [0.0, 0.02, -0.01, 0.03, 0.01, 0.0])
    q = joints_around("ur10", 20)
    there = forward_kinematics(coupled, coupled.to_dh(q + torch.from_numpy(offsets_between(coupled, moved))))
    assert_close(there, forward_kinematics(moved, coupled.to_dh(q)), atol=1e-12)
    bar = FourBar(0.5, 0.3, 0.5, 0.3, 1.0)
    driven = dataclasses.replace(
        coupled, coupling=dataclasses.replace(coupled.coupling, four_bars=((1, bar),))
    )
    with refused(RobotError, value="ur10"):
        offsets_between(driven, moved)
