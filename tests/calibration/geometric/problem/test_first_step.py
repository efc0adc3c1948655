"""Gross errors must not decide the first step of a search."""

import numpy as np
import torch
from testing.closeness import assert_close

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics


def test_rejected_rows_have_no_part_in_the_first_descent() -> None:
    robot, rng = Robot.load("ur10"), np.random.default_rng(0)
    q = torch.from_numpy(rng.uniform(-2, 2, (40, 6)))
    position = forward_kinematics(robot, q)[:, :3, 3] + torch.from_numpy(rng.uniform(-1e-3, 1e-3, (40, 3)))
    swapped = q.clone()
    swapped[[7, 23]] = swapped[[7, 23]][:, [0, 2, 1, 3, 4, 5]]
    setup = GeometricCalibrator(robot, base="fixed", tool="fixed").build(Measurements(swapped, position))
    wrong = setup.problem.without_prior().with_active(range(30))
    right = wrong.select(torch.tensor([row for row in range(40) if row not in (7, 23)]))
    first = wrong.linearise_at_start(setup.start)
    wanted = right.linearise(setup.start, None).descent / first.problem_data.noise[0] ** 2
    assert_close(first.descent, wanted, rtol=1e-9, atol=1e-9 * float(wanted.norm()))
