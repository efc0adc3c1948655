"""Encodings of rotations, named after the manufacturers that use them."""

from collections.abc import Callable, Collection
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from pisigma.robot.se3 import rotation_from_quaternion, rotation_from_vector

Unit = str
_Values = Float64[Tensor, "rows values"]
_Rotations = Float64[Tensor, "rows 3 3"]

ORTHONORMALITY_TOLERANCE = 1e-3
"""Largest deviation of `R^T R` of a matrix from the identity, and of the squared norm of a quaternion from 1."""


@dataclass(frozen=True)
class RotationEncoding:
    """A manufacturer's encoding of rotations R_frame_tool.

    Attributes:
        name: name for `--rotation` and for columns in mappings, such as "kuka_a_deg".
        meaning: description for messages.
        values: names of the values, in the order of files without a header.
        to_rotation: function that converts values (angles [rad] or numbers) to rotations.
        columns: columns of measurement files with the same meaning, in the order of the values; () if there are none
            and the rotation is written as a quaternion.
        is_angles: whether the values are angles, which have a unit.
        aliases: other names of all values, each in the order of `values`.
    """

    name: str
    meaning: str
    values: tuple[str, ...]
    to_rotation: Callable[[_Values], _Rotations]
    columns: tuple[str, ...] = ()
    is_angles: bool = True
    aliases: tuple[tuple[str, ...], ...] = ()

    def quantities(self) -> tuple[str, ...]:
        """Return the names of the values in mappings."""
        return tuple(f"{self.name}_{value}" for value in self.values)

    def is_rotation(self, values: _Values) -> Bool[Tensor, " rows"]:
        """Return the mask of the rows whose values are a rotation."""
        if self.is_angles:
            return values.isfinite().all(1)
        R = values.reshape(-1, 3, 3) if len(self.values) == 9 else values[:, :, None]
        identity = torch.eye(R.shape[2], dtype=R.dtype)
        orthonormal = (
            (R.mT @ R - identity).abs().amax((1, 2)) < ORTHONORMALITY_TOLERANCE
        ) & values.isfinite().all(1)
        return orthonormal & (torch.linalg.det(R) > 0) if len(self.values) == 9 else orthonormal


def _euler(name: str, meaning: str, values: str, product: str, *aliases: str) -> RotationEncoding:
    """Return the encoding of three angles: "a:z b:y c:x" for RotZ(a)·RotY(b)·RotX(c)."""
    names, factors = values.split(), [factor.split(":") for factor in product.split()]
    axes = "".join(axis for _, axis in factors)
    order = [names.index(value) for value, _ in factors]

    def to_rotation(angles: _Values) -> _Rotations:
        first, second, third = (
            _about("xyz".index(axis), angles[:, i]) for axis, i in zip(axes, order, strict=True)
        )
        return first @ second @ third

    of_axis = {
        "z": "roll",
        "y": "pitch",
        "x": "yaw",
    }  # encodings of measurement files: RotZ(roll)·RotY(pitch)·RotX(yaw)
    of_value = {value: of_axis[axis] for value, axis in factors}
    columns = tuple(of_value[value] for value in names) if axes == "zyx" else ()
    return RotationEncoding(name, meaning, tuple(names), to_rotation, columns, aliases=_split(aliases))


def _about(axis: int, angle: Float64[Tensor, " rows"]) -> _Rotations:
    vector = angle.new_zeros((len(angle), 3))
    vector[:, axis] = angle
    return rotation_from_vector(vector)


def _quaternion(name: str, meaning: str, values: str, order: str, *aliases: str) -> RotationEncoding:
    """Return the encoding of a quaternion whose values are in the order `order`, such as "wxyz"."""

    def to_rotation(quaternion: _Values) -> _Rotations:
        return rotation_from_quaternion(quaternion[:, [order.index(part) for part in "xyzw"]])

    columns = tuple(f"q{part}" for part in order)
    return RotationEncoding(
        name, meaning, tuple(values.split()), to_rotation, columns, False, _split(aliases)
    )


