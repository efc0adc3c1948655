"""Tasks with fewer than six constrained axes, and arms with fewer or more than six joints."""

import functools
import math

import numpy as np
import pytest
import torch
from testing.calibrated_arm import calibrated_arm, calibrated_robot, joints_of
from testing.closeness import assert_close
from testing.models import hand_made_model, no_type_checker, poses_around
from testing.refusals import refused

from pisigma.files.errors import PoseError
from pisigma.model.inverse.corrected_ik import CorrectedIK
from pisigma.model.inverse.numeric_ik import NumericIK
from pisigma.robot import Robot
from pisigma.robot.kinematics.status import Status
from pisigma.robot.kinematics.task_axes import WHOLE, TaskAxes, default_axes, task_axes
from pisigma.robot.kinematics.task_error import task_error
from pisigma.robot.row import Row

pytestmark = pytest.mark.usefixtures("without_type_checker")

FIVE = Robot(
    "five",
    "",
    "",
    tuple(
        Row(f"j{i}", "revolute", lower=-limit, upper=limit)
        for i, limit in enumerate((2.9, 1.5, 2.6, 2.1, 3.1))
    ),
    np.array(
        [
            [0, 0.4, 0.1, 1.5708, 0],
            [0, 0, 0.45, 0, 0],
            [0, 0, 0.4, 0, 0],
            [1.57, 0, 0, 1.57, 0],
            [0, 0.15, 0, 0, 0],
        ]
    ),
)
"""Arm with five axes, the last of which rotates the tool."""


@functools.cache
def model_of(name: str):
    """A calibrated arm; "rail" is a UR5 on a rail."""
    if name == "five":
        return calibrated_robot(FIVE)
    if name != "rail":
        return calibrated_arm(name)
    arm = Robot.load("ur5")
    rows = (Row("rail", "prismatic", lower=0.0, upper=3.0), Row("up", "fixed"), *arm.rows)
    dh = np.concatenate([[[0, 0, 0, -math.pi / 2, 0], [0, 0, 0, math.pi / 2, 0]], arm.dh])
    return calibrated_robot(Robot("rail", "", "", rows, dh))


