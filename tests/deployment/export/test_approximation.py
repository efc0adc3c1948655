"""Projections of models on few parameters are least-squares solutions."""

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.models import joints_around

from pisigma.deployment.export.approximation import (
    ApproximationProblem,
    all_parameter_indices,
    joint_offset_indices,
    solve_approximation,
)
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics


def test_the_fit_is_a_minimum():
    """No small change of the free parameters reduces the sum of squares."""
    nominal, random = Robot.load("ur10"), np.random.default_rng(0)
    true = nominal.with_geometry(nominal.dh + random.normal(0, 2e-3, nominal.dh.shape))
    q = joints_around("ur10", 200, spread=0.8)
    problem = ApproximationProblem(nominal, q, forward_kinematics(true, q), joint_offset_indices(nominal))
    fitted, seen = solve_approximation(problem)
    assert seen == (False, True, True, True, True, False)
    missing, J = problem.residual(fitted)
    free = torch.tensor([*seen, *[True] * 12])
    slope = (J[:, free].T @ missing) / (J[:, free].norm(dim=0) * missing.norm())
    assert slope.abs().max() < 1e-6
    assert missing.norm() < problem.residual(nominal)[0].norm() / 1.5


@pytest.mark.parametrize("free", [joint_offset_indices, all_parameter_indices])
def test_the_derivative_agrees_with_finite_differences(free):
    robot, q = Robot.load("kiro3"), joints_around("kiro3", 4)
    problem = ApproximationProblem(robot, q, forward_kinematics(robot, q), free(robot))
    _, J = problem.residual(robot)
    for i in range(J.shape[1]):
        step = torch.zeros(J.shape[1], dtype=torch.float64)
        step[i] = 1e-6
        there, back = (problem.residual(problem.apply_step(robot, s * step))[0] for s in (1, -1))
        assert_close((back - there) / 2e-6, J[:, i], atol=1e-8)


def test_all_parameters_reproduce_any_geometry():
    nominal, random = Robot.load("ur10"), np.random.default_rng(0)
    true = nominal.with_geometry(nominal.dh + random.normal(0, 2e-3, nominal.dh.shape))
    q = joints_around("ur10", 200, spread=0.8)
    T = forward_kinematics(true, q)
    fitted, observable = solve_approximation(
        ApproximationProblem(nominal, q, T, all_parameter_indices(nominal))
    )
    assert sum(observable) == 18  # 4 n + 6 of an arm with n joints, of which base and tool have 12
    assert_close(forward_kinematics(fitted, q), T, atol=1e-8)
