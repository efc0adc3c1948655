"""Rigid transforms of single frames as NumPy matrices, and their exact conversion to and from six numbers.

Lengths are in m, angles in rad. Multiples of 90 deg are exact in both directions, so that a robot with right angles
keeps these exactly.
"""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from pisigma.robot.right_angles import ROUNDING, cosine_sine, snap_right_angle

Frame = Float64[np.ndarray, "4 4"]


def rotation(axis: int, angle: float) -> Frame:
    """Return the rotation by an angle [rad] about the x (0), y (1) or z (2) axis."""
    cosine, sine = cosine_sine(angle)
    T = np.eye(4)
    first, second = (axis + 1) % 3, (axis + 2) % 3
    T[first, first] = T[second, second] = cosine
    T[second, first], T[first, second] = sine, -sine
    return T


def translation(x: float, y: float, z: float) -> Frame:
    """Return a translation [m]."""
    T = np.eye(4)
    T[:3, 3] = x, y, z
    return T


def row_frame(theta: float, d: float, a: float, alpha: float, beta: float) -> Frame:
    """Return `RotZ(theta) · Trans(a, 0, d) · RotX(alpha) · RotY(beta)`."""
    T: Frame = rotation(2, theta) @ translation(a, 0.0, d) @ rotation(0, alpha) @ rotation(1, beta)
    return T


def frame_of(xyz_zyx: Sequence[float] | Float64[np.ndarray, " 6"]) -> Frame:
    """Return the transform `Trans(x, y, z) · RotZ(roll) · RotY(pitch) · RotX(yaw)` of a base or tool."""
    x, y, z, roll, pitch, yaw = (float(value) for value in xyz_zyx)
    T: Frame = translation(x, y, z) @ rotation(2, roll) @ rotation(1, pitch) @ rotation(0, yaw)
    return T


def xyz_zyx_of(T: Frame) -> Float64[np.ndarray, " 6"]:
    """Return x, y, z [m], roll, pitch, yaw [rad] of a transform, the inverse of `frame_of`; pitch is within ±90 deg.

    Near a pitch of ±90 deg only the sum or difference of roll and yaw is determined, so yaw is computed from the
    rotation without roll.
    """
    R = T[:3, :3]
    lying = math.hypot(R[0, 0], R[1, 0]) > ROUNDING
    roll = math.atan2(R[1, 0], R[0, 0]) if lying else 0.0
    left = rotation(2, -roll)[:3, :3] @ R
    pitch = math.atan2(-left[2, 0], left[0, 0])
    yaw = math.atan2(-left[1, 2], left[1, 1])
    return np.array(
        [*(zero_if_rounding(v) for v in T[:3, 3]), *(snap_right_angle(v) for v in (roll, pitch, yaw))]
    )


def inverse(T: Frame) -> Frame:
    """Return the inverse of a rigid transform."""
    result = np.eye(4)
    result[:3, :3] = T[:3, :3].T
    result[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return result


def zero_if_rounding(value: float) -> float:
    """Return a length [m], or 0 if it is a rounding error."""
    return 0.0 if abs(value) <= ROUNDING else float(value)
