"""Noise of poses in images of arms whose joints repeat badly, such as arms of servos."""

from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import Float64

from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.corner import with_pose_noise
from pisigma.measurement.sensors.intrinsics import NOISE_COLUMN
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.jacobian import joint_jacobian


def with_joint_repeatability(
    rows: Measurements,
    robot: Robot,
    bases: Mapping[str, Float64[np.ndarray, " 6"]],
    tools: Mapping[str, Float64[np.ndarray, " 6"]],
    deviation: float,
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
        deviation: standard deviation of the value of every revolute joint [rad].
    """
    if not deviation or "corner" not in rows.kinds:
        return rows
    q, covariance = rows.q.cpu(), np.zeros((rows.rows, 6, 6))
    is_revolute = torch.tensor(robot.revolute)
    pairs = list(zip(rows.frame, rows.target, strict=True))
    for frame, target in dict.fromkeys(pairs):
        chosen = np.array([pair == (frame, target) for pair in pairs])
        there = robot.with_geometry(base=bases[frame], tool=tools[target])
        J = joint_jacobian(there, q[torch.from_numpy(chosen)])[1] * is_revolute
        covariance[chosen] = (deviation**2 * J @ J.mT).numpy()
    return with_pose_noise(rows, covariance)


def corner_factor(rows: Measurements, noise: float) -> float:
    """Return the factor on the standard deviations that images state, from the estimated noise of a corner [m].

    Deviations of joints relative to those that images state are multiplied by it.
    """
    return noise / float(torch.as_tensor(rows.readings[NOISE_COLUMN]).nanmean())
