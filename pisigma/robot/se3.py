"""Rotations and rigid transforms, with leading batch dimensions.

Angles are in rad, lengths in m. `T_a_b` maps coordinates in b to coordinates in a.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pisigma.files.errors import PoseError


def rotation_from_zyx(zyx: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Return the rotation `RotZ(roll) · RotY(pitch) · RotX(yaw)`: roll is about z, pitch about y, yaw about x.

    Args:
        zyx: angles about z, y and x: roll, pitch and yaw [rad].
    """
    cos, sin = torch.cos(zyx), torch.sin(zyx)
    cz, cy, cx = cos.unbind(-1)
    sz, sy, sx = sin.unbind(-1)
    cz_sy, sz_sy = cz * sy, sz * sy
    first = (cz * cy, cz_sy * sx - sz * cx, cz_sy * cx + sz * sx)
    second = (sz * cy, sz_sy * sx + cz * cx, sz_sy * cx - cz * sx)
    entries = torch.stack([*first, *second, -sy, cy * sx, cy * cx], -1)
    return entries.view(*zyx.shape[:-1], 3, 3)


def zyx_from_rotation(R: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """Return roll, pitch, yaw [rad] of a rotation; at pitch = ±90 deg yaw is set to 0.

    Inverse of `rotation_from_zyx` for pitch within ±90 deg.
    """
    regular = R[..., 0, 0].square() + R[..., 1, 0].square() > 1e-24
    cosine, sine = _where_regular(regular, R[..., 0, 0], R[..., 1, 0])
    horizontal = torch.where(regular, torch.hypot(cosine, sine), torch.zeros_like(sine))
    pitch = torch.atan2(-R[..., 2, 0], horizontal)
    upright, leaning = _where_regular(~regular, R[..., 1, 1], -R[..., 0, 1])
    roll = torch.where(regular, torch.atan2(sine, cosine), torch.atan2(leaning, upright))
    cosine, sine = _where_regular(regular, R[..., 2, 2], R[..., 2, 1])
    yaw = torch.where(regular, torch.atan2(sine, cosine), torch.zeros_like(roll))
    return torch.stack([roll, pitch, yaw], -1)


def _where_regular(
    regular: Bool[Tensor, "*batch"], cosine: Float[Tensor, "*batch"], sine: Float[Tensor, "*batch"]
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Return cosine and sine where regular, otherwise 1 and 0, so that the gradient of the angle is finite."""
    return torch.where(regular, cosine, torch.ones_like(cosine)), torch.where(
        regular, sine, torch.zeros_like(sine)
    )


def rotation_from_quaternion(quaternion: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Return the rotation of a quaternion (x, y, z, w), which is normalised first."""
    x, y, z, w = (quaternion / quaternion.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)], -1),
        torch.stack([2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)], -1),
        torch.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], -1),
    ]
    return torch.stack(rows, -2)


