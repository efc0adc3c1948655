"""Robots on walls and rails: the direction of gravity by the evidence, or as stated."""

import math

import numpy as np
import pytest
import torch
from testing.hybrid import joints_in
from testing.models import no_type_checker
from testing.refusals import refused

from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.calibration.hybrid.gravity import gravity_in_base, to_first_row_frame
from pisigma.calibration.hybrid.result import HybridResult
from pisigma.files.errors import IdentificationError
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.simulation import TrueRobot
from pisigma.simulation.errors.geometric import RandomGeometricDeviation
from pisigma.simulation.errors.joint_compliance import JointCompliance, LinkMass

NOISE = 3e-5


def measured(robot: Robot, falling: tuple[float, float, float], rows: int, seed: int) -> Measurements:
    """Positions of a robot whose joints give way to a gravity along a direction in its first row's frame."""
    x, y, z = (9.81 * value for value in falling)
    geometry = RandomGeometricDeviation(
        kind="geometric_random", distribution="normal", seed=3, length_mm=0.3, angle_deg=0.03
    )
    compliance = JointCompliance(
        kind="joint_compliance",
        compliance_rad_per_Nm={joint.name: 4e-6 for joint in robot.joints[:4]},
        payload=LinkMass(mass_kg=10.0),
        gravity_m_per_s2=(x, y, z),
    )
    true = TrueRobot(robot, (geometry, compliance))
    q = joints_in(robot, rows, seed)
    noise = NOISE * torch.from_numpy(np.random.default_rng(seed).normal(size=(rows, 3)))
    return Measurements(q=q, position=true.forward(q)[:, :3, 3] + noise)


def fit(robot: Robot, rows: Measurements, gravity: tuple[float, float, float] | None = None) -> HybridResult:
    with no_type_checker():
        return HybridCalibrator(robot, products=False, harmonics=(4,), gravity=gravity).fit(rows)


def gravity_of(robot: Robot, result: HybridResult) -> tuple[float, float, float] | None:
    """Direction of gravity in the base frame that a correction assumes."""
    assert result.learned is not None
    return gravity_in_base(robot, result.learned.correction.features)


def rms(result: HybridResult, rows: Measurements) -> float:
    """Of the errors' lengths [m]."""
    return float(result.errors_of(rows)["position"].square().sum(1).mean().sqrt())


@pytest.mark.parametrize(
    ("falling", "turned", "direction"),
    [
        ((0.0, -1.0, 0.0), (0.0, 0.0, 0.0), (0.0, -1.0, 0.0)),
        ((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
        ((1.0, 0.0, 0.0), (0.0, math.pi / 2, 0.0), (0.0, 0.0, -1.0)),  # its file says that it hangs on a wall
    ],
)
def test_the_axis_of_gravity_is_found(falling, turned, direction):
    robot = Robot.load("ur5")
    robot = robot.with_geometry(base=np.array([*robot.base[:3], *turned]))
    result = fit(robot, measured(robot, falling, 100, seed=0))
    assert gravity_of(robot, result) == pytest.approx(direction, abs=1e-9)


def test_an_inclined_direction_is_found_within_five_degrees():
    robot, falling = Robot.load("ur5"), np.array([0.6, 0.4, -math.sqrt(0.48)])
    result = fit(robot, measured(robot, tuple(falling), 60, seed=0))
    found = gravity_of(robot, result)
    assert found is not None
    assert np.degrees(np.arccos(falling @ found)) < 5


def test_a_robot_on_a_wall_is_as_accurate_as_one_on_the_floor():
    robot = Robot.load("ur5")
    rows, others = (measured(robot, (1.0, 0.0, 0.0), 100, seed) for seed in (0, 1))
    wall, taken_for_floor, stated = (
        rms(fit(robot, rows, gravity), others) for gravity in (None, (0.0, 0.0, -1.0), (2.0, 0.0, 0.0))
    )
    floor = rms(
        fit(robot, measured(robot, (0.0, 0.0, -1.0), 100, 0)), measured(robot, (0.0, 0.0, -1.0), 100, 1)
    )
    assert wall < 1.1 * stated
    assert wall < 1.2 * floor
    assert taken_for_floor > 1.5 * wall


def test_a_stated_direction_is_turned_with_the_base():
    robot = Robot.load("ur5")
    turned = robot.with_geometry(base=np.array([0.0, 0.0, 0.0, math.pi / 2, 0.0, 0.0]))
    assert to_first_row_frame(turned, (0.0, 1.0, 0.0)) == pytest.approx((1.0, 0.0, 0.0))
    result = fit(robot, measured(robot, (0.0, 0.6, -0.8), 100, seed=0), (0.0, 0.6, -0.8))
    assert gravity_of(robot, result) == pytest.approx((0.0, 0.6, -0.8))
    with refused(IdentificationError, option="gravity"):
        HybridCalibrator(robot, gravity=(0.0, 0.0, 0.0))
