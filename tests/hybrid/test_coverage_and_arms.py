"""Measured stretches of joint values, how a correction fades beyond them, and blends of poses."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from testing.closeness import assert_close
from testing.linearised import drawn_joints
from torch import Tensor

from pisigma.hybrid.arm import HybridArm, blend
from pisigma.hybrid.coverage import FADE, JointCoverage, share_beyond
from pisigma.joint_correction.fourier_series import FourierSeries
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.kinematics.forward import forward_kinematics
from pisigma.robot import Robot
from pisigma.se3 import rotation_from_vector, rotation_vector, transform


def line(*ends: tuple[float, float], count: int = 40) -> Tensor:
    """Angles [rad] all over some stretches [deg]."""
    return torch.cat([torch.linspace(low, high, count, dtype=torch.float64) for low, high in ends]).deg2rad()


def coverage_of(first: Tensor, name: str = "ur5", joint: int = 0) -> JointCoverage:
    """Of a robot whose other joints were measured all over a turn."""
    robot = Robot.load(name)
    q = drawn_joints(robot, len(first), 0)
    columns = [torch.linspace(-np.pi, np.pi, len(first), dtype=torch.float64)] * robot.dof
    q = torch.stack(columns, 1) if all(robot.revolute) else q
    q[:, joint] = first
    return JointCoverage.of(robot, q)


def beyond(coverage: JointCoverage, *angles: float) -> Tensor:
    """Of values of the first joint [deg], in degrees."""
    q = torch.zeros(len(angles), len(coverage.turning), dtype=torch.float64)
    q[:, 0] = torch.tensor(angles, dtype=torch.float64).deg2rad()
    return coverage.beyond(q)[:, 0].rad2deg()


def test_a_gap_wider_than_allowed_was_not_measured_and_a_narrower_one_was() -> None:
    found = coverage_of(line((-90, -60), (-1, 30), (95, 150)))
    assert int((found.joint == 0).sum()) == 2
    assert_close(beyond(found, -90, -30, 15, 30, 95, 140), torch.zeros(6), atol=1e-9)
    expected = torch.tensor([10.0, 50.0, 20.0, 10.0, 15.0, 5.0]).double()
    assert_close(beyond(found, -100, -160, 250, 40, 80, 155), expected, atol=1e-9)


def test_a_stretch_may_reach_over_the_full_turn() -> None:
    found = coverage_of(line((150, 180), (-180, -100)))
    assert int((found.joint == 0).sum()) == 1
    assert_close(beyond(found, 180, -180, 155, 540, -105), torch.zeros(5), atol=1e-9)
    assert_close(
        beyond(found, 140, -90, 25, 380), torch.tensor([10.0, 10.0, 125.0, 120.0]).double(), atol=1e-9
    )


def test_two_stretches_one_of_them_over_the_full_turn() -> None:
    found = coverage_of(line((-20, 20), (100, 140)))
    assert int((found.joint == 0).sum()) == 2
    assert_close(
        beyond(found, -20, 10, 350, 120, 30, -30), torch.tensor([0.0, 0, 0, 0, 10, 10]).double(), atol=1e-9
    )


def test_a_joint_measured_all_around_has_nothing_beyond() -> None:
    found = coverage_of(line((-180, 160), count=100))
    assert_close(beyond(found, *range(-400, 400, 7)), torch.zeros(115))


def test_values_a_full_turn_apart_are_the_same_for_turning_joints_only() -> None:
    found = coverage_of(line((0, 40)))
    q = torch.linspace(-3, 3, 50, dtype=torch.float64)[:, None].expand(50, 6)
    assert_close(found.share(q + 2 * math.pi), found.share(q), atol=1e-12)
    sliding = coverage_of(torch.linspace(-0.3, -0.1, 50, dtype=torch.float64), "kiro3", 2)
    assert sliding.turning == (True, True, False, True)
    travel = float(np.diff(Robot.load("kiro3").limits)[2, 0])
    q = torch.zeros(3, 4, dtype=torch.float64)
    q[:, 2] = torch.tensor([-0.2, -0.1 + 0.05, -0.3 - 2 * travel])
    expected = torch.tensor([0.0, 0.05, 2 * travel]).double() * math.pi / travel
    assert_close(sliding.beyond(q)[:, 2], expected, atol=1e-7)


def test_one_row_is_a_stretch_of_no_length() -> None:
    robot = Robot.load("ur5")
    q = torch.full((1, 6), 0.4, dtype=torch.float64)
    found = JointCoverage.of(robot, q)
    assert_close(found.half, torch.zeros(6))
    assert_close(found.share(q), torch.ones(1))
    assert_close(found.share(q + 0.5), torch.zeros(1))
    assert found.share(q[0]).shape == ()
    assert found.share(q.view(1, 1, 6)).shape == (1, 1)


def test_the_joint_that_is_farthest_out_decides() -> None:
    found = JointCoverage.of(Robot.load("ur5"), torch.zeros(1, 6, dtype=torch.float64), 0.2)
    q = torch.tensor([[0.05, -0.1, 0.0, 0.0, 0.02, 0.0]], dtype=torch.float64)
    assert_close(found.share(q), share_beyond(torch.tensor([0.1], dtype=torch.float64), 0.2))
    assert_close(found.share(q), 0.5, atol=1e-12)


@given(st.floats(-400, 400), st.floats(1, 40))
def test_share_falls_smoothly_from_one_to_nothing(angle: float, fade: float) -> None:
    """With a slope that is nowhere steeper than 1.5 over the fade and 0 at both ends."""
    off, width = torch.tensor(abs(angle)).double().deg2rad(), math.radians(fade)
    step = 1e-5 * width
    here, further = share_beyond(off, width), share_beyond(off + step, width)
    slope = float(here - further) / step * width
    assert -1e-9 <= slope <= 1.5 + 1e-6
    if float(off) == 0.0:
        assert float(here) == 1.0
        assert slope < 1e-3
    if float(off) >= width:
        assert float(here) == 0.0


def test_share_has_no_steps_along_a_joint() -> None:
    found = coverage_of(line((-60, 0), (60, 100)))
    q = torch.zeros(20_001, 6, dtype=torch.float64)
    q[:, 0] = torch.linspace(-math.pi, math.pi, 20_001, dtype=torch.float64)
    share = found.share(q)
    rise = share.diff().abs().max() / (2 * math.pi / 20_000)
    assert float(rise) < 1.51 / FADE
    bend = share.diff().diff().abs().max() / (2 * math.pi / 20_000) ** 2
    assert float(bend) < 6.1 / FADE**2
    assert (float(share.min()), float(share.max())) == (0.0, 1.0)


def poses(count: int, turn: float, seed: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)

    def drawn(scale: float) -> Tensor:
        vectors = scale * torch.randn(count, 6, generator=generator, dtype=torch.float64)
        return transform(rotation_from_vector(vectors[:, 3:]), vectors[:, :3])

    first = drawn(1.0)
    return first, first @ drawn(turn)


@pytest.mark.parametrize("turn", [1e-6, 1e-3, 0.5])
def test_blend_goes_the_straight_way_and_ends_exactly(turn: float) -> None:
    T_from, T_to = poses(50, turn, 0)
    ones = torch.ones(50, dtype=torch.float64)
    assert bool((blend(T_from, T_to, ones) == T_to).all())
    assert_close(blend(T_from, T_to, 0 * ones), T_from, atol=1e-15)
    for share in (0.25, 0.7):
        T = blend(T_from, T_to, share * ones)
        R = T[:, :3, :3]
        assert_close(R @ R.mT, torch.eye(3).double().expand(50, 3, 3), atol=1e-14)
        assert_close(torch.linalg.det(R), ones, atol=1e-14)
        assert_close(T[:, 3], T_to[:, 3])
        assert_close(T[:, :3, 3], (1 - share) * T_from[:, :3, 3] + share * T_to[:, :3, 3], atol=1e-14)
        whole = rotation_vector(T_from[:, :3, :3].mT @ T_to[:, :3, :3])
        part = rotation_vector(T_from[:, :3, :3].mT @ R)
        assert_close(part, share * whole, atol=1e-12)


def test_blend_of_single_poses_and_of_shares_that_differ() -> None:
    T_from, T_to = poses(4, 1e-2, 1)
    share = torch.tensor([0.0, 0.3, 1.0, 0.9], dtype=torch.float64)
    whole = blend(T_from, T_to, share)
    for k in range(4):
        assert_close(blend(T_from[k], T_to[k], share[k]), whole[k], atol=1e-15)


def test_hybrid_arm_is_the_hybrid_where_it_was_measured_and_the_geometric_one_beyond() -> None:
    robot = Robot.load("ur5")
    hybrid = robot.with_geometry(dh=robot.dh + 1e-3)
    correction = JointCorrection(robot, (FourierSeries(robot, 2),)).requires_grad_(False)
    correction.linear[0].fill_(1e-3)
    inside = drawn_joints(robot, 300, 0, widest=0.8)
    arm = HybridArm(robot, hybrid, correction, JointCoverage.of(robot, inside))
    assert_close(arm.forward(inside), forward_kinematics(hybrid, inside + correction(inside)), atol=1e-15)
    outside = inside[:20] + torch.tensor([0.0, 0, 2.5, 0, 0, 0]).double()
    assert_close(arm.forward(outside), forward_kinematics(robot, outside), atol=1e-14)
    between = inside[:20].clone()
    between[:, 2] = 0.9
    T = arm.forward(between)
    share = arm.coverage.share(between)
    assert bool(((share > 0.1) & (share < 0.999)).all())
    ends = forward_kinematics(robot, between), forward_kinematics(hybrid, between + correction(between))
    assert_close(T, blend(*ends, share), atol=1e-14)
    assert_close(arm.forward(between[0]), T[0], atol=1e-14)
