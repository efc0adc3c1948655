"""Closed form of arms with three parallel axes: all branches, mirror images, singular and unreachable poses."""

import math

import pytest
import torch
from testing.closeness import assert_close

from pisigma.robot import Robot
from pisigma.robot.kinematics.closed_form import closed_form_solver
from pisigma.robot.kinematics.closed_form.three_parallel import ThreeParallelArm
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.status import Status
from pisigma.robot.se3 import pose_error, transform_from_xyz_zyx

RIGHT = math.pi / 2


def _all_lengths() -> Robot:
    """An arm that uses every length of this family."""
    arm = Robot.load("ur10")
    dh = arm.dh.copy()
    dh[:, 1] = [0.2, 0.13, -0.11, 0.15, 0.12, 0.09]
    dh[:, 2] = [0.07, -0.6, 0.5, 0.04, 0.0, 0.02]
    return arm.with_geometry(dh=dh)


def _mirrored(name: str, flips: tuple[int, ...]) -> Robot:
    """A robot some of whose twists differ by 180 deg."""
    robot = Robot.load(name)
    dh = robot.dh.copy()
    dh[list(flips), 3] += math.pi
    return robot.with_geometry(dh=dh)


def _family(robots) -> dict[str, Robot]:
    return {
        "ur5": robots.load("ur5"),
        "ur10": robots.load("ur10"),
        "rb5": robots.load("rb5"),
        "all lengths": _all_lengths(),
        "dressed ur5": robots.dress(robots.load("ur5")),
        "dressed all lengths": robots.dress(_all_lengths()),
        "mirrored ur10": _mirrored("ur10", (0, 2, 4)),
        "mirrored rb5": _mirrored("rb5", (1, 3)),
    }


FAMILY = (
    "ur5", "ur10", "rb5", "all lengths", "dressed ur5", "dressed all lengths", "mirrored ur10", "mirrored rb5"
)  # fmt: skip


