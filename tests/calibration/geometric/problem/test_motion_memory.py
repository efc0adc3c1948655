"""A remembered motion must not be taken for that of other points or rows."""

import numpy as np
import torch
from testing.closeness import assert_close

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.problem.problem import CalibrationProblem
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics


def _problem() -> tuple[CalibrationProblem, torch.Tensor]:
    robot = Robot.load("ur10")
    q = torch.from_numpy(np.random.default_rng(0).uniform(-2, 2, (40, 6)))
    setup = GeometricCalibrator(robot).build(Measurements(q, forward_kinematics(robot, q)[:, :3, 3]))
    return setup.problem, setup.start


def test_another_point_is_evaluated_again() -> None:
    problem, start = _problem()
    active, rows = torch.arange(len(start)), problem.chunks()[0]
    before = problem.motion(start, rows, active)
    derivative, moved = before.derivative.clone(), start.clone()
    moved[problem.space.index("base_x")] += 0.5
    shift = problem.motion(moved, rows, active).position - before.position
    assert_close(shift[0], torch.full((40,), 0.5, dtype=torch.float64), atol=1e-12)
    problem.motion(moved * 1.01, rows, active)
    assert_close(before.derivative, derivative, atol=0.0)


def test_some_rows_are_some_rows_of_all() -> None:
    """Asked for as a slice, or chosen, after the motion of all rows was remembered."""
    problem, start = _problem()
    active = torch.arange(len(start))
    whole = problem.motion(start, problem.chunks()[0], active)
    part = problem.motion(start, slice(10, 15), active)
    chosen = problem.select(torch.arange(10, 15))
    again = chosen.motion(start, chosen.chunks()[0], active)
    assert_close(part.derivative, whole.derivative[..., 10:15], atol=1e-14)
    assert_close(again.derivative, whole.derivative[..., 10:15], atol=1e-14)


def test_the_memory_is_shared_by_problems_with_other_free_parameters() -> None:
    problem, start = _problem()
    everything = problem.motion(start, problem.chunks()[0], torch.arange(len(start)))
    few = problem.with_active([3, 7]).without_prior()
    two = few.motion(start, few.chunks()[0], few.active)
    assert few.memory is problem.memory
    assert_close(two.derivative, everything.derivative[[3, 7]], atol=0.0)
