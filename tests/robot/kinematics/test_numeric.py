"""Numeric inverse and singularity measure."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import PoseError
from pisigma.robot.kinematics.closed_form import closed_form_solver
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.jacobian import characteristic_length, joint_jacobian, singularity_measure
from pisigma.robot.kinematics.numeric import solve_numeric
from pisigma.robot.kinematics.status import Status
from pisigma.robot.se3 import pose_error, transform_from_xyz_zyx


def _unlimited(robot):
    rows = tuple(replace(row, lower=-np.inf, upper=np.inf) for row in robot.rows)
    return replace(robot, rows=rows)


def _targets(robot, robots, generator, *batch, spread=0.1):
    """Return reachable poses away from singularities, and starts near their solutions."""
    q = robots.random_joints(robot, generator, *batch, 4).flatten(0, -2)
    q = q[singularity_measure(robot, q).argsort(descending=True)[: math.prod(batch)]].reshape(
        *batch, robot.dof
    )
    noise = torch.rand(q.shape, generator=generator, dtype=torch.float64) - 0.5
    return q, forward_kinematics(robot, q), q + 2 * spread * noise


def test_a_perturbed_start_converges_to_the_solution(robot, robots, generator):
    robot = _unlimited(robot)
    q, T, start = _targets(robot, robots, generator, 200)
    solution = solve_numeric(robot, T, start)
    assert (solution.status == Status.REACHED).all()
    error = pose_error(T, forward_kinematics(robot, solution.q))
    assert_close(error[:, :3].norm(dim=-1), 0.0, atol=1e-12)
    assert_close(error[:, 3:].norm(dim=-1), 0.0, atol=1e-12)
    assert_close(solution.position_residual, error[:, :3].norm(dim=-1), atol=1e-14)
    assert_close(solution.rotation_residual, error[:, 3:].norm(dim=-1), atol=1e-14)
    if robot.dof <= 6:
        assert_close(solution.q, q, atol=1e-9)
    assert solution.iterations.max() < 20


@pytest.mark.parametrize("batch", [(), (1,), (3, 1, 2), (0,)])
@pytest.mark.parametrize(("dtype", "atol"), [(torch.float64, 1e-11), (torch.float32, 1e-3)])
def test_batched_equals_looped_in_every_shape_and_dtype(robots, generator, batch, dtype, atol):
    robot = robots.load("ur5")
    _, T, start = _targets(robot, robots, generator, *batch)
    T, start = T.to(dtype), start.to(dtype)
    solution = solve_numeric(robot, T, start)
    assert (solution.q.shape, solution.q.dtype) == (start.shape, dtype)
    assert {x.shape for x in (solution.status, solution.position_residual, solution.iterations)} == {
        torch.Size(batch)
    }
    assert (solution.status == Status.REACHED).all()
    for index in np.ndindex(*batch):
        assert_close(solution.q[index], solve_numeric(robot, T[index], start[index]).q, atol=atol)


def test_start_and_poses_broadcast(robots, generator):
    robot = robots.load("kiro4")
    _, T, _ = _targets(robot, robots, generator, 5)
    solutions = closed_form_solver(robot).solve(T)
    solution = solve_numeric(robot, T[:, None], solutions.q + 0.01)
    assert solution.q.shape == (5, 8, 6)
    assert_close(solution.q, solutions.q, atol=1e-9)


def test_a_calibrated_arm_is_solved_from_its_nominal_closed_form(robots, generator):
    nominal = robots.load("kiro4")
    offsets = np.random.default_rng(1).uniform(-1.0, 1.0, (6, 5)) * 3e-3
    calibrated = nominal.with_geometry(dh=nominal.dh + offsets)
    _, T, _ = _targets(nominal, robots, generator, 100)
    assert closed_form_solver(calibrated) is None
    start = closed_form_solver(nominal).solve(T).q
    solution = solve_numeric(calibrated, T[:, None], start)
    reached = solution.status != Status.NOT_CONVERGED
    again = forward_kinematics(calibrated, solution.q)
    assert reached.double().mean() > 0.98
    assert_close(again[reached], T[:, None].expand_as(again)[reached], atol=1e-12)


def test_a_start_at_the_solution_needs_no_step(robots, generator):
    robot = robots.load("ur10")
    q, T, start = _targets(robot, robots, generator, 4)
    start[::2] = q[::2]
    solution = solve_numeric(robot, T, start)
    assert solution.iterations[::2].tolist() == [1, 1]
    assert (solution.iterations[1::2] > 1).all()
    assert_close(solution.q[::2], q[::2])


@pytest.mark.parametrize(
    ("name", "pose"), [("ur5", [5.0, 0, 0, 0, 0, 0]), ("kiro3", [0.3, 0.3, 0.3, 0, 0.5, 0])]
)
def test_unreachable_poses_do_not_converge_but_decrease_the_error(name, pose, robots):
    robot = robots.load(name)
    T, start = (
        transform_from_xyz_zyx(torch.tensor(pose, dtype=torch.float64)),
        torch.full((robot.dof,), 0.3).double(),
    )
    solution = solve_numeric(robot, T, start)
    assert solution.status == Status.NOT_CONVERGED
    assert torch.isfinite(solution.q).all()
    length = characteristic_length(robot)
    before = pose_error(T, forward_kinematics(robot, start)) / torch.tensor([length] * 3 + [1.0] * 3)
    after = math.hypot(solution.position_residual / length, solution.rotation_residual)
    assert after < before.norm()


def test_too_few_iterations_are_not_converged(robots, generator):
    robot = robots.load("ur5")
    _, T, start = _targets(robot, robots, generator, 3)
    solution = solve_numeric(robot, T, start, max_iterations=1)
    assert (solution.status == Status.NOT_CONVERGED).all()
    assert solution.iterations.tolist() == [2, 2, 2]


def test_a_loose_tolerance_stops_earlier(robots, generator):
    robot = robots.load("ur5")
    _, T, start = _targets(robot, robots, generator, 50)
    loose, tight = solve_numeric(robot, T, start, tolerance=1e-3), solve_numeric(robot, T, start)
    assert loose.iterations.sum() < tight.iterations.sum()
    assert 1e-9 < loose.position_residual.max() < 1e-3


@pytest.mark.parametrize("name", ["kiro4", "ur5", "seven"])
def test_singular_solutions_are_reached_with_their_status(name, robots):
    robot = robots.load(name)
    q = torch.tensor([0.4, -0.9, 1.1, 0.5, 0.0, 0.7, 0.2][: robot.dof], dtype=torch.float64)
    if name == "seven":
        q[[1, 3, 5]] = 0.0
    T = forward_kinematics(robot, q)
    solution = solve_numeric(robot, T, q)
    assert solution.status == Status.SINGULAR
    assert_close(forward_kinematics(robot, solution.q), T, atol=1e-12)


def test_joints_outside_their_limits_are_wrapped_or_reported(robots, generator):
    robot = robots.load("kiro4")
    q, T, _ = _targets(robot, robots, generator, 50, spread=0.0)
    turned = solve_numeric(robot, T, q + 2 * math.pi)
    assert (turned.status == Status.REACHED).all()
    assert_close(turned.q, q, atol=1e-9)
    narrow = replace(robot, rows=(*robot.rows[:5], replace(robot.rows[5], lower=-0.5, upper=0.5)))
    status = solve_numeric(narrow, T, q + 1e-3).status
    assert torch.equal(status == Status.OUTSIDE_JOINT_LIMITS, q[:, 5].abs() > 0.5)


@pytest.mark.parametrize(
    ("T", "start", "option", "value"),
    [
        (torch.eye(4).double(), torch.full((6,), math.nan).double(), "start", ()),
        (torch.eye(4).double(), torch.zeros(5).double(), "", 5),
        (torch.eye(4).double(), torch.zeros(6), "start", "torch.float32"),
        (torch.eye(4).double().expand(2, 4, 4), torch.zeros((3, 6)).double(), "start", (3,)),
        (torch.zeros((4, 4)).double(), torch.zeros(6).double(), "T_base_tool", ()),
        (torch.eye(3).double(), torch.zeros(6).double(), "T_base_tool", (3, 3)),
    ],
)
def test_invalid_input_is_rejected(T, start, option, value, robots):
    with refused(PoseError, option=option, value=value):
        solve_numeric(robots.load("ur5"), T, start)


@pytest.mark.parametrize("batch", [(), (1,), (3, 1, 2), (0,)])
def test_singularity_measure_is_the_smallest_singular_value(robot, robots, generator, batch):
    q = robots.random_joints(robot, generator, *batch)
    measure = singularity_measure(robot, q)
    assert measure.shape == batch
    length = characteristic_length(robot)
    for index in np.ndindex(*batch):
        J = joint_jacobian(robot, q[index])[1].numpy().copy()
        J[:3] /= length
        J[:, ~np.array(robot.revolute)] *= length
        assert_close(measure[index], np.linalg.svd(J, compute_uv=False)[-1], atol=1e-13)


def test_singularity_measure_vanishes_with_the_bend_of_the_wrist(robots):
    robot = robots.load("kiro4")
    q = torch.tensor([[0.4, 0.3, 0.2, 0.5, bend, 0.7] for bend in (0.0, 1e-4, 1e-2)], dtype=torch.float64)
    measure = singularity_measure(robot, q)
    assert_close(measure[0], 0.0, atol=1e-15)
    assert_close(measure[2] / measure[1], 100.0, rtol=0.02)
