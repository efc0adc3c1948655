"""Noise of poses in images of arms whose joints repeat badly, such as arms of servos."""

import numpy as np
import torch

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.corner import with_pose_noise
from pisigma.robot.kinematics.jacobian import joint_jacobian


def with_joint_repeatability(
    rows: Measurements, calibrator: GeometricCalibrator, deviation: float
) -> Measurements:
    """Return rows of images whose covariances include the repeatability of the joints.

    Errors of the joint values move the pose by `J dq`, so they add `deviation² J J^T` to the covariance of an image.
    J is the geometric Jacobian of a first calibration with the given rows. The directions of these errors matter more
    than their size, because a calibration estimates a common factor on all covariances of images.

    Args:
        rows: the rows; those of other sensors are not changed.
        calibrator: calibrator of the first calibration.
        deviation: standard deviation of the value of every revolute joint [rad].

    Raises:
        IdentificationError: the rows do not determine the parameters.
    """
    if not deviation or "corner" not in rows.kinds:
        return rows
    first, covariance = calibrator.fit(rows), np.zeros((rows.rows, 6, 6))
    is_revolute = torch.tensor([first.robot.rows[row].type == "revolute" for row in first.robot.joint_rows])
    pairs = list(zip(rows.frame, rows.target, strict=True))
    for frame, target in dict.fromkeys(pairs):
        chosen = np.array([pair == (frame, target) for pair in pairs])
        robot = first.robot.with_geometry(base=first.bases[frame], tool=first.tools[target])
        J = joint_jacobian(robot, rows.q[torch.from_numpy(chosen)])[1] * is_revolute
        covariance[chosen] = (deviation**2 * J @ J.mT).numpy()
    return with_pose_noise(rows, covariance)
