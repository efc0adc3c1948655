"""In which direction things fall: as stated, or along an axis of the base by the evidence."""

import math
from collections.abc import Sequence

import torch

from pisigma.calibration.hybrid.design import Design, Rows
from pisigma.calibration.hybrid.regression import regression
from pisigma.calibration.hybrid.search import CLEARLY, ROUGHLY
from pisigma.joint_correction.feature import AbstractFeature
from pisigma.joint_correction.fourier_series import FourierSeries
from pisigma.joint_correction.gravity_torques import Direction, GravityTorques
from pisigma.robot.description import Robot
from pisigma.robot.se3 import rotation_from_rpy

USUAL: Direction = (0.0, 0.0, -1.0)
"""In the base: of a robot that stands on the floor."""
FLOOR_ODDS = 100.0
"""So many robots stand on the floor for one that hangs elsewhere and whose user does not say so."""
HARMONICS = 8
"""Of a series beside the torques: low harmonics of a joint's gear look like torques of a gravity along other axes."""


def in_first_row(robot: Robot, direction: Direction) -> Direction:
    """A direction in the robot's base frame, in the frame of its first row."""
    turned = rotation_from_rpy(torch.tensor(robot.base[3:])).mT @ torch.tensor(direction).double()
    x, y, z = (turned + 0.0).tolist()
    return x, y, z


def gravity_by_evidence(
    robot: Robot, rows: Rows, noise: tuple[float, ...], prior_scale: Sequence[float]
) -> Direction:
    """Find the axis of the base that gravity acts along, for robots on walls, rails and ceilings.

    Geometry, a short series and the `GravityTorques` of each axis are fitted to the rows. Torques are linear in masses
    of either sign, so the evidence and all predictions are the same for both ends of an axis; the end is the one for
    which the masses add up to more than 0. Another direction than down has to raise the log evidence above that of the
    other axes by `CLEARLY`, and by the odds against it before anything was measured.

    Args:
        robot: the nominal one.
        rows: linearised at the geometric calibration.
        noise: of that, per sensor.
        prior_scale: its prior sizes.

    Returns:
        The direction in the robot's base frame.
    """
    tried = []
    for direction in (USUAL, (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)):
        torques = GravityTorques(robot, in_first_row(robot, direction))
        design = Design(rows.problem, (torques, FourierSeries(robot, HARMONICS)))
        fit = regression(design, rows)
        posterior = fit.maximise_evidence(design.prior(prior_scale), noise, tolerance=ROUGHLY)
        weight = torch.zeros(torques.used.shape).to(posterior.x)
        masses = weight.masked_scatter(torques.used, posterior.x[design.stretch(0)])[:, ::4]
        x, y, z = (value if masses.sum() > 0 else 0.0 - value for value in direction)
        tried.append((posterior.log_evidence, (x, y, z)))
    (second, _), (first, best) = sorted(tried)[1:]
    return best if first - second > CLEARLY + math.log(FLOOR_ODDS) else USUAL


def gravity_sentence(robot: Robot, features: Sequence[AbstractFeature]) -> str:
    """Say along which axis of the base gravity acts, if any of the features depends on it."""
    directions = [chosen.gravity for chosen in features if isinstance(chosen, GravityTorques)]
    if not directions:
        return ""
    turned = rotation_from_rpy(torch.tensor(robot.base[3:])) @ torch.tensor(directions[0]).double()
    axis = int(turned.abs().argmax())
    along = f"{'-' if turned[axis] < 0 else '+'}{'xyz'[axis]}"
    if float(turned[axis].abs()) < 1 - 1e-9:
        along = "({:.3g}, {:.3g}, {:.3g})".format(*turned.tolist())
    return f"Gravity acts along {along} of the base."
