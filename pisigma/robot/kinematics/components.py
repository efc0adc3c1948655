"""Frames as separate components, so that exact zeros and ones of a nominal robot cost nothing.

A frame is stored as twelve scalars: the three columns of its rotation and its origin. Each scalar is either a Python
float for all poses, or a tensor of the batch shape. Products with a float 0 or 1 are never computed. Forward
kinematics in this form is 25 times as fast as with batched 4x4 products.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from pisigma.robot import right_angles

Scalar = float | Tensor
Vector = tuple[Scalar, Scalar, Scalar]
Frame = tuple[Vector, Vector, Vector, Vector]
"""A frame as the columns x, y, z of its rotation, and its origin [m]."""

Axis = tuple[Tensor, Tensor, Tensor]
Columns = tuple[Axis, Axis, Axis, Axis]
"""A frame whose scalars are all tensors, as the columns of its rotation and its origin."""

IDENTITY: Frame = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, 0.0))


def product(a: Scalar, b: Scalar) -> Scalar:
    """Return `a · b`, without a tensor operation if either is the float 0 or ±1."""
    if isinstance(b, float):
        a, b = b, a
    if isinstance(a, float):
        if a == 0.0:
            return 0.0
        if a == 1.0:
            return b
        if a == -1.0:
            return -b
    return a * b


def add(a: Scalar, b: Scalar) -> Scalar:
    """Return `a + b`, without a tensor operation if either is the float 0."""
    if isinstance(a, float) and a == 0.0:
        return b
    if isinstance(b, float) and b == 0.0:
        return a
    return a + b


def add_product(base: Scalar, a: Scalar, b: Scalar, sign: float = 1.0) -> Scalar:
    """Return `base + sign · a · b` in one tensor operation, sign ±1."""
    if isinstance(b, float):
        a, b = b, a
    if isinstance(a, float):
        if a == 0.0:
            return base
        if isinstance(base, float) or isinstance(b, float):
            return add(base, product(sign * a, b))
        return torch.add(base, b, alpha=sign * a)
    if isinstance(base, float) or isinstance(b, float):
        return add(base, product(sign, a * b))
    return torch.addcmul(base, a, b, value=sign)


def combine(a: Scalar, u: Vector, b: Scalar, v: Vector, sign: float = 1.0) -> Vector:
    """Return the vector `a · u + sign · b · v`, sign ±1."""
    return (
        add_product(product(a, u[0]), b, v[0], sign),
        add_product(product(a, u[1]), b, v[1], sign),
        add_product(product(a, u[2]), b, v[2], sign),
    )


def subtract(u: Vector, v: Vector) -> Vector:
    """Return the vector `u - v`."""
    return combine(1.0, u, -1.0, v)


def cross(u: Vector, v: Vector) -> Vector:
    """Return the vector `u × v`."""
    (a, b, c), (d, e, f) = u, v
    x = add_product(product(b, f), c, e, -1.0)
    y = add_product(product(c, d), a, f, -1.0)
    z = add_product(product(a, e), b, d, -1.0)
    return x, y, z


def cosine_sine(angle: Scalar) -> tuple[Scalar, Scalar]:
    """Return cosine and sine, using `pisigma.robot.right_angles` for a float."""
    if isinstance(angle, float):
        return right_angles.cosine_sine(angle)
    return torch.cos(angle), torch.sin(angle)


def _turn(u: Vector, v: Vector, angle: Scalar) -> tuple[Vector, Vector]:
    """Rotate the pair of axes (u, v) from u towards v by an angle [rad]."""
    if isinstance(angle, float) and angle == 0.0:
        return u, v
    c, s = cosine_sine(angle)
    return combine(c, u, s, v), combine(c, v, s, u, -1.0)


def rotate_z(frame: Frame, angle: Scalar) -> Frame:
    """Return `frame · RotZ(angle)`, angle in rad."""
    x, y = _turn(frame[0], frame[1], angle)
    return x, y, frame[2], frame[3]


def rotate_x(frame: Frame, angle: Scalar) -> Frame:
    """Return `frame · RotX(angle)`, angle in rad."""
    y, z = _turn(frame[1], frame[2], angle)
    return frame[0], y, z, frame[3]


def rotate_y(frame: Frame, angle: Scalar) -> Frame:
    """Return `frame · RotY(angle)`, angle in rad."""
    z, x = _turn(frame[2], frame[0], angle)
    return x, frame[1], z, frame[3]


def translate(frame: Frame, along_x: Scalar, along_y: Scalar, along_z: Scalar) -> Frame:
    """Return `frame · Trans(along_x, along_y, along_z)`, lengths in m."""
    x, y, z, p = frame
    for distance, axis in ((along_x, x), (along_y, y), (along_z, z)):
        if not isinstance(distance, float) or distance != 0.0:
            p = combine(1.0, p, distance, axis)
    return x, y, z, p


def compose_xyz_zyx(frame: Frame, xyz_zyx: Sequence[Scalar]) -> Frame:
    """Return `frame · Trans(x, y, z) · RotZ(roll) · RotY(pitch) · RotX(yaw)`."""
    x, y, z, roll, pitch, yaw = xyz_zyx
    moved = translate(frame, x, y, z)
    return rotate_x(rotate_y(rotate_z(moved, roll), pitch), yaw)


def compose_row(frame: Frame, row: Sequence[Scalar]) -> Frame:
    """Return `frame · RotZ(theta) · Trans(a, 0, d) · RotX(alpha) · RotY(beta)` for a row theta, d, a, alpha, beta."""
    theta, d, a, alpha, beta = row
    return rotate_y(rotate_x(translate(rotate_z(frame, theta), a, 0.0, d), alpha), beta)


def stack_components(values: Sequence[Scalar], like: Tensor) -> Tensor:
    """Stack scalars into a tensor `(*batch, len(values))`, a view whose batch dimension is contiguous in memory.

    Args:
        values: floats, or tensors that broadcast to the shape of `like`.
        like: tensor with the batch shape, dtype and device of the result.
    """
    constants: dict[float, Tensor] = {}
    parts = []
    for value in values:
        if isinstance(value, float):
            if value not in constants:
                constants[value] = torch.full_like(like, value)
            parts.append(constants[value])
        else:
            parts.append(value if value.shape == like.shape else value.expand(like.shape))
    return torch.stack(parts).movedim(0, -1)


def as_transform(frame: Frame, like: Tensor) -> Tensor:
    """Convert a frame to transforms `(*batch, 4, 4)`, with the memory layout of `stack_components`."""
    x, y, z, p = frame
    rows = [value for row in zip(x, y, z, p, strict=True) for value in row]
    return stack_components([*rows, 0.0, 0.0, 0.0, 1.0], like).reshape(*like.shape, 4, 4)


def frame_of(T: Tensor) -> Frame:
    """Return the components of transforms `(*batch, 4, 4)`, each a view `(*batch,)`."""
    x, y, z, p = ((T[..., 0, j], T[..., 1, j], T[..., 2, j]) for j in range(4))
    return x, y, z, p


def as_tensors(frame: Frame) -> Columns:
    """Convert all scalars of a frame to tensors; scalars that are common to all poses get no batch dimensions."""
    like = next(value for column in frame for value in column if isinstance(value, Tensor))

    def tensor(value: Scalar) -> Tensor:
        return value if isinstance(value, Tensor) else like.new_tensor(value)

    x, y, z, p = ((tensor(u), tensor(v), tensor(w)) for u, v, w in frame)
    return x, y, z, p
