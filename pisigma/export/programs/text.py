"""Numbers, comments and the head of a program, as every controller reads them."""

import math
import textwrap
from collections.abc import Iterable

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.export.programs.targets import Targets
from pisigma.kinematics.status import Status
from pisigma.se3 import rpy_from_rotation

TEST = (
    "TEST IT AT LOW SPEED FIRST: nothing was checked for collisions, neither the targets nor the ways between "
    "them."
)


def heading(targets: Targets, cartesian: bool) -> tuple[str, ...]:
    """Sentences on what the program does and on what it relies.

    Args:
        targets: the targets.
        cartesian: whether they are poses and not joint values.
    """
    said = [
        targets.title,
        TEST,
        f"Joint values count from the zeros and in the directions of the robot description "
        f"'{targets.robot.name}'; the controller has to count the same.",
    ]
    if cartesian:
        said += [
            "Poses are those that the robot as drawn takes at the corrected joint values: the controller has to "
            "compute with the robot as drawn, and any accuracy option of its own has to be off.",
            "Frame and tool are those of the model, as seen from the origin and from the last row of the robot "
            "description, which have to be the controller's origin and flange.",
            *targets.remarks,
        ]
    if targets.doubt:
        said.append(targets.doubt)
    return tuple(said)


DIGITS = 6
"""Decimals of degrees and millimetres: joints are rounded by 1e-8 rad, which moves no tool by a micrometre."""

FINE_DIGITS = 9
"""Decimals of radians, metres and quaternions."""


def number(value: float, digits: int) -> str:
    """A number with a decimal point, without exponent and without a sign before zero."""
    assert math.isfinite(value), "a program holds finite numbers only"
    written = f"{value:.{digits}f}"
    return written.removeprefix("-") if not float(written) else written


def numbers(values: Iterable[float], digits: int) -> str:
    """Numbers with a comma and a blank between them."""
    return ", ".join(number(value, digits) for value in values)


def labelled(labels: Iterable[str], values: Iterable[float]) -> str:
    """Numbers, each behind its label, such as `X 1.000000, Y 2.000000`."""
    return ", ".join(f"{label} {number(v, DIGITS)}" for label, v in zip(labels, values, strict=True))


def comments(sentences: Iterable[str], mark: str, width: int = 100) -> list[str]:
    """Sentences as lines of printable ASCII, each behind a mark; other characters are written as `?`."""
    lines = []
    for sentence in sentences:
        plain = " ".join(sentence.split()).encode("ascii", "replace").decode()
        plain = "".join(letter if letter.isprintable() else "?" for letter in plain)
        lines += [f"{mark}{line}" for line in textwrap.wrap(plain, width, break_on_hyphens=False)]
    return lines


def place(targets: Targets, row: int) -> str:
    """What is said before a move: where its pose stands, and whether its correction is a guess."""
    guess = " OUTSIDE DOMAIN" if targets.status[row] == Status.OUTSIDE_DOMAIN else ""
    return f"line {targets.line[row]}{guess}"


def millimetres_and_euler(T: Float64[Tensor, "*batch 4 4"]) -> Float64[Tensor, "*batch 6"]:
    """x, y, z [mm] and the angles [deg] of `RotZ(a) RotY(b) RotX(c)` in the order a, b, c.

    Where b is near ±90 deg, a is hardly determined; c is computed from what is left of the rotation without a and
    so makes up for it: `RotZ(-a) R = RotY(b) RotX(c)`, whose second row is `0, cos c, -sin c`.
    """
    R = T[..., :3, :3]
    a, b, _ = rpy_from_rotation(R).unbind(-1)
    row = torch.cos(a)[..., None] * R[..., 1, :] - torch.sin(a)[..., None] * R[..., 0, :]
    angles = torch.stack([a, b, torch.atan2(-row[..., 2], row[..., 1])], -1)
    return torch.cat([T[..., :3, 3] * 1e3, torch.rad2deg(angles)], -1)
