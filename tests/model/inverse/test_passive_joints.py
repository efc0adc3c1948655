"""Arms with passive joints: poses of a palletiser are solved in the values of its four axes."""

import numpy as np
import pytest
from testing.closeness import assert_close
from testing.coupled import PALLETISER, coupled_robot

import pisigma
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.inverse.corrected_ik import CorrectedIK
from pisigma.robot import Robot
from pisigma.robot.kinematics.status import Status
from pisigma.simulation.poses import JointsRandom


@pytest.fixture(scope="module")
def robot() -> Robot:
    return coupled_robot(PALLETISER)


@pytest.fixture(scope="module")
def ik(robot: Robot) -> CorrectedIK:
    """Corrected inverse kinematics of a robot with geometric errors, including a tilt of the flange."""
    errors = np.random.default_rng(0).normal(0, 3e-4, robot.dh.shape)
    starts = JointsRandom(kind="joints_random", count=100, seed=1).joints(robot)
    identified = robot.with_geometry(dh=robot.dh + errors)
    return CorrectedIK(CalibratedModel("palletiser", "made up", robot, None, None, (), starts, identified))


@pytest.fixture(scope="module")
def q(robot: Robot) -> np.ndarray:
    drawn = JointsRandom(kind="joints_random", count=50, seed=2).joints(robot)
    return robot.to_controller(drawn).numpy()


def test_poses_of_the_arm_are_reached_within_its_limits(ik, robot, q):
    T = ik.forward(q)
    assert_close(ik(T, near=q).q, q, atol=1e-9)
    free = ik(T)
    assert (free.status != Status.UNREACHABLE).all()
    assert (free.status == Status.REACHED).mean() > 0.9
    assert_close(ik.forward(free.q), T, atol=1e-9)
    inside = robot.coupling.is_within_limits(robot.to_dh(free.q))
    assert ((free.status == Status.OUTSIDE_JOINT_LIMITS) == ~inside).all()
    assert np.shape(ik.all_branches(T[:2]).q) == (2, 1, 4)


def test_of_a_level_flange_position_and_yaw_are_reached(ik, robot, q):
    T = pisigma.forward_kinematics(robot, q)
    solution = ik(T, near=q)
    assert_close(solution.position_residual, np.zeros(len(q)), atol=1e-11)
    assert 1e-6 < solution.rotation_residual.max() < 5e-3  # the tilt, which four axes cannot choose
    assert_close(solution.q_nominal, q, atol=1e-9)


def test_rotations_that_no_axis_can_control_are_residuals(ik, robot, q):
    T = pisigma.forward_kinematics(robot, q[:2])
    T[:, :3, 3] *= 5
    solution = ik(T)
    assert (solution.status == Status.UNREACHABLE).all()
    assert np.isnan(solution.q).all()


def test_poses_with_a_large_tilt_are_not_reached(ik, robot, q):
    T = pisigma.forward_kinematics(robot, q[:3])
    c, s = np.cos(0.5), np.sin(0.5)
    T[:, :3, :3] = T[:, :3, :3] @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    assert (ik(T).status == Status.UNREACHABLE).all()
