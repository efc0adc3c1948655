"""Setup faults of measured poses: units, handedness, and conventions of orientations."""

import itertools
from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.measurement.csv.columns import MISNAMED_UNITS, RPY
from pisigma.validation.held_out.frames.frame_fits import MeasuredPoses
from pisigma.validation.setup_faults.cause import Cause

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

EULER_ORDERS = ("ZYX", "XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYZ", "ZXZ", "XYX", "XZX", "YXY", "YZY")
READ_ORDER = EULER_ORDERS[0]
"""Order of the turns roll, pitch and yaw in measurement files."""
_MIRROR = torch.diag(torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64))
_MIRRORED = "{} mirrored, as in a left-handed frame (an axis has the wrong sign, or two are swapped)"


def units_and_frames(
    measured: MeasuredPoses, predicted: Float64[Tensor, "rows 3"], by_images: bool
) -> Iterator[tuple[MeasuredPoses, Cause]]:
    """Go through positions in other units, mirrored positions and orientations, and inverse poses.

    Args:
        measured: the poses.
        predicted: positions, but for the frames [m].
        by_images: whether boards in images gave the poses: their scale is that of the board.
    """
    advice = "check the order and the directions of the sensor's axes"
    if by_images:
        factor = _spread(predicted) / _spread(measured.position)
        clause = f"the squares of the board are {factor:.4g} times as large as stated"
        cause = Cause("position_unit", clause, "measure them and correct the file of the board", 1.0)
        yield replace(measured, position=measured.position * factor), cause
        advice = "take the images as the sensor of the camera has them, not flipped"
    else:
        for factor, are, named in MISNAMED_UNITS:
            clause = f"x, y and z are {are} that are named {named}"
            yield (
                replace(measured, position=measured.position * factor),
                Cause("position_unit", clause, "correct the unit in the column names", 1.0),
            )
    positions = replace(measured, position=measured.position @ _MIRROR)
    what = "the measured positions are"
    if bool(measured.has_rotation.any()):
        rotations = replace(measured, rotation=_MIRROR @ measured.rotation @ _MIRROR)
        yield rotations, Cause("handedness", _MIRRORED.format("the measured orientations are"), advice, 1.0)
        both = replace(positions, rotation=rotations.rotation)
        yield both, Cause("handedness", _MIRRORED.format("the measured poses are"), advice, 1.0)
        turned_back = measured.rotation.mT
        place = -(turned_back @ measured.position[..., None])[..., 0]
        clause = "the measured poses are those of the sensor in the target's frame (inverse poses)"
        inverse = replace(measured, position=place, rotation=turned_back)
        forward = "write the target's pose in the sensor's frame; for a camera, check --fixed-camera"
        yield inverse, Cause("rotation", clause, forward, 1.0)
        what += ", other than the orientations,"
    yield positions, Cause("handedness", _MIRRORED.format(what), advice, 1.0)


def _spread(position: Float64[Tensor, "rows 3"]) -> float:
    """Root mean square distance from the mean [m]."""
    return float((position - position.mean(0)).square().sum(-1).mean().sqrt())


def other_conventions(
    rotation: Float64[Tensor, "rows 3 3"],
) -> Iterator[tuple[Float64[Tensor, "rows 3 3"], str, float]]:
    """Go through what measured orientations are where they were written in another convention.

    Returns:
        The rotations, what is wrong with those of the file, and how much that assumes, see `Cause.size`.
    """
    from scipy.spatial.transform import Rotation  # here, since every calibration imports this file

    read = Rotation.from_matrix(rotation.numpy())
    wxyz = Rotation.from_quat(np.roll(read.as_quat(), -1, 1))
    inverse = "the orientations are inverse (a conjugate quaternion, or a transposed matrix)"
    scalar = "the quaternions stand in the order qw, qx, qy, qz (the scalar part first)"
    yield from (
        (_matrices(read.inv()), inverse, 1.0),
        (_matrices(wxyz), scalar, 1.0),
        (_matrices(wxyz.inv()), f"{scalar} and are conjugate", 1.25),
    )
    angles = read.as_euler(READ_ORDER)
    for columns in (RPY, RPY[::-1]):
        of_columns = [RPY.index(name) for name in columns]
        turned, vector = angles[:, of_columns], _as_rotation_vector(angles)[:, of_columns]
        clause = f"{', '.join(columns)} hold the x, y and z of a rotation vector (axis times angle)"
        yield _matrices(Rotation.from_rotvec(vector)), clause, 1.0
        for order in EULER_ORDERS:
            product = " · ".join(f"Rot{axis}({name})" for axis, name in zip(order, columns, strict=True))
            clause = f"roll, pitch and yaw are angles of another order, the Euler angles of {product}"
            yield _matrices(Rotation.from_euler(order, turned)), clause, 1.0
            clause += " in radians that are named degrees"
            yield _matrices(Rotation.from_euler(order, np.rad2deg(turned))), clause, 1.0
    for signs in itertools.product((1, -1), repeat=3):
        names = ", ".join(("-" if sign < 0 else "") + name for sign, name in zip(signs, RPY, strict=True))
        clause = f"signs of angles are reversed: {names} were meant"
        yield _matrices(Rotation.from_euler(READ_ORDER, angles * signs)), clause, 1.5


def _as_rotation_vector(angles: Float64[np.ndarray, "rows 3"]) -> Float64[np.ndarray, "rows 3"]:
    """Of the two ways to write a rotation in roll, pitch and yaw, take the shorter one as a vector.

    A vector that was read as angles may have had a second component beyond a quarter turn, which is read otherwise.
    """
    roll, pitch, yaw = angles.T
    half = np.pi * np.stack([-np.sign(roll), np.sign(pitch), -np.sign(yaw)], 1)
    other = np.stack([roll, -pitch, yaw], 1) + half
    longer = np.linalg.norm(angles, axis=1) > np.linalg.norm(other, axis=1)
    return np.where(longer[:, None], other, angles)


def _matrices(rotation: "Rotation") -> Float64[Tensor, "rows 3 3"]:
    return torch.from_numpy(rotation.as_matrix())
