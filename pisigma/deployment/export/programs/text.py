"""Formatting of numbers, frames and comments in the templates of programs."""

import math
import textwrap
from collections.abc import Iterable

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.robot.se3 import rotation_vector, zyx_from_rotation

DIGITS = 6
"""Number of decimals of degrees and millimetres, which rounds joints by 1e-8 rad and moves no tool by a micrometre.
Radians, metres and quaternions have 9."""


def format_numbers(values: Iterable[float], digits: int = DIGITS) -> str:
    """Format numbers with ", " between them; see `number`."""
    return ", ".join(format_number(value, digits) for value in values)


def format_number(value: float, digits: int) -> str:
    """Format a number with a decimal point, without an exponent and without a sign of zero."""
    assert math.isfinite(value), "a program has finite numbers only"
    written = f"{value:.{digits}f}"
    return written.removeprefix("-") if not float(written) else written


def format_labelled(values: Iterable[float], labels: Iterable[str], unit: str = "") -> str:
    """Format numbers with labels and units, such as `X 1.000000, Y 2.000000`."""
    return ", ".join(
        f"{label} {format_number(v, DIGITS)}{unit}" for label, v in zip(labels, values, strict=True)
    )


def comments(sentences: Iterable[str], mark: str, width: int = 100) -> str:
    """Wrap sentences into lines of printable ASCII with a comment mark; other characters are written as `?`."""
    lines = []
    for sentence in sentences:
        plain = " ".join(sentence.split()).encode("ascii", "replace").decode()
        plain = "".join(character if character.isprintable() else "?" for character in plain)
        lines += [f"{mark}{line}" for line in textwrap.wrap(plain, width, break_on_hyphens=False)]
    return "\n".join(lines)


def position_in_mm(T: Float64[Tensor, "*batch 4 4"]) -> list[float]:
    """Return x, y, z [mm]."""
    position: list[float] = (T[..., :3, 3] * 1e3).tolist()
    return position


def metres_and_rotation_vector(T: Float64[Tensor, "4 4"]) -> list[float]:
    """Return x, y, z [m] and the rotation vector [rad]."""
    values: list[float] = torch.cat([T[:3, 3], rotation_vector(T[:3, :3])]).tolist()
    return values


def quaternion(T: Float64[Tensor, "4 4"]) -> list[float]:
    """Return the unit quaternion (w, x, y, z), w >= 0, of a rotation: `cos(t/2), n sin(t/2)` for axis n and angle t."""
    vector = rotation_vector(T[:3, :3])
    half = torch.linalg.vector_norm(vector, dim=-1, keepdim=True) / 2
    values: list[float] = torch.cat([torch.cos(half), vector / 2 * torch.sinc(half / torch.pi)], -1).tolist()
    return values


def millimetres_and_euler(T: Float64[Tensor, "*batch 4 4"]) -> Float64[Tensor, "*batch 6"]:
    """Return x, y, z [mm] and the angles a, b, c [deg] of `RotZ(a) RotY(b) RotX(c)`.

    Near b = ±90 deg, a is poorly determined; c is computed from the rotation without a and compensates its error:
    `RotZ(-a) R = RotY(b) RotX(c)`, whose second row is `0, cos c, -sin c`.
    """
    R = T[..., :3, :3]
    a, b, _ = zyx_from_rotation(R).unbind(-1)
    row = torch.cos(a)[..., None] * R[..., 1, :] - torch.sin(a)[..., None] * R[..., 0, :]
    angles = torch.stack([a, b, torch.atan2(-row[..., 2], row[..., 1])], -1)
    return torch.cat([T[..., :3, 3] * 1e3, torch.rad2deg(angles)], -1)
