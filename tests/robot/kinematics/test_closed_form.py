"""Closed-form inverses: all branches reach the pose, and the status reports singularities and limits."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.closeness import assert_close, joint_distance
from testing.refusals import refused

from pisigma.files.errors import PoseError
from pisigma.robot import Robot
from pisigma.robot.kinematics.closed_form import closed_form_solver
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.status import Status
from pisigma.robot.se3 import pose_error, transform, transform_from_xyz_zyx

RIGHT = math.pi / 2
BATCHES = [(), (1,), (3, 1, 2), (0,)]


def _big_arm() -> Robot:
    """An arm that uses every length, with the directions of a large industrial robot."""
    arm = Robot.load("kiro4")
    d, a = (0.67, 0.05, -0.02, 1.28, 0.0, 0.215), (0.312, 1.075, 0.225, 0.0, 0.0, 0.01)
    dh = np.column_stack([arm.dh[:, 0], d, a, arm.dh[:, 3], arm.dh[:, 4]])
    rows = tuple(replace(row, direction=s) for row, s in zip(arm.rows, (1, 1, -1, -1, -1, -1), strict=True))
    return replace(arm, name="big", rows=rows, dh=dh)


def _mirrored(name: str, flips: tuple[int, ...]) -> Robot:
    """A robot some of whose twists differ by 180 deg."""
    robot = Robot.load(name)
    dh = robot.dh.copy()
    dh[list(flips), 3] += math.pi
    return robot.with_geometry(dh=dh)


def _bent_slide() -> Robot:
    """A SCARA whose prismatic row has an angle and a length."""
    robot = Robot.load("kiro3")
    dh = robot.dh.copy()
    dh[2] = [0.7, 0.05, 0.1, 0.0, 0.0]
    return robot.with_geometry(dh=dh)


def _family(robots) -> dict[str, Robot]:
    return {
        "kiro3": robots.load("kiro3"),
        "kiro4": robots.load("kiro4"),
        "dressed kiro3": robots.dress(robots.load("kiro3")),
        "dressed kiro4": robots.dress(robots.load("kiro4")),
        "big": _big_arm(),
        "dressed big": robots.dress(_big_arm()),
        "mirrored kiro3": _mirrored("kiro3", (1,)),
        "mirrored kiro3 twice": _mirrored("kiro3", (0, 1, 2)),
        "mirrored kiro4": _mirrored("kiro4", (0, 2, 3)),
        "mirrored kiro4 wrist": _mirrored("kiro4", (1, 4)),
        "bent slide": _bent_slide(),
    }


FAMILY = [
    "kiro3", "kiro4", "dressed kiro3", "dressed kiro4", "big", "dressed big", "mirrored kiro3",
    "mirrored kiro3 twice", "mirrored kiro4", "mirrored kiro4 wrist", "bent slide",
]  # fmt: skip


@pytest.mark.parametrize("name", FAMILY)
def test_all_branches_reach_10000_random_poses(name, robots, generator):
    robot = _family(robots)[name]
    solver = closed_form_solver(robot)
    q = robots.random_joints(robot, generator, 10_000)
    T = forward_kinematics(robot, q)
    solutions = solver.solve(T)
    reached = solutions.status != Status.UNREACHABLE
    assert solutions.q.shape == (10_000, len(solver.branches), robot.dof)
    assert torch.equal(torch.isnan(solutions.q).any(-1), ~reached)
    error = pose_error(T[:, None].expand(*reached.shape, 4, 4), forward_kinematics(robot, solutions.q))[
        reached
    ]
    assert_close(error[:, :3].norm(dim=-1), 0.0, atol=1e-12)
    assert_close(error[:, 3:].norm(dim=-1), 0.0, atol=1e-12)
    back = joint_distance(robot, solutions.q, q[:, None]).nan_to_num(9.0).amin(-1)
    assert_close(back, 0.0, atol=1e-7)
    assert reached.any(-1).all()


@pytest.mark.parametrize("name", ["kiro3", "kiro4"])
def test_all_branches_are_returned_and_differ(name, robots, generator):
    robot = robots.load(name)
    q = (
        closed_form_solver(robot)
        .solve(forward_kinematics(robot, robots.random_joints(robot, generator, 100)))
        .q
    )
    for i in range(q.shape[1]):
        for j in range(i):
            assert joint_distance(robot, q[:, i], q[:, j]).median() > 0.1


def test_branch_names_describe_elbow_and_wrist_centre(robots, generator):
    robot = robots.load("kiro4")
    solver = closed_form_solver(robot)
    T = forward_kinematics(robot, robots.random_joints(robot, generator, 200))
    T = T[torch.hypot(T[:, 0, 3], T[:, 1, 3]) > 0.05]
    q = solver.solve(T).q
    elbow_q = torch.cat([q[..., :2], torch.zeros_like(q[..., 2:])], -1)
    elbow_robot = robot.with_geometry(dh=np.where(np.arange(6)[:, None] < 2, robot.dh, 0.0))
    elbow = forward_kinematics(elbow_robot, elbow_q)[..., :3, 3]
    centre = T[:, None, :3, 3]
    normal = torch.linalg.cross(elbow, centre.expand_as(elbow))
    outward = torch.stack([centre[..., 1], -centre[..., 0], torch.zeros_like(centre[..., 0])], -1)
    above = (normal * outward).sum(-1) < 0
    ahead = (torch.cos(q[..., 0]) * centre[..., 0] + torch.sin(q[..., 0]) * centre[..., 1]) > 0
    for branch, name in enumerate(solver.branches):
        shoulder, side, wrist = name.split("/")
        assert (ahead[:, branch] == (shoulder == "front")).all(), name
        assert (above[:, branch] == (side == "elbow_up")).all(), name
        assert ((q[:, branch, 4] > 0) == (wrist == "no_flip")).all(), name


@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize(("dtype", "atol"), [(torch.float64, 1e-13), (torch.float32, 1e-3)])
@pytest.mark.parametrize("name", ["kiro3", "kiro4"])
def test_batched_equals_looped_in_every_shape_and_dtype(name, robots, generator, batch, dtype, atol):
    robot = robots.load(name)
    solver = closed_form_solver(robot)
    T = forward_kinematics(robot, 0.3 + 0.5 * robots.random_joints(robot, generator, *batch))
    solutions = solver.solve(T.to(dtype))
    assert solutions.q.shape == (*batch, len(solver.branches), robot.dof)
    assert (solutions.q.dtype, solutions.status.dtype) == (dtype, torch.int64)
    for index in np.ndindex(*batch):
        one = solver.solve(T[index])
        assert torch.equal(solutions.status[index], one.status)
        assert_close(joint_distance(robot, solutions.q[index], one.q.to(dtype)), 0.0, atol=atol)


@pytest.mark.parametrize("name", ["kiro3", "kiro4", "dressed kiro3", "dressed big"])
def test_poses_out_of_reach_are_nan_with_a_status(name, robots):
    robot = _family(robots)[name]
    solutions = closed_form_solver(robot).solve(
        transform_from_xyz_zyx(torch.full((2, 6), 9.0, dtype=torch.float64))
    )
    assert (solutions.status == Status.UNREACHABLE).all()
    assert torch.isnan(solutions.q).all()


@pytest.mark.parametrize("name", ["kiro3", "kiro4", "big", "rb5"])
def test_the_nearest_joint_values_reach_a_pose_or_nearly(name, robots, generator):
    robot = robots.load(name) if name == "rb5" else _family(robots)[name]
    solver = closed_form_solver(robot)
    T = forward_kinematics(robot, robots.random_joints(robot, generator, 2_000))
    solved, nearest = solver.solve(T).q, solver.start_values(T)
    assert bool(torch.isfinite(nearest).all())
    reached = torch.isfinite(solved).all(-1)
    off = pose_error(T[:, None].expand(*nearest.shape[:-1], 4, 4), forward_kinematics(robot, nearest))[
        reached
    ].norm(dim=-1)
    assert float(off.quantile(0.99)) < 0.03
    assert float(off.median()) < 1e-12
    assert_close(nearest.nan_to_num()[reached][off < 1e-12], solved[reached][off < 1e-12], atol=1e-9)


def test_a_wrist_centre_inside_the_dead_cylinder_is_unreachable(robots, generator):
    robot = _big_arm()
    T = transform(
        torch.eye(3, dtype=torch.float64), torch.tensor([0.005, 0.0, 2.4 + 0.215], dtype=torch.float64)
    )
    assert (closed_form_solver(robot).solve(T).status == Status.UNREACHABLE).all()


def test_a_tilted_tool_is_unreachable_for_a_scara(robots):
    T = transform_from_xyz_zyx(
        torch.tensor([[0.3, 0.2, 0.3, 0.5, tilt, 0.0] for tilt in (0.0, 1e-6, 0.3, math.pi)])
    )
    solutions = closed_form_solver(robots.load("kiro3")).solve(T.double())
    assert (solutions.status[0] == Status.REACHED).all()
    assert (solutions.status[1:] == Status.UNREACHABLE).all()


ON_AXIS_1 = -math.atan2(0.8 * math.cos(0.3), 0.6 - 0.8 * math.sin(0.3))
"""theta_2 [rad] that brings the wrist centre of kiro4 onto axis 1 where theta_3 = 0.3."""

SINGULAR_POSES = {
    "kiro3 stretched": ("kiro3", [0.4, 0.0, -0.1, 0.2]),
    "kiro4 stretched": ("kiro4", [0.4, 0.3, -RIGHT, 0.5, 0.6, 0.7]),
    "kiro4 wrist straight": ("kiro4", [0.4, 0.3, 0.2, 0.5, 0.0, 0.7]),
    "kiro4 wrist centre on axis 1": ("kiro4", [0.4, ON_AXIS_1, 0.3, 1.0, 0.7, 0.1]),
    "big wrist straight": ("big", [0.4, 0.3, 0.2, 0.5, 0.0, 0.7]),
}


@pytest.mark.parametrize("case", SINGULAR_POSES)
def test_singular_poses_are_reached_with_their_status(case, robots):
    name, q = SINGULAR_POSES[case]
    robot = _family(robots)[name]
    T = forward_kinematics(robot, torch.tensor(q, dtype=torch.float64))
    solutions = closed_form_solver(robot).solve(T)
    singular = solutions.status == Status.SINGULAR
    assert singular.any()
    again = forward_kinematics(robot, solutions.q[singular])
    assert_close(again, T.expand_as(again), atol=1e-12)


@pytest.mark.parametrize("offset", [1e-14, 1e-10, 1e-7, 1e-5, 1e-3])
@pytest.mark.parametrize("joint", [2, 4])
def test_near_a_singularity_the_pose_is_still_reached_exactly(joint, offset, robots):
    robot = robots.load("kiro4")
    q = torch.tensor([0.4, 0.3, 0.2, 0.5, 0.6, 0.7], dtype=torch.float64)
    q[joint] = offset - (RIGHT if joint == 2 else 0.0)
    T = forward_kinematics(robot, q)
    solutions = closed_form_solver(robot).solve(T)
    front = solutions.status[:4]
    assert (front != Status.UNREACHABLE).all()
    assert ((front == Status.SINGULAR).any()) == (offset < 1e-6)
    assert_close(forward_kinematics(robot, solutions.q[:4]), T.expand(4, 4, 4), atol=1e-12)


def test_joint_4_of_a_straight_wrist_is_zero(robots):
    solver = closed_form_solver(robots.dress(robots.load("kiro4")))
    q = torch.tensor([0.4, 0.3, 0.2, 0.5, 0.0, 0.7], dtype=torch.float64)
    q[4] = -solver.rows.offset[4] * solver.rows.direction[4]
    solutions = solver.solve(forward_kinematics(solver.robot, q))
    own = (solutions.q[..., :3] - q[:3]).abs().amax(-1) < 1e-9
    assert own.sum() == 2
    assert (solutions.status[own] == Status.SINGULAR).all()
    assert_close(solutions.q[own][0, 3], 0.0)


def test_an_undetermined_joint_1_is_zero(robots):
    q = torch.tensor(SINGULAR_POSES["kiro4 wrist centre on axis 1"][1], dtype=torch.float64)
    on_axis = closed_form_solver(robots.load("kiro4")).solve(forward_kinematics(robots.load("kiro4"), q))
    assert (on_axis.status == Status.SINGULAR).all()
    assert_close(on_axis.q[:4, 0], 0.0)
    assert_close(on_axis.q[4:, 0].abs(), math.pi)
    scara = robots.load("kiro3")
    scara = replace(scara, rows=tuple(replace(row, lower=-math.inf, upper=math.inf) for row in scara.rows))
    folded_joints = torch.tensor([0.4, math.pi, -0.1, 0.2], dtype=torch.float64)
    folded = closed_form_solver(scara).solve(forward_kinematics(scara, folded_joints))
    assert (folded.status == Status.SINGULAR).all()
    assert_close(folded.q[:, 0], 0.0)


def _limited(robot: Robot, joint: int, lower: float, upper: float) -> Robot:
    rows = [replace(row, lower=-np.inf, upper=np.inf) for row in robot.rows]
    rows[joint] = replace(rows[joint], lower=lower, upper=upper)
    return replace(robot, rows=tuple(rows))


@pytest.mark.parametrize(
    ("lower", "upper", "expected", "status"),
    [
        (-1.0, 1.0, 0.5, Status.REACHED),
        (0.5, 1.0, 0.5, Status.REACHED),
        (4.0, 7.0, 0.5 + 2 * math.pi, Status.REACHED),
        (-7.0, -5.0, 0.5 - 2 * math.pi, Status.REACHED),
        (0.6, 1.0, 0.5, Status.OUTSIDE_JOINT_LIMITS),
        (-1.0, 0.4, 0.5, Status.OUTSIDE_JOINT_LIMITS),
    ],
)
def test_full_turns_bring_a_joint_inside_or_the_status_says_outside(robots, lower, upper, expected, status):
    robot = _limited(robots.load("kiro4"), 3, lower, upper)
    q = torch.tensor([0.4, 0.3, 0.2, 0.5, 0.6, 0.7], dtype=torch.float64)
    solutions = closed_form_solver(robot).solve(forward_kinematics(robot, q))
    own = (solutions.q[:, [0, 1, 2, 4, 5]] - q[[0, 1, 2, 4, 5]]).abs().amax(-1) < 1e-9
    assert own.sum() == 1
    assert_close(solutions.q[own][0, 3], expected, atol=1e-12)
    assert solutions.status[own] == status


def test_a_prismatic_joint_beyond_its_stroke_is_outside_its_limits(robots):
    T = transform_from_xyz_zyx(torch.tensor([0.3, 0.2, 0.5, 0.0, 0.0, 0.0], dtype=torch.float64))
    solutions = closed_form_solver(robots.load("kiro3")).solve(T)
    assert (solutions.status == Status.OUTSIDE_JOINT_LIMITS).all()
    assert_close(solutions.q[:, 2], 0.053, atol=1e-12)


@pytest.mark.parametrize("name", ["odd", "seven", "panda"])
def test_other_robots_have_no_closed_form(name, robots):
    assert closed_form_solver(robots.load(name)) is None


@pytest.mark.parametrize("name", ["kiro3", "kiro4"])
@pytest.mark.parametrize(
    ("row", "column", "value"), [(0, 4, 1e-12), (1, 3, 1e-9), (2, 4, -1e-3), (2, 3, 0.1)]
)
def test_any_twist_error_or_beta_excludes_the_closed_form(name, row, column, value, robots):
    robot = robots.load(name)
    dh = robot.dh.copy()
    dh[row, column] += value
    assert closed_form_solver(robot.with_geometry(dh=dh)) is None


@pytest.mark.parametrize(("row", "column"), [(3, 2), (4, 1), (4, 2), (1, 2)])
def test_other_wrists_and_links_without_length_have_no_closed_form(row, column, robots):
    dh = robots.load("kiro4").dh.copy()
    dh[row, column] = 0.0 if dh[row, column] else 1e-6
    assert closed_form_solver(robots.load("kiro4").with_geometry(dh=dh)) is None


@pytest.mark.parametrize("name", ["kiro3", "kiro4"])
@pytest.mark.parametrize(
    ("T", "expected", "value"),
    [
        (torch.full((2, 4, 4), math.nan), "finite entries", (0,)),
        (torch.stack([torch.eye(4), 2 * torch.eye(4)]), "the last row 0 0 0 1", (1,)),
        (
            torch.diag(torch.tensor([1.0, 1.0, -1.0, 1.0])),
            "a right-handed rotation part (determinant +1)",
            (),
        ),
        (torch.eye(3), "homogeneous transforms of shape (*batch, 4, 4)", (3, 3)),
        (torch.eye(4, dtype=torch.int32), "float64 or float32 values with lengths in metres", torch.int32),
    ],
)
def test_invalid_poses_are_rejected(name, T, expected, value, robots):
    with refused(PoseError, expected=expected, value=value):
        closed_form_solver(robots.load(name)).solve(T)


def test_every_status_has_its_sentence_with_a_remedy():
    sentences = [status.sentence for status in Status]
    assert len(set(sentences)) == len(sentences) == 7
    assert all(";" in sentence for status, sentence in zip(Status, sentences, strict=True) if status)
    assert [s for s in Status if not s.reaches] == [
        Status.UNREACHABLE,
        Status.NOT_CONVERGED,
        Status.INVALID_POSE,
    ]
