"""Joint values `near` choose branch and wrapping, and are refused where they are invalid."""

import math
from dataclasses import replace

import pytest
import torch
from testing.calibrated_arm import calibrated_robot, joints_of
from testing.closeness import assert_close
from testing.models import HOMES, hand_made_model, poses_around, statuses, with_limits
from testing.refusals import refused

from pisigma.files.errors import PoseError
from pisigma.model.inverse.corrected_ik import CorrectedIK
from pisigma.model.inverse.numeric_ik import NumericIK
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.status import Status

ROBOTS = tuple(HOMES)


@pytest.mark.parametrize("name", ["kiro3", "kiro4"])
def test_near_chooses_the_branch(name):
    ik = CorrectedIK(hand_made_model(name))
    T = poses_around(name)
    every = ik.all_branches(T)
    for index, status in enumerate(statuses(every)):
        if status not in (Status.UNREACHABLE, Status.OUTSIDE_JOINT_LIMITS):
            solution = ik(T, near=every.q[index] + 0.01)
            assert int(solution.branch) == index
            assert_close(solution.q, every.q[index], atol=1e-12)


def test_near_chooses_the_wrapping():
    robot = with_limits(Robot.load("kiro4"), 5, -20.0, 20.0)
    ik = CorrectedIK(hand_made_model("kiro4", robot=robot))
    T = poses_around("kiro4")
    plain = ik(T)
    for turns in (-3, -1, 0, 2, 3):
        shift = torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, 2 * math.pi * turns], dtype=torch.float64)
        solution = ik(T, near=plain.q + shift + 0.1)
        assert_close(solution.q, plain.q + shift, atol=1e-12)
        assert_close(solution.correction, plain.correction, atol=1e-14)
        assert_close(solution.q - solution.q_nominal, plain.correction, atol=1e-13)
    far = ik(
        T,
        near=plain.q + torch.tensor([0, 0, 0, 0, 0, 23.0], dtype=torch.float64),
        branch=ik.model.branches[0],
    )
    assert 20.0 - 2 * math.pi < float(far.q[5]) <= 20.0  # the nearest turn inside the limits
    assert statuses(far) == statuses(plain)


def test_near_does_not_reach_across_a_limit():
    """A joint at -179 deg is far from 179 deg if the limits are ±180 deg."""
    ik = CorrectedIK(hand_made_model("kiro4", scale=0.0))
    near = torch.tensor([math.radians(179), 0.5, 0.4, 0.3, 0.8, 0.2], dtype=torch.float64)
    q = near.clone()
    q[0] = math.radians(-179)
    solution = ik(forward_kinematics(ik.model.robot, q), near=near)
    every = ik.all_branches(forward_kinematics(ik.model.robot, q))
    distance = (every.q - near).norm(dim=-1).nan_to_num(math.inf)
    assert int(solution.branch) == int(distance.argmin())
    assert_close((solution.q - near).norm(), distance.amin(), atol=1e-12)


@pytest.mark.parametrize("name", ROBOTS)
def test_near_broadcasts_and_may_be_a_list(name):
    ik = CorrectedIK(hand_made_model(name))
    T = poses_around(name, 3, 1, 2)
    home = list(HOMES[name])
    assert_close(ik(T, near=home).q, ik(T).q, atol=1e-10)
    rows = torch.tensor(home, dtype=torch.float64).expand(3, 1, 2, -1)
    assert_close(ik(T, near=rows).q, ik(T).q, atol=1e-10)


@pytest.mark.parametrize(
    ("near", "fields"),
    [
        ([0.0] * 5, {"expected": "6 columns", "value": (5,)}),
        (0.0, {"expected": "6 columns", "value": (1,)}),
        ([math.nan] * 6, {"expected": "finite joint values"}),
        ([0.0, -90.0, 90.0, 0.0, 90.0, 0.0], {"value": -90.0}),
        (torch.zeros(3, 6, dtype=torch.float64), {"value": (3,)}),
        (["left"] * 6, {"expected": "an array of real numbers with lengths in metres"}),
    ],
)
@pytest.mark.parametrize("name", ["kiro4", "ur10"])
@pytest.mark.usefixtures("without_type_checker")
def test_near_that_does_not_fit_is_refused(name, near, fields):
    with refused(PoseError, option="near", **fields):
        CorrectedIK(hand_made_model(name))(poses_around(name, 2), near=near)


def test_near_prefers_a_branch_inside_the_limits():
    robot = Robot.load("kiro3")
    T = poses_around("kiro3")
    positive = CorrectedIK(hand_made_model("kiro3")).all_branches(T).q[0]
    limited = with_limits(robot, 1, -2.7, 0.5)  # keeps elbow_negative only
    ik = CorrectedIK(replace(hand_made_model("kiro3"), robot=limited))
    chosen = ik(T, near=positive)
    assert ik.branches[int(chosen.branch)] == "elbow_negative"
    assert ik.branches[int(ik(T).branch)] == "elbow_negative"  # the trained one reaches it outside the limits
    assert statuses(ik(T)) == [Status.OUTSIDE_DOMAIN]
    assert statuses(ik(T, branch="elbow_positive")) == [Status.OUTSIDE_JOINT_LIMITS]


@pytest.mark.parametrize("name", ["ur5", "panda"])
def test_joints_without_limits_are_solved_near(name):
    """A continuous joint of a URDF file has infinite limits; the Kinova Gen3 has four of them."""
    robot = Robot.load(name)
    for joint in (0, 2):
        robot = with_limits(robot, joint, -math.inf, math.inf)
    model = calibrated_robot(robot, hybrid=False)
    q = joints_of(robot, 6, share=0.8)
    near = q + 0.01
    near[:, 0] += 6 * math.pi
    T = model.forward(q)
    for solve in (CorrectedIK(model), NumericIK(model).solve_batch):
        found = solve(T, near=near)
        assert float((found.q - near).abs().max()) < 0.2
        for solution in (found, solve(T)):
            assert set(statuses(solution)) <= {Status.REACHED, Status.OUTSIDE_DOMAIN}
            assert_close(model.forward(solution.q), T, atol=1e-9)


def test_redundant_joints_leave_their_limits_where_others_have_none():
    """Without `near` an arm with a joint without limits moves its other joints to the middle of their ranges."""
    robot = Robot.load("panda")
    model, open_model = (
        calibrated_robot(one, hybrid=False) for one in (robot, with_limits(robot, 0, -math.inf, math.inf))
    )
    T = model.forward(joints_of(robot, 20, share=0.9))
    lower, upper = torch.from_numpy(robot.limits[1:]).T

    def margin(ik):
        q = ik(T).q[:, 1:]
        return float((torch.minimum(q - lower, upper - q) / (upper - lower)).amin(1).mean())

    assert margin(CorrectedIK(open_model)) > 0.8 * margin(CorrectedIK(model))
