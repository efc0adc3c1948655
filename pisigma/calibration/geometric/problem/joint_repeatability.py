"""Repeatability of imprecise joints, such as servos: the noise of poses in images, and its estimate."""

from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.geometric.problem.least_squares import Linearisation, covariance_of
from pisigma.calibration.geometric.problem.noise import contributions_and_noise_of
from pisigma.calibration.geometric.problem.problem import CalibrationProblem
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.corner import CornerSensor, with_pose_noise
from pisigma.measurement.sensors.intrinsics import NOISE_COLUMN
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.jacobian import joint_jacobian


def with_joint_repeatability(
    rows: Measurements,
    robot: Robot,
    bases: Mapping[str, Float64[np.ndarray, " 6"]],
    tools: Mapping[str, Float64[np.ndarray, " 6"]],
    sigma: float,
) -> Measurements:
    """Return rows of images whose covariances include the repeatability of the joints.

    Errors of the joint values move the pose by `J dq`, so they add `deviation² J J^T` to the covariance of an image.
    The directions of these errors matter more than their size, because a calibration estimates a common factor on all
    covariances of images.

    Args:
        rows: the rows; those of other sensors are not changed.
        robot: robot with the geometric Jacobian J.
        bases: base in every frame of the rows: x, y, z [m], roll, pitch, yaw [rad].
        tools: tool of every target of the rows, in the same form.
        sigma: standard deviation of the value of every revolute joint [rad].
    """
    if not sigma or "corner" not in rows.kinds:
        return rows
    q, covariance = rows.q.cpu(), np.zeros((rows.rows, 6, 6))
    is_revolute = torch.tensor(robot.revolute)
    pairs = list(zip(rows.frame, rows.target, strict=True))
    for frame, target in dict.fromkeys(pairs):
        chosen = np.array([pair == (frame, target) for pair in pairs])
        there = robot.with_geometry(base=bases[frame], tool=tools[target])
        J = joint_jacobian(there, q[torch.from_numpy(chosen)])[1] * is_revolute
        covariance[chosen] = (sigma**2 * J @ J.mT).numpy()
    return with_pose_noise(rows, covariance)


def corner_sigma_factor(rows: Measurements, noise: float) -> float:
    """Return the factor on the standard deviations that images state, from the estimated noise of a corner [m].

    Deviations of joints relative to those that images state are multiplied by it.
    """
    return noise / float(torch.as_tensor(rows.readings[NOISE_COLUMN]).nanmean())


_MIN_VALUES = 20.0
"""Smallest number of values, without those that parameters absorb, from which either variance is estimated."""
_ITERATIONS = 100
_TOLERANCE = 1e-4
"""Relative change of a variance at convergence."""


@torch.no_grad()
def joint_scatter_factor(
    problem: CalibrationProblem, linearisation: Linearisation[Tensor], corners: CornerSensor
) -> float:
    """Estimate the factor on the repeatability of the joints, relative to the noise of the corners.

    The covariance of an image is `a C + b K`, with C that of its corners, and K that of its joints. Errors that all
    corners of an image share, such as those of a rolling shutter, are in all directions; errors of the joints are only
    in those in which the joints move the board, but are much larger. With one common factor, errors of the first kind
    would therefore make the joints seem to scatter more than they do. Both factors are estimated by restricted maximum
    likelihood (Patterson and Thompson 1971), in the directions of every image in which C and K are diagonal, by the
    iteration of Zhou et al. 2019 (Journal of Computational and Graphical Statistics 28(2), 350-361).

    Args:
        problem: the problem, with images weighted by corners and joints.
        linearisation: the problem linearised at its solution.
        corners: the images weighted by their corners only.

    Returns:
        `sqrt(b / a)`; 1 if the rows are too few to distinguish both.
    """
    number = next(k for k, sensor in enumerate(problem.sensors) if isinstance(sensor, CornerSensor))
    sensor, view = problem.sensors[number], contributions_and_noise_of(linearisation)
    assert isinstance(sensor, CornerSensor)
    part, scale = view.contributions[number], view.noise[number]
    rows = sensor.present.nonzero()[:, 0]
    W, W_corners = (one.weight[..., rows].permute(2, 0, 1) for one in (sensor, corners))
    root = torch.linalg.solve(W_corners.mT, W.mT).mT
    share, axes = torch.linalg.eigh(root @ root.mT)
    share = share.clamp(0.0, 1.0)
    square = (axes.mT @ part.residual[:, rows].t()[..., None])[..., 0].square() / scale.square()
    absorbed = _absorbed(problem, linearisation, number, rows, axes) / scale.square()
    weight = problem.loss.weight(part.residual_length[rows] / scale, sensor.components)[:, None]
    left = weight * (1 - absorbed).clamp(min=0.0)
    shares = torch.stack([share, 1 - share])
    if bool(((shares.square() * left).sum((1, 2)) < _MIN_VALUES).any()):
        return 1.0
    factors = torch.ones(2, dtype=square.dtype)
    for _ in range(_ITERATIONS):
        part_of = shares * factors[:, None, None]
        variance = part_of.sum(0)
        part_of = part_of / variance
        step = ((part_of * weight * square / variance).sum((1, 2)) / (part_of * left).sum((1, 2))).sqrt()
        factors = factors * step
        if bool((step - 1).abs().max() < _TOLERANCE):
            break
    return float((factors[1] / factors[0]).sqrt())


def _absorbed(
    problem: CalibrationProblem,
    linearisation: Linearisation[Tensor],
    number: int,
    rows: Tensor,
    axes: Float64[Tensor, "images 6 6"],
) -> Float64[Tensor, "images 6"]:
    """Compute the variances of the predicted values in given directions [m²]."""
    every = slice(0, problem.rows)
    motion = problem.motion(linearisation.point, every, problem.active)
    unknowns = problem.space.sensor_unknowns(linearisation.point)
    J = problem.prediction_derivative(problem.sensors[number], motion, unknowns, every, problem.active)[
        ..., rows
    ]
    along = torch.einsum("pin,nik->nkp", J, axes)
    variances: Tensor = torch.einsum("nkp,pq,nkq->nk", along, covariance_of(linearisation.normal), along)
    return variances