def _distance(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Return the largest difference of joint values modulo full turns."""
    return 2 * torch.sin((a - b) / 2).abs().amax(-1)


@pytest.mark.parametrize("name", FAMILY)
def test_all_branches_reach_10000_random_poses(name, robots, generator):
    robot = _family(robots)[name]
    solver = closed_form_solver(robot)
    assert isinstance(solver, ThreeParallelArm)
    q = robots.random_joints(robot, generator, 10_000)
    T = forward_kinematics(robot, q)
    solutions = solver.solve(T)
    reached = solutions.status != Status.UNREACHABLE
    assert solutions.q.shape == (10_000, 8, 6)
    assert torch.equal(torch.isnan(solutions.q).any(-1), ~reached)
    again = forward_kinematics(robot, solutions.q)
    error = pose_error(T[:, None].expand(*reached.shape, 4, 4), again)[reached]
    assert_close(error[:, :3].norm(dim=-1), 0.0, atol=1e-12)
    assert_close(error[:, 3:].norm(dim=-1), 0.0, atol=1e-12)
    assert_close(_distance(solutions.q, q[:, None]).nan_to_num(9.0).amin(-1), 0.0, atol=1e-7)
    assert 0.5 < reached.double().mean() < 1.0


def test_the_eight_branches_differ(robots, generator):
    robot = robots.load("ur5")
    q = (
        closed_form_solver(robot)
        .solve(forward_kinematics(robot, robots.random_joints(robot, generator, 300)))
        .q
    )
    whole = q[torch.isfinite(q).flatten(1).all(-1)]
    assert len(whole) > 100
    for i in range(8):
        for j in range(i):
            assert _distance(whole[:, i], whole[:, j]).median() > 0.1


@pytest.mark.parametrize("batch", [(), (1,), (3, 1, 2), (0,)])
@pytest.mark.parametrize(("dtype", "atol"), [(torch.float64, 1e-12), (torch.float32, 1e-4)])
def test_batches_equal_single_poses_and_keep_the_dtype(batch, dtype, atol, robots, generator):
    robot = robots.load("rb5")
    T = forward_kinematics(robot, robots.random_joints(robot, generator, *batch)).to(dtype)
    solver = closed_form_solver(robot)
    solutions = solver.solve(T)
    assert solutions.q.shape == (*batch, 8, 6)
    assert solutions.q.dtype == dtype
    for T_one, q_one in zip(T.reshape(-1, 4, 4), solutions.q.reshape(-1, 8, 6), strict=True):
        single = solver.solve(T_one).q
        assert torch.equal(torch.isnan(single), torch.isnan(q_one))
        assert_close(single.nan_to_num(0.0), q_one.nan_to_num(0.0), atol=atol)


def test_branch_names_describe_shoulder_elbow_and_wrist(robots, generator):
    robot = robots.load("rb5")
    solver = closed_form_solver(robot)
    T = forward_kinematics(robot, robots.random_joints(robot, generator, 500))
    q = solver.solve(T).q
    for index, name in enumerate(solver.branches):
        shoulder, elbow, wrist = name.split("/")
        found = q[:, index][torch.isfinite(q[:, index]).all(-1)]
        t_2 = found[:, 1] + RIGHT
        axis_4 = 0.425 * torch.cos(t_2) + 0.392 * torch.cos(t_2 + found[:, 2])
        outwards = (axis_4 > 0.05) if shoulder == "front" else (axis_4 < -0.05)
        height = 0.425 * torch.sin(t_2)
        line = (height + 0.392 * torch.sin(t_2 + found[:, 2])) / axis_4 * 0.425 * torch.cos(t_2)
        assert outwards.sum() > 20
        assert ((height > line) == (elbow == "elbow_up"))[outwards].all()
        assert ((torch.sin(found[:, 4]) < 0) == (wrist == "no_flip")).all()


def _at(robot: Robot, q: list[float]) -> torch.Tensor:
    return forward_kinematics(robot, torch.tensor(q, dtype=torch.float64))


SINGULAR_POSES = {
    "elbow stretched": [0.4, -0.9, 0.0, 0.7, 0.6, 0.5],
    "elbow folded": [0.4, -0.9, math.pi, 0.7, 0.6, 0.5],
    "wrist straight": [0.4, -0.9, 1.1, 0.7, 0.0, 0.5],
    "wrist straight backwards": [0.4, -0.9, 1.1, 0.7, math.pi, 0.5],
}


@pytest.mark.parametrize("case", SINGULAR_POSES)
@pytest.mark.parametrize("name", ["ur5", "rb5", "dressed ur5"])
def test_singular_poses_are_reached_with_their_status(case, name, robots):
    robot = _family(robots)[name]
    solver = closed_form_solver(robot)
    q = torch.tensor(SINGULAR_POSES[case], dtype=torch.float64)
    if "elbow" not in case and name != "ur5":
        q[4] = robot.joints[4].direction * (q[4] - solver.rows.offset[4])
    T = forward_kinematics(robot, q)
    solutions = solver.solve(T)
    reached = solutions.status != Status.UNREACHABLE
    singular = solutions.status == Status.SINGULAR
    if "elbow" not in case or not name.startswith("dressed"):
        assert singular.any()
    again = forward_kinematics(robot, solutions.q[reached])
    assert reached.any()
    assert_close(again, T.expand_as(again), atol=1e-12)


def _shoulder_singular(robot: Robot) -> torch.Tensor:
    """Return joint values with the intersection of axes 5 and 6 not ahead of axis 1 (UR5's signs)."""
    d_5, (a_2, a_3) = robot.dh[4, 1], robot.dh[1:3, 2]
    t_2, t_3 = -1.2, 0.8
    t_234 = math.asin(-(a_2 * math.cos(t_2) + a_3 * math.cos(t_2 + t_3)) / d_5)
    return torch.tensor([0.3, t_2, t_3, t_234 - t_2 - t_3, 0.9, 0.2], dtype=torch.float64)


def test_front_and_back_meet_if_the_wrist_is_not_ahead_of_axis_1(robots):
    robot = robots.load("ur5")
    dh = robot.dh.copy()
    dh[4, 1] = 0.8  # so that the wrist gets there with the elbow bent
    robot = robot.with_geometry(dh=dh)
    q = _shoulder_singular(robot)
    T = forward_kinematics(robot, q)
    solutions = closed_form_solver(robot).solve(T)
    reached = solutions.status != Status.UNREACHABLE
    assert reached.any()
    assert (solutions.status[reached] == Status.SINGULAR).all()
    again = forward_kinematics(robot, solutions.q[reached])
    assert_close(again, T.expand_as(again), atol=1e-12)
    assert_close(_distance(solutions.q[reached], q).amin(), 0.0, atol=1e-6)


@pytest.mark.parametrize("offset", [1e-14, 1e-10, 1e-7, 1e-5, 1e-3])
@pytest.mark.parametrize("joint", [2, 4])
def test_near_a_singularity_the_pose_is_still_reached_exactly(joint, offset, robots):
    robot = robots.load("ur5")
    q = [0.4, -0.9, 1.1, 0.7, 0.6, 0.5]
    q[joint] = offset
    T = _at(robot, q)
    solutions = closed_form_solver(robot).solve(T)
    reached = solutions.status != Status.UNREACHABLE
    assert reached.sum() >= 4
    assert (solutions.status == Status.SINGULAR).any() == (offset < 1e-6)
    again = forward_kinematics(robot, solutions.q[reached])
    assert_close(again, T.expand_as(again), atol=1e-12)


@pytest.mark.parametrize("name", ["ur5", "dressed ur5"])
def test_joint_6_of_a_straight_wrist_is_zero(name, robots):
    robot = _family(robots)[name]
    solver = closed_form_solver(robot)
    q = torch.tensor([0.4, -0.9, 1.1, 0.7, 0.0, 0.5], dtype=torch.float64)
    q[4] = -solver.rows.offset[4] * solver.rows.direction[4]
    solutions = solver.solve(forward_kinematics(robot, q))
    own = (2 * torch.sin((solutions.q[:, [0, 4]] - q[[0, 4]]) / 2)).abs().amax(-1) < 1e-9
    assert own.any()
    assert (solutions.status[own] == Status.SINGULAR).all()
    assert_close(solutions.q[own][:, 5], 0.0)


@pytest.mark.parametrize("bend", [0.0, math.pi])
def test_a_straight_wrist_rotates_if_joint_6_at_zero_does_not_reach(bend, robots):
    """Arm and hand almost stretched in one line: the pose is reached only with axis 4 about where it is."""
    robot = robots.load("ur5")
    q = torch.tensor([0.4, -0.9, 1e-2, 3 * RIGHT, bend, 2.0], dtype=torch.float64)
    T = forward_kinematics(robot, q)
    solutions = closed_form_solver(robot).solve(T)
    reached = solutions.status == Status.SINGULAR
    assert reached.any()
    assert (solutions.q[reached][:, 5].abs() > 0.1).all()
    again = forward_kinematics(robot, solutions.q[reached])
    assert_close(again, T.expand_as(again), atol=1e-12)


def test_poses_out_of_reach_are_unreachable(robots):
    T = transform_from_xyz_zyx(
        torch.tensor([[1.3, 0.0, 0.3, 0.1, 0.2, 0.3], [0.0, 0.05, 0.3, 0.4, -0.3, 1.7]], dtype=torch.float64)
    )
    solutions = closed_form_solver(robots.load("ur5")).solve(T)
    assert (solutions.status[0] == Status.UNREACHABLE).all()
    assert torch.isnan(solutions.q[0]).all()


def test_the_wrist_cannot_be_near_axis_1(robots):
    """The intersection of axes 5 and 6 has at least the distance d_2 + d_3 + d_4 from axis 1."""
    robot = robots.load("ur5")
    T = transform_from_xyz_zyx(torch.tensor([0.05, 0.0, 0.5 + 0.0823, 0.0, 0.0, 0.0], dtype=torch.float64))
    assert (closed_form_solver(robot).solve(T).status == Status.UNREACHABLE).all()


@pytest.mark.parametrize(
    ("row", "column", "value"), [(4, 2, 1e-6), (0, 4, 1e-12), (1, 3, 1e-9), (3, 3, 0.1), (2, 4, -1e-3)]
)
def test_any_length_twist_error_or_beta_excludes_the_closed_form(row, column, value, robots):
    robot = robots.load("ur10")
    dh = robot.dh.copy()
    dh[row, column] += value
    assert closed_form_solver(robot.with_geometry(dh=dh)) is None


@pytest.mark.parametrize("row", [1, 2])
def test_a_link_without_length_has_no_closed_form(row, robots):
    robot = robots.load("ur5")
    dh = robot.dh.copy()
    dh[row, 2] = 0.0
    assert closed_form_solver(robot.with_geometry(dh=dh)) is None
