"""Direction of gravity, by the evidence for the axes of the base."""

import math
from collections.abc import Sequence

import torch

from pisigma.calibration.hybrid.design import Design, Rows
from pisigma.calibration.hybrid.regression import build_regression
from pisigma.calibration.hybrid.search import CLEARLY, ROUGHLY
from pisigma.joint_correction.feature import AbstractFeature
from pisigma.joint_correction.fourier_series import FourierSeries
from pisigma.joint_correction.gravity_torques import Direction, GravityTorques
from pisigma.robot.description import Robot
from pisigma.robot.se3 import rotation_from_rpy

USUAL: Direction = (0.0, 0.0, -1.0)
"""Gravity in the base frame of a robot on the floor."""
FLOOR_ODDS = 100.0
"""Prior odds of a robot on the floor against one that is mounted otherwise without a statement of the user."""
HARMONICS = 8
"""Harmonics of a series that is fitted too: low harmonics of a gear look like torques of gravity along other axes."""


def to_first_row_frame(robot: Robot, direction: Direction) -> Direction:
    """Transform a direction from the robot's base frame to the frame of its first row."""
    turned = rotation_from_rpy(torch.tensor(robot.base[3:])).mT @ torch.tensor(direction).double()
    x, y, z = (turned + 0.0).tolist()
    return x, y, z


def gravity_by_evidence(
    robot: Robot, rows: Rows, noise: tuple[float, ...], prior_scale: Sequence[float]
) -> Direction:
    """Find the axis of the base along which gravity acts, for robots on walls, rails and ceilings.

    Geometry, a short series and the `GravityTorques` of each axis are fitted to the rows. Torques are linear in masses
    of either sign, so the evidence and all predictions are the same for both directions of an axis; the direction is
    the one with a positive sum of masses. Directions other than down must have a log evidence above that of the other
    axes by `CLEARLY` plus the log prior odds against them.

    Args:
        robot: the nominal robot.
        rows: rows linearised at the geometric calibration.
        noise: noise of the geometric calibration per sensor.
        prior_scale: its prior scales.

    Returns:
        The direction in the robot's base frame.
    """
    tried = []
    for direction in (USUAL, (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)):
        torques = GravityTorques(robot, to_first_row_frame(robot, direction))
        design = Design(rows.problem, (torques, FourierSeries(robot, HARMONICS)))
        fit = build_regression(design, rows)
        posterior = fit.maximise_evidence(design.prior(prior_scale), noise, tolerance=ROUGHLY)
        weight = torch.zeros(torques.used.shape).to(posterior.x)
        masses = weight.masked_scatter(torques.used, posterior.x[design.weights_of(0)])[:, ::4]
        x, y, z = (value if masses.sum() > 0 else 0.0 - value for value in direction)
        tried.append((posterior.log_evidence, (x, y, z)))
    (second, _), (first, best) = sorted(tried)[1:]
    return best if first - second > CLEARLY + math.log(FLOOR_ODDS) else USUAL


def gravity_in_base(robot: Robot, features: Sequence[AbstractFeature]) -> Direction | None:
    """Return the direction of gravity in the base frame that the features assume; None if none depends on it."""
    directions = [chosen.gravity for chosen in features if isinstance(chosen, GravityTorques)]
    if not directions:
        return None
    turned = rotation_from_rpy(torch.tensor(robot.base[3:])) @ torch.tensor(directions[0]).double()
    x, y, z = turned.tolist()
    return x, y, z


def gravity_sentence(robot: Robot, features: Sequence[AbstractFeature]) -> str:
    """Write along which axis of the base gravity acts; empty if no feature depends on it."""
    direction = gravity_in_base(robot, features)
    if direction is None:
        return ""
    axis = max(range(3), key=lambda k: abs(direction[k]))
    along = f"{'-' if direction[axis] < 0 else '+'}{'xyz'[axis]}"
    if abs(direction[axis]) < 1 - 1e-9:
        along = "({:.3g}, {:.3g}, {:.3g})".format(*direction)
    return f"Gravity acts along {along} of the base."
