"""Training pairs: joint differences on the nearest branch, wrapped, without singular rows."""

import math

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.calibration.geometric.initial_guess.base_and_tool import fit_base_and_tool
from pisigma.files.errors import IdentificationError, MeasurementError
from pisigma.measurement.dataset import Measurements
from pisigma.network.pairs import build_pairs
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.jacobian import singularity_measure
from pisigma.simulation.measure import simulate
from pisigma.simulation.true_robot import TrueRobot


def random_joints(generator: torch.Generator, rows: int) -> torch.Tensor:
    return 2.0 * (2 * torch.rand(rows, 6, generator=generator, dtype=torch.float64) - 1)


def test_the_target_is_the_joint_error_of_the_true_robot(generator):
    robot = Robot.load("kiro4")
    q = random_joints(generator, 200)
    q = q[singularity_measure(robot, q) > 0.05]
    error = torch.tensor([0.01, -0.02, 0.005, 0.03, -0.01, 0.02], dtype=torch.float64)
    measurements = measure(robot, q, -error)
    pairs = build_pairs(robot, measurements, None)
    assert pairs.used_rows.all()
    assert_close(pairs.target, error.expand_as(q), atol=1e-10)
    assert_close(pairs.q_nominal, q - error, atol=1e-10)
    assert_close(forward_kinematics(robot, pairs.q_nominal), pairs.T, atol=1e-12)
    assert pairs.left_out == ""


def measure(robot: Robot, q: torch.Tensor, error: torch.Tensor) -> Measurements:
    T = forward_kinematics(robot, q + error)
    return Measurements(q=q, position=T[:, :3, 3].clone(), rotation=T[:, :3, :3].clone(), source="made up")


def test_targets_are_small_across_a_full_turn(generator):
    robot = Robot.load("ur10")
    q = random_joints(generator, 100)
    q = q[singularity_measure(robot, q) > 0.05]
    turned = q + 2 * math.pi * torch.tensor([1, 0, 0, -1, 0, 1], dtype=torch.float64)
    error = torch.full((6,), 0.01, dtype=torch.float64)
    pairs = build_pairs(robot, measure(robot, turned, error), None)
    assert_close(pairs.target, -error.expand_as(q), atol=1e-10)
    assert_close(pairs.q_nominal, turned + error, atol=1e-10)


def test_singular_rows_are_left_out_and_reported(generator):
    robot = Robot.load("kiro4")
    q = random_joints(generator, 60)
    q[:, 4] = torch.where(q[:, 4].abs() < 0.3, 0.3, q[:, 4])
    q[:7, 4] = 1e-3
    measurements = measure(robot, q, torch.zeros(6, dtype=torch.float64))
    expected = singularity_measure(robot, q) < 0.02
    pairs = build_pairs(robot, measurements, 0.02)
    assert pairs.singular[:7].all()
    assert torch.equal(pairs.singular, expected)
    assert torch.equal(pairs.used_rows, ~expected)
    assert pairs.left_out == f"{int(expected.sum())} near a singularity"
    assert build_pairs(robot, measurements, None).used_rows.all()
    with refused(IdentificationError, file="made up", value=60):
        build_pairs(robot, measurements, 10.0)


def test_unreachable_rows_are_left_out_and_reported(generator):
    robot = Robot.load("kiro4")
    q = random_joints(generator, 20)
    measurements = measure(robot, q, torch.zeros(6, dtype=torch.float64))
    position = measurements.position.clone()
    position[3] *= 10
    far = Measurements(q=q, position=position, rotation=measurements.rotation, source="made up")
    pairs = build_pairs(robot, far, None)
    assert pairs.unreachable.nonzero().flatten().tolist() == [3]
    assert not pairs.used_rows[3]
    assert pairs.left_out == "1 not reachable by the nominal robot"
    assert torch.isfinite(pairs.target).all()
    assert torch.isfinite(pairs.q_nominal).all()


def test_branches_are_sorted_by_frequency():
    robot = Robot.load("kiro3")
    q = torch.tensor(
        [[0.1, 1.0, -0.1, 0.0], [0.2, -1.0, -0.1, 0.0], [0.3, -1.2, -0.2, 0.1]], dtype=torch.float64
    )
    pairs = build_pairs(robot, measure(robot, q, torch.zeros(4, dtype=torch.float64)), None)
    assert len(pairs.branches) == 2
    assert pairs.branches[0] != pairs.branches[1]
    only = build_pairs(robot, measure(robot, q[1:], torch.zeros(4, dtype=torch.float64)), None)
    assert only.branches == pairs.branches[:1]


def test_rows_without_orientation_are_rejected(generator):
    robot = Robot.load("ur10")
    measurements = simulate(TrueRobot(robot), random_joints(generator, 5), sensor="position")
    with pytest.raises(MeasurementError):
        build_pairs(robot, measurements, None)


def test_a_measured_ur10(shared_data):
    nominal = Robot.load("ur10")
    every = Measurements.read_csv(shared_data / "ur10" / "series_c_train.csv", nominal)
    measurements = every.select(torch.arange(200))
    robot = fit_base_and_tool(nominal, measurements).robot
    assert np.abs(robot.base - nominal.base).max() > 1e-3
    assert np.abs(robot.tool - nominal.tool).max() > 1e-3
    pairs = build_pairs(robot, measurements, 0.02)
    used = pairs.used_rows
    assert_close(forward_kinematics(robot, pairs.q_nominal[used]), measurements.T[used], atol=1e-9)
    assert_close(pairs.target, measurements.q - pairs.q_nominal, atol=1e-12)
    assert 0 < float(pairs.target[used].abs().max()) < math.radians(3)
    assert float(pairs.target[used].abs().median()) < math.radians(0.2)
    assert torch.equal(pairs.singular, singularity_measure(robot, pairs.q_nominal) < 0.02)
    assert pairs.left_out == (
        f"{int(pairs.singular.sum())} near a singularity" if pairs.singular.any() else ""
    )
