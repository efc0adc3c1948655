"""Rotation vectors and pose differences on plain numbers; the formulas of `pisigma.robot.se3`."""

import math

from pisigma.robot.kernels.rows import Array, kernel


@kernel
def rotation_vector(R: Array) -> tuple[float, float, float]:
    """Return the rotation vector [rad] of the rotation in the first columns of `R`: axis times angle in [0, pi]."""
    x, y, z = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    cosine = (R[0, 0] + R[1, 1] + R[2, 2] - 1) / 2
    square = (x * x + y * y + z * z) / 4
    if cosine < -0.99:
        return _near_pi(R, x, y, z, cosine)
    sine = math.sqrt(square)
    factor = 0.5 + square / 12
    if square > 1e-8 or cosine < 0:
        factor = math.atan2(sine, cosine) / (2 * sine) if sine > 0 else 0.5
    return factor * x, factor * y, factor * z


@kernel
def _near_pi(R: Array, x: float, y: float, z: float, cosine: float) -> tuple[float, float, float]:
    """Compute the axis from the symmetric part, with columns `axis · axis_k (1 - cos)`; its sign from the other."""
    angle = math.atan2(math.sqrt(x * x + y * y + z * z) / 2, cosine)
    k = 0
    for i in range(1, 3):
        if R[i, i] > R[k, k]:
            k = i
    u, v, w = (R[0, k] + R[k, 0]) / 2, (R[1, k] + R[k, 1]) / 2, (R[2, k] + R[k, 2]) / 2
    u, v, w = (
        u - (cosine if k == 0 else 0.0),
        v - (cosine if k == 1 else 0.0),
        w - (cosine if k == 2 else 0.0),
    )
    scale = angle / math.sqrt(u * u + v * v + w * w)
    if u * x + v * y + w * z < 0:
        scale = -scale
    return scale * u, scale * v, scale * w


@kernel
def pose_error(wanted: Array, actual: Array, R: Array, error: Array) -> None:
    """Compute the displacement from the actual to the target pose in the base frame.

    Args:
        wanted: `(3 or 4, 4)`: target pose.
        actual: `(3, 4)`: actual pose.
        R: `(3, 3)`, overwritten.
        error: `(6,)`, output: translation [m] and rotation vector [rad].
    """
    for i in range(3):
        error[i] = wanted[i, 3] - actual[i, 3]
        for k in range(3):
            R[i, k] = wanted[i, 0] * actual[k, 0] + wanted[i, 1] * actual[k, 1] + wanted[i, 2] * actual[k, 2]
    error[3], error[4], error[5] = rotation_vector(R)


@kernel
def rotation_from_vector(x: float, y: float, z: float, R: Array) -> None:
    """Write the rotation `(3, 3)` of a rotation vector [rad] (Rodrigues)."""
    square = x * x + y * y + z * z
    # For small angles the series: its next terms are less than rounding, and the quotients would be 0 / 0.
    first, second = 1 - square / 6, 0.5 - square / 24
    if square >= 1e-8:
        angle = math.sqrt(square)
        first, second = math.sin(angle) / angle, (1 - math.cos(angle)) / square
    R[0, 0], R[0, 1], R[0, 2] = (
        1 - second * (y * y + z * z),
        second * x * y - first * z,
        second * x * z + first * y,
    )
    R[1, 0], R[1, 1], R[1, 2] = (
        second * x * y + first * z,
        1 - second * (x * x + z * z),
        second * y * z - first * x,
    )
    R[2, 0], R[2, 1], R[2, 2] = (
        second * x * z - first * y,
        second * y * z + first * x,
        1 - second * (x * x + y * y),
    )


@kernel
def wrap(angle: float) -> float:
    """Wrap an angle [rad] to (-pi, pi]; an angle in that range is returned unchanged."""
    if -math.pi < angle <= math.pi:
        return angle
    wrapped = angle - 2 * math.pi * math.floor((angle + math.pi) / (2 * math.pi))
    return math.pi if wrapped <= -math.pi else wrapped