def turned(T: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Rotate the tool of poses about its z axis."""
    Z = np.tile(np.eye(4), (len(T), 1, 1))
    Z[:, 0, 0] = Z[:, 1, 1] = np.cos(angle)
    Z[:, 1, 0], Z[:, 0, 1] = np.sin(angle), -np.sin(angle)
    return T @ Z


def wanted(name: str, rows: int, axes: TaskAxes) -> np.ndarray:
    """Poses that the calibrated arm reaches, for a SCARA rounded to 1e-7 m, with random yaw if it is ignored."""
    T = model_of(name).forward(joints_of(model_of(name).robot, rows, seed=5, share=0.98)).numpy()
    if "yaw" in axes.ignored:
        T = turned(T, np.linspace(-3, 3, rows))
    return T.round(7) if name == "kiro3" else T


def errors(name: str, T: np.ndarray, q: np.ndarray, axes: TaskAxes) -> torch.Tensor:
    """Residuals in the constrained axes, computed by the model in torch."""
    left, _ = task_error(axes, torch.from_numpy(T), model_of(name).forward(torch.from_numpy(q)))
    return left[:, ~torch.tensor(axes.free)]


TASKS = [
    ("kiro3", None),
    ("five", None),
    ("ur5", ("yaw",)),
    ("ur5", ("roll", "pitch", "yaw")),
    ("rail", None),
    ("panda", None),
]


@pytest.mark.parametrize(("name", "ignored"), TASKS)
def test_reachable_poses_are_reached_in_the_constrained_axes(name, ignored):
    ik = CorrectedIK(model_of(name)).for_task(ignored)
    T = wanted(name, 150, ik.task_axes)
    solution = ik(T)
    assert solution.ignored_axes == ik.task_axes.ignored
    reached = np.isin(solution.status, (Status.REACHED, Status.OUTSIDE_DOMAIN, Status.SINGULAR))
    assert reached.mean() > 0.99
    assert_close(errors(name, T[reached], solution.q[reached], ik.task_axes), 0.0, atol=1e-10)
    assert np.nanmax(solution.position_residual) < 1e-10
    assert np.nanmax(solution.rotation_residual) < 1e-10


@pytest.mark.parametrize(("name", "ignored"), TASKS)
def test_the_route_without_kernels_meets_the_same_axes(name, ignored):
    axes = default_axes(model_of(name).robot.dof) if ignored is None else task_axes(WHOLE, ignored)
    q = joints_of(model_of(name).robot, 12, seed=5, share=0.9).numpy()
    T = model_of(name).forward(torch.from_numpy(q)).numpy().round(7 if name == "kiro3" else 15)
    near = q + 0.02 * np.sin(np.arange(q.size)).reshape(q.shape)
    found, expected = (
        CorrectedIK(model_of(name)).for_task(ignored)(T, near=near),
        NumericIK(model_of(name), axes).solve_batch(T, near=near),
    )
    assert_close(errors(name, T, expected.q.numpy(), axes), 0.0, atol=1e-10)
    assert expected.ignored_axes == found.ignored_axes
    if sum(axes.weights(q.shape[1])) == q.shape[1]:  # else the many solutions differ a little
        assert np.median(np.abs(found.q - expected.q.numpy()).max(-1)) < 1e-10
        assert_close(found.status, expected.status)
    else:
        off, others = (np.linalg.norm(values - near, axis=-1) for values in (found.q, expected.q.numpy()))
        assert (np.abs(off - others) < 1e-6).mean() > 0.9


def test_a_scara_reaches_tilted_poses_only_if_tilt_is_ignored():
    ik, T = CorrectedIK(model_of("kiro3")), wanted("kiro3", 4, default_axes(4))
    c, s = math.cos(0.5), math.sin(0.5)
    leaning = T.copy()
    leaning[:, :3, :3] = leaning[:, :3, :3] @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    solution = ik(leaning)
    assert (solution.status == Status.UNREACHABLE).all()
    assert solution.sentences[0] == Status.UNREACHABLE.sentence
    reached = ik(leaning, ignore_axes=("roll", "pitch"))
    assert not (reached.status == Status.UNREACHABLE).any()
    assert (ik(T, ignore_axes=()).status == Status.UNREACHABLE).all()  # rounded poses, all six axes


def test_tolerances_are_used_where_a_pose_cannot_be_reached_exactly():
    ik, T = CorrectedIK(model_of("five")), wanted("five", 40, default_axes(5))
    exact = ik.for_task(())
    q = joints_of(FIVE, 40, seed=5, share=0.9)
    reachable = model_of("five").forward(q).numpy()
    assert_close(
        exact(reachable, near=q.numpy(), tolerance_mm=0.1, tolerance_deg=0.1).rotation_residual,
        0.0,
        atol=1e-9,
    )
    off = turned(reachable, np.full(40, 2e-3))
    off[:, :3, 3] += 2e-5
    assert (exact(off).status == Status.UNREACHABLE).mean() > 0.9
    solution = exact(off, tolerance_mm=0.1, tolerance_deg=0.2)
    assert (solution.status != Status.UNREACHABLE).mean() > 0.9
    assert np.nanmax(solution.position_residual) < 1e-4 * 3**0.5
    assert np.nanmax(solution.rotation_residual) > 1e-6
    held = ik(off, ignore_axes=(), tolerance_deg=0.3)
    assert np.nanmax(held.position_residual) < 1e-10  # which has no tolerance
    assert np.isfinite(held.position_residual).mean() > 0.9
    assert (ik(T).status != Status.UNREACHABLE).mean() > 0.95


def test_redundancy_is_resolved_towards_near_or_away_from_limits():
    ik, q = CorrectedIK(model_of("panda")), joints_of(Robot.load("panda"), 30, seed=5, share=0.7).numpy()
    T = ik.forward(q)
    near = q + 0.05 * np.sin(np.arange(q.size)).reshape(q.shape)
    solution = ik(T, near=near)
    assert (
        np.linalg.norm(solution.q - near, axis=-1) <= np.linalg.norm(q - near, axis=-1) + 1e-6
    ).mean() > 0.9
    low, high = ik.limits.T
    margin = np.minimum(ik(T).q - low, high - ik(T).q) / (high - low)
    assert margin.min(-1).mean() > np.minimum(q - low, high - q).min(-1).mean() / (high - low).max()
    assert margin.min() >= 0


def test_only_seven_revolute_joints_have_an_elbow():
    for name in ("ur5", "rail"):
        with refused(PoseError, option="elbow_angle", value=0.3):
            CorrectedIK(model_of(name)).for_task(elbow_angle=0.3)


@pytest.mark.parametrize("angle", [-0.8, 0.5])
def test_the_elbow_angle_is_reached(angle):
    """Seven joints reach six axes and the elbow angle, from different starts."""
    ik, q = CorrectedIK(model_of("panda")), joints_of(Robot.load("panda"), 20, seed=5, share=0.5).numpy()
    T = ik.forward(q)
    first = ik(T, near=q, elbow_angle=angle)
    again = ik(T, near=q + 0.1, elbow_angle=angle)
    reached = np.isfinite(first.q).all(-1) & np.isfinite(again.q).all(-1)
    assert reached.mean() > 0.7
    assert_close(ik.forward(first.q[reached]), T[reached], atol=1e-9)
    assert np.median(np.abs(first.q - again.q)[reached].max(-1)) < 1e-9  # no redundancy is left
    other = ik(T, near=q, elbow_angle=angle + 0.1)
    assert np.nanmedian(np.abs(first.q - other.q).max(-1)) > 0.05


def test_all_solutions_of_an_arm_without_closed_form_differ():
    ik = CorrectedIK(model_of("panda"))
    T = wanted("panda", 10, ik.task_axes)
    every = ik.all_branches(T)
    assert every.q.shape == (10, 8, 7)
    reached = np.isfinite(every.q).all(-1)
    assert reached.sum(-1).min() > 1
    for pose, (rows, q) in enumerate(zip(reached, every.q, strict=True)):
        assert_close(ik.forward(q[rows]), np.broadcast_to(T[pose], (rows.sum(), 4, 4)), atol=1e-9)
        apart = np.abs(np.sin((q[rows][:, None] - q[rows]) / 2)).max(-1) + np.eye(rows.sum())
        assert apart.min() > 0.02


def test_a_path_uses_the_free_rotation_about_the_torch():
    ik = CorrectedIK(model_of("ur5"))
    q = np.linspace([0.3, -1.1, 1.4, -0.9, 0.8, 0.3], [0.6, -0.9, 1.2, -0.7, 0.9, 0.5], 40)
    T = turned(ik.forward(q), np.linspace(0, 3, 40))  # with a fixed yaw the wrist would have to turn
    path = ik.for_task(ignore_axes=("yaw",)).path(T, near=q[0])
    assert not path.switches
    assert np.abs(np.diff(path.solution.q, axis=0)).max() < 0.03
    assert path.solution.ignored_axes == ("yaw",)


@pytest.mark.parametrize(("name", "ignored"), [("kiro3", None), ("ur5", ("yaw",)), ("five", None)])
def test_gradients_are_restricted_to_the_constrained_axes(name, ignored):
    ik = CorrectedIK(model_of(name)).for_task(ignored)
    q = joints_of(model_of(name).robot, 6, seed=5, share=0.6)
    T, step = model_of(name).forward(q), 1e-6
    amount = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    shift = torch.zeros(4, 4, dtype=torch.float64)
    shift[:3, 3] = torch.tensor([0.3, -0.5, 0.4])
    slopes = []
    for column in ik(T + amount[:, None, None] * shift, near=q).q.unbind(-1):
        slopes.append(torch.autograd.grad(column.sum(), amount, retain_graph=True)[0])
    ends = [ik(T + sign * step * shift, near=q).q for sign in (1.0, -1.0)]
    expected = (ends[0] - ends[1]) / (2 * step)
    if len(ik.joints) == 6:  # where redundant joints stay near q instead of moving least
        motion = model_of(name).forward(q + step * torch.stack(slopes, -1)) - T
        assert_close(motion[:, :3, 3] / step, shift[:3, 3].expand(6, 3), atol=5e-3)
    else:
        assert_close(torch.stack(slopes, -1), expected, atol=1e-4, rtol=1e-3)


def test_a_network_on_nominal_joint_values_requires_whole_poses():
    ik = CorrectedIK(hand_made_model("kiro4"))
    with no_type_checker(), refused(PoseError, option="ignore_axes", value=("yaw",)):
        ik(poses_around("kiro4", 2), ignore_axes=("yaw",))
    scara = CorrectedIK(hand_made_model("kiro3"))
    T = poses_around("kiro3", 3).numpy().reshape(-1, 4, 4)
    T[:, :3, :3] = T[:, :3, :3] @ np.array([[1, 0, 0], [0, 1, -1e-7], [0, 1e-7, 1]])
    solution = scara(T)
    assert (solution.status != Status.UNREACHABLE).all()
    assert solution.ignored_axes == ("roll", "pitch")
    assert solution.position_residual.max() < 1e-9
