"""How far a correction is trusted beyond the measured joint values."""

import math
from dataclasses import replace

import pytest
import torch
from testing.closeness import assert_close
from testing.linearised import LinearisedArm, drawn_joints, linearised, tracker_data

from pisigma.hybrid.coverage import DENSE_FADE, FADES, fade_angle
from pisigma.hybrid.design import Design, sum_up
from pisigma.hybrid.evidence import Posterior, solve_posterior
from pisigma.joint_correction.fourier_series import FourierSeries
from pisigma.joint_correction.gravity_torques import GravityTorques
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.simulation import TrueRobot
from pisigma.simulation.errors.joint_compliance import JointCompliance, LinkMass


def sagging(seed: int, widest: float = 1.0) -> tuple[Robot, Measurements]:
    """A robot that gives way to its own weight, measured on a part of its joints' ranges."""
    robot = Robot.load("rb5")
    names = [joint.name for joint in robot.joints]
    compliance = JointCompliance(
        kind="joint_compliance",
        compliance_rad_per_Nm=dict(zip(names, (4e-6, 6e-6, 8e-6, 2e-5, 2e-5, 3e-5), strict=True)),
        links={names[1]: LinkMass(mass_kg=8, centre_mm=(-200, 0, 100)), names[2]: LinkMass(mass_kg=4)},
        payload=LinkMass(mass_kg=4, centre_mm=(0, 0, 80)),
    )
    q = drawn_joints(robot, 150, seed, widest=widest)
    T = TrueRobot(robot, (compliance,)).forward(q)
    noise = torch.randn(150, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return robot, Measurements(q=q, position=T[:, :3, 3] + 2e-5 * noise)


def wild(arm: LinearisedArm, harmonics: int, size: float) -> tuple[Design, Posterior, float]:
    """A series whose weights are hardly held, and the angle over which it is to fade."""
    design = Design(arm.rows.problem, (FourierSeries(arm.rows.problem.space.robot, harmonics),))
    sums = sum_up(design, arm.rows.values, arm.rows.start(design))
    prior = design.prior(arm.prior_scale)
    sizes = torch.where(torch.arange(len(prior.sizes)) < prior.classes, prior.sizes, size)
    posterior = solve_posterior(sums, replace(prior, sizes=sizes), arm.noise)
    return design, posterior, fade_angle(arm.rows, design, posterior, sums)


@pytest.mark.parametrize("seed", range(2))
def test_gravity_holds_as_far_as_the_outermost_rows_tell(seed: int) -> None:
    robot, data = sagging(seed)
    arm = linearised(robot, data)
    fitted = arm.fitted((GravityTorques(robot),))
    fade = fade_angle(arm.rows, fitted.design, fitted.posterior, fitted.sums)
    assert fade in FADES
    assert fade >= math.radians(20)


@pytest.mark.parametrize("seed", range(2))
def test_a_series_that_is_hardly_held_is_not_trusted_at_all(seed: int) -> None:
    robot = Robot.load("rb5")
    data = tracker_data(robot, drawn_joints(robot, 150, seed, widest=1.0), noise=2e-5)
    assert wild(linearised(robot, data), 24, 1e-2)[2] == FADES[0]


def test_a_tail_that_contradicts_the_rest_is_not_followed() -> None:
    """What the joints do within 40 degrees goes on the other way beyond."""
    robot = Robot.load("rb5")
    q = drawn_joints(robot, 300, 0, widest=1.0)
    delta = torch.where(q.abs() < 0.65, 1e-3 * torch.sin(6 * q), -1e-3 * torch.sin(6 * q))
    arm = linearised(robot, tracker_data(robot, q, delta, 2e-5))
    assert wild(arm, 6, 1e-3)[2] <= math.radians(5)
    goes_on = linearised(robot, tracker_data(robot, q, 1e-3 * torch.sin(6 * q), 2e-5))
    assert wild(goes_on, 6, 1e-3)[2] == DENSE_FADE


def test_joints_measured_all_around_say_nothing_of_what_is_beyond() -> None:
    robot, data = sagging(0, widest=2 * math.pi)
    arm = linearised(robot, data)
    fitted = arm.fitted((GravityTorques(robot),), 5)
    assert fade_angle(arm.rows, fitted.design, fitted.posterior, fitted.sums) == FADES[0]


def test_one_configuration_has_no_outermost_ones() -> None:
    robot, data = sagging(0)
    arm = linearised(robot, data)
    fitted = arm.fitted((), 2)
    first = torch.tensor([0])
    values = tuple(sensor.select(first) for sensor in arm.rows.values)
    configuration = torch.zeros(1, dtype=torch.int64)
    rows = replace(
        arm.rows, problem=arm.rows.problem.select(first), values=values, configuration=configuration
    )
    assert fade_angle(rows, fitted.design, fitted.posterior, fitted.sums) == FADES[0]


def test_the_search_leaves_the_sums_as_they_are() -> None:
    robot, data = sagging(1)
    arm = linearised(robot, data)
    fitted = arm.fitted((GravityTorques(robot),), 5)
    before = fitted.sums.normal.clone()
    first = fade_angle(arm.rows, fitted.design, fitted.posterior, fitted.sums)
    assert_close(fitted.sums.normal, before)
    assert fade_angle(arm.rows, fitted.design, fitted.posterior, fitted.sums) == first