def _matrix(name: str, meaning: str, values: str, *aliases: str) -> RotationEncoding:
    """Return the encoding of a rotation matrix, row by row."""
    to_rotation: Callable[[_Values], _Rotations] = lambda entries: entries.reshape(-1, 3, 3)  # noqa: E731
    return RotationEncoding(name, meaning, tuple(values.split()), to_rotation, (), False, _split(aliases))


def _vector(name: str, meaning: str, values: str, *aliases: str) -> RotationEncoding:
    return RotationEncoding(
        name, meaning, tuple(values.split()), rotation_from_vector, aliases=_split(aliases)
    )


def _split(aliases: Collection[str]) -> tuple[tuple[str, ...], ...]:
    return tuple(tuple(alias.split()) for alias in aliases)


_SPELT_OUT = "rotx roty rotz"
_ENCODINGS = (
    _euler("kuka", "A about z, B about the new y, C about the new x", "a b c", "a:z b:y c:x"),
    _euler("mitsubishi", "A, B, C about the fixed x, y, z", "a b c", "c:z b:y a:x"),
    _euler("doosan", "A about z, B about the new y, C about the new z", "a b c", "a:z b:y c:z"),
    _euler("fanuc", "W, P, R about the fixed x, y, z", "w p r", "r:z p:y w:x"),
    _euler("epson", "U about z, V about the new y, W about the new x", "u v w", "u:z v:y w:x"),
    _euler("kawasaki", "O about z, A about the new y, T about the new z", "o a t", "o:z a:y t:z"),
    _euler("comau", "A about z, E about the new y, R about the new z", "a e r", "a:z e:y r:z"),
    _euler("yaskawa", "Rx, Ry, Rz about the fixed x, y, z", "rx ry rz", "rz:z ry:y rx:x", _SPELT_OUT),
    _euler("staubli", "Rx about x, Ry about the new y, Rz about the new z", "rx ry rz", "rx:x ry:y rz:z", _SPELT_OUT),
    _vector("ur", "rotation vector of Universal Robots", "rx ry rz", _SPELT_OUT, "tcppose3 tcppose4 tcppose5"),
    _euler("rpy", "roll, pitch, yaw about the fixed x, y, z", "roll pitch yaw", "yaw:z pitch:y roll:x"),
    _euler("omron", "yaw, pitch, roll about z, the new y, the new z", "yaw pitch roll", "yaw:z pitch:y roll:z"),
    _quaternion("abb", "quaternion q1 to q4, scalar first", "q1 q2 q3 q4", "wxyz", "q0 q1 q2 q3"),
    _quaternion("quaternion", "quaternion x, y, z, w", "qx qy qz qw", "xyzw", "quatx quaty quatz quatw"),
    _matrix(
        "matrix",
        "rotation matrix by its rows",
        "r11 r12 r13 r21 r22 r23 r31 r32 r33",
        "t11 t12 t13 t21 t22 t23 t31 t32 t33",
        "m11 m12 m13 m21 m22 m23 m31 m32 m33",
        "m00 m01 m02 m10 m11 m12 m20 m21 m22",
        "nx ox ax ny oy ay nz oz az",
    ),
)  # fmt: skip
ROTATIONS: dict[str, RotationEncoding] = {encoding.name: encoding for encoding in _ENCODINGS}
"""Encodings of rotations by name."""
MATRIX_ROWS = (
    *("matrix_r11", "matrix_r12", "matrix_r13", "x"),
    *("matrix_r21", "matrix_r22", "matrix_r23", "y"),
    *("matrix_r31", "matrix_r32", "matrix_r33", "z"),
)
"""Quantities of the first twelve entries of a homogeneous transform, row by row."""


def encodings_of(names: Collection[str]) -> dict[str, dict[str, str]]:
    """Return the encodings whose values are all among `names`, each with the quantity of every name."""
    there = set(names)
    matches: dict[str, dict[str, str]] = {}
    for encoding in _ENCODINGS:
        for alias in (encoding.values, *encoding.aliases):
            if set(alias) <= there:
                matches.setdefault(encoding.name, dict(zip(alias, encoding.quantities(), strict=True)))
    return matches