def quaternion_from_rotation(R: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Return the quaternion (x, y, z, w) of a rotation, w >= 0; inverse of `rotation_from_quaternion`.

    The outer product 4·q·q^T is linear in R (Shepperd 1978, J. Guidance and Control 1(3)). Its row with the
    largest diagonal entry is q up to length and sign, without cancellation for any angle.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = (row.unbind(-1) for row in R.unbind(-2))
    rows = [
        torch.stack([1 + xx - yy - zz, xy + yx, xz + zx, zy - yz], -1),
        torch.stack([xy + yx, 1 - xx + yy - zz, yz + zy, xz - zx], -1),
        torch.stack([xz + zx, yz + zy, 1 - xx - yy + zz, yx - xy], -1),
        torch.stack([zy - yz, xz - zx, yx - xy, 1 + xx + yy + zz], -1),
    ]
    outer = torch.stack(rows, -2)
    largest = outer.diagonal(dim1=-2, dim2=-1).argmax(-1)
    q = torch.take_along_dim(outer, largest[..., None, None], -2)[..., 0, :]
    sign = torch.where(q[..., 3:] < 0, -1.0, 1.0).to(q)
    length = (q * q).sum(-1, keepdim=True).sqrt()
    return sign * q / length


def rotation_from_vector(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Return the rotation of a rotation vector [rad] (Rodrigues), with finite gradients at zero."""
    square = (vector * vector).sum(-1)
    # Below this limit the next terms of the series are less than rounding; a safe square keeps gradients finite.
    small = square < 1e-8
    safe = torch.where(small, torch.ones_like(square), square)
    angle = safe.sqrt()
    first = torch.where(small, 1 - square / 6, torch.sin(angle) / angle)
    second = torch.where(small, 0.5 - square / 24, (1 - torch.cos(angle)) / safe)
    K = skew(vector)
    eye = torch.eye(3, dtype=vector.dtype, device=vector.device)
    return eye + first[..., None, None] * K + second[..., None, None] * (K @ K)


def rotation_vector(R: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """Return the rotation vector [rad] of a rotation: axis times angle in [0, pi].

    Near the identity, the factor of the vector part of `R - R^T` is a series; near pi, the axis is computed from `R +
    R^T`. Gradients are finite everywhere.
    """
    twice_sine_axis = torch.stack(
        [R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], -1
    )
    cosine = (R[..., 0, 0] + R[..., 1, 1] + R[..., 2, 2] - 1) / 2
    sine_square = (twice_sine_axis * twice_sine_axis).sum(-1) / 4
    positive = sine_square > 0
    sine = torch.where(positive, sine_square, torch.ones_like(sine_square)).sqrt()
    angle = torch.atan2(torch.where(positive, sine, torch.zeros_like(sine)), cosine)
    # asin(s) / (2 s) = 1/2 + s² / 12 + ..., where the quotient would be 0 / 0.
    factor = torch.where(sine_square > 1e-8, angle / (2 * sine), 0.5 + sine_square / 12)
    ordinary = factor[..., None] * twice_sine_axis
    near_pi = (cosine < -0.99)[..., None]
    return torch.where(near_pi, _rotation_vector_near_pi(R, twice_sine_axis, angle), ordinary)


def _rotation_vector_near_pi(
    R: Float[Tensor, "*batch 3 3"], twice_sine_axis: Float[Tensor, "*batch 3"], angle: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch 3"]:
    """Compute the axis from the largest column of the symmetric part, `axis · axis_k (1 - cos)`; sign from R - R^T."""
    symmetric = (R + R.mT) / 2 + torch.eye(3, dtype=R.dtype, device=R.device)
    trace = R[..., 0, 0] + R[..., 1, 1] + R[..., 2, 2]
    # (R + R^T)/2 = cos·I + (1 - cos)·n n^T, so the sum above minus (1 + cos)·I is (1 - cos)·n n^T.
    cosine = (trace - 1) / 2
    outer = symmetric - (1 + cosine)[..., None, None] * torch.eye(3, dtype=R.dtype, device=R.device)
    largest = outer.diagonal(dim1=-2, dim2=-1).argmax(-1)
    column = torch.take_along_dim(outer, largest[..., None, None], -1)[..., 0]
    column = torch.where((column * column).sum(-1, keepdim=True) > 0, column, torch.ones_like(column))
    axis: Tensor = column / torch.linalg.vector_norm(column, dim=-1, keepdim=True)
    sign = torch.where((axis * twice_sine_axis).sum(-1) < 0, -1.0, 1.0).to(R.dtype)
    return (sign * angle)[..., None] * axis


def skew(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Return the matrix of the cross product with a vector: `skew(a) @ b = a × b`."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    entries = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1)
    return entries.view(*vector.shape[:-1], 3, 3)


def transform(
    rotation: Float[Tensor, "*batch 3 3"], translation: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 4 4"]:
    """Return the homogeneous transform of a rotation and a translation [m]; both broadcast."""
    batch = rotation.shape[:-2]
    if batch != translation.shape[:-1]:
        batch = torch.Size(np.broadcast_shapes(batch, translation.shape[:-1]))
    upper = torch.cat([rotation.expand(*batch, 3, 3), translation.expand(*batch, 3)[..., None]], -1)
    last_row = torch.eye(4, dtype=upper.dtype, device=upper.device)[3:].expand(*batch, 1, 4)
    return torch.cat([upper, last_row], -2)


def transform_from_xyz_zyx(xyz_zyx: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 4 4"]:
    """Return `Trans(x, y, z) · RotZ(roll) · RotY(pitch) · RotX(yaw)`; x, y, z [m], roll, pitch, yaw [rad]."""
    return transform(rotation_from_zyx(xyz_zyx[..., 3:]), xyz_zyx[..., :3])


def xyz_zyx_from_transform(T: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 6"]:
    """Return x, y, z [m] and roll, pitch, yaw [rad] of a transform; inverse of `transform_from_xyz_zyx`."""
    return torch.cat([T[..., :3, 3], zyx_from_rotation(T[..., :3, :3])], -1)


def invert(T: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
    """Return the inverse of rigid transforms, by transposition of the rotation."""
    R_inverse = T[..., :3, :3].mT
    return transform(R_inverse, -(R_inverse @ T[..., :3, 3:])[..., 0])


def pose_error(
    T_a_target: Float[Tensor, "*batch 4 4"], T_a_actual: Float[Tensor, "*batch 4 4"]
) -> Float[Tensor, "*batch 6"]:
    """Return the displacement in frame a that moves the actual pose onto the target pose.

    Returns:
        Translation target - actual [m] and the rotation vector of `R_target · R_actual^T` [rad].
    """
    translation = T_a_target[..., :3, 3] - T_a_actual[..., :3, 3]
    rotation = T_a_target[..., :3, :3] @ T_a_actual[..., :3, :3].mT
    return torch.cat([translation, rotation_vector(rotation)], -1)


def wrap_to_pi(angle: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Wrap an angle [rad] to (-pi, pi]; an angle in that range is returned unchanged."""
    wrapped = torch.remainder(angle + torch.pi, 2 * torch.pi) - torch.pi
    wrapped = torch.where(wrapped <= -torch.pi, torch.full_like(wrapped, torch.pi), wrapped)
    return torch.where((angle > -torch.pi) & (angle <= torch.pi), angle, wrapped)


def check_transforms(T: Tensor, name: str, tolerance: float = 1e-6) -> None:
    """Check that matrices are rigid transforms.

    Args:
        T: the matrices, a float tensor `(*batch, 4, 4)`.
        name: name of the matrices in messages.
        tolerance: largest deviation of `R^T R` from the identity and of the last row from (0, 0, 0, 1).

    Raises:
        PoseError: the shape or dtype is wrong, an entry is not finite, a rotation is not orthonormal or is left-handed,
            or the last row is wrong; the message and `value` state the index of the first such matrix.
    """
    if T.ndim < 2 or T.shape[-2:] != (4, 4):
        shape = tuple(T.shape)
        expected = "homogeneous transforms of shape (*batch, 4, 4)"
        raise PoseError(expected=expected, value=shape, option=name)
    if not T.is_floating_point():
        expected = "float64 or float32 values with lengths in metres"
        raise PoseError(f"expected {expected}, got {T.dtype}", expected=expected, value=T.dtype, option=name)
    for bad, expected, remedy in transform_faults(T, tolerance):
        if bad.any():
            index = tuple(bad.nonzero()[0].tolist())
            place = f" at index {index if len(index) > 1 else index[0]}" if index else ""
            problem = f"expected {expected}{place}"
            raise PoseError(problem, expected=expected, value=index, option=name, remedy=remedy)


def transform_faults(
    T: Float[Tensor, "*batch 4 4"], tolerance: float
) -> tuple[tuple[Bool[Tensor, "*batch"], str, str], ...]:
    """Return the matrices with every possible fault of a rigid transform, and texts for an error.

    Args:
        T: the matrices.
        tolerance: see `check_transforms`.

    Returns:
        For every fault, the mask of the matrices that have it, a text that states what was expected, and a remedy.
    """
    eye = torch.eye(4, dtype=T.dtype, device=T.device)
    finite = torch.isfinite(T).all(-1).all(-1)
    R = torch.where(finite[..., None, None], T, eye)[..., :3, :3]
    skewness = (R.mT @ R - eye[:3, :3]).abs().amax((-1, -2))
    last_row = (T[..., 3, :] - eye[3]).abs().amax(-1)
    return (
        (~finite, "finite entries", "check the source of the pose"),
        (last_row > tolerance, "the last row 0 0 0 1", "give a homogeneous transform"),
        (skewness > tolerance, "an orthonormal rotation part", "normalise it or check its source"),
        (
            torch.linalg.det(R) < 0,
            "a right-handed rotation part (determinant +1)",
            "check the direction of its axes",
        ),
    )


def nearest_rotation(M: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Return the rotation nearest to a matrix in the Frobenius norm (orthogonal Procrustes, Kabsch's sign).

    It is computed on the CPU, because there are few matrices and every operation on another device takes longer.
    """
    U, _, Vh = np.linalg.svd(M.cpu().numpy())
    U[..., 2] *= np.sign(np.linalg.det(U @ Vh))[..., None]
    return torch.from_numpy(U @ Vh).to(M)
