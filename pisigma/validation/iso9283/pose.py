"""Pose accuracy AP, pose repeatability RP, how both drift, and how much the direction of approach matters."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pisigma.files.errors import MeasurementError
from pisigma.robot.se3 import rotation_vector, wrap_to_pi


@dataclass(frozen=True, eq=False)
class Accuracy:
    """How far the middle of what was attained is from the command.

    Attributes:
        length: of positions the distance, of distances the error of the length [m].
        axes: along x, y, z [m], signed.
    """

    length: Float[Tensor, "*batch"]
    axes: Float[Tensor, "*batch 3"]


def position_accuracy(attained: Float[Tensor, "*batch n 3"], command: Float[Tensor, "*batch 3"]) -> Accuracy:
    """Positioning accuracy AP_P and AP_x, AP_y, AP_z (ISO 9283:1998, 7.2.1).

    With the barycentre `x̄ = 1/n Σ x_j`: `AP_x = x̄ - x_c`, and `AP_P = √(AP_x² + AP_y² + AP_z²)`.

    Args:
        attained: positions of the n repeats [m].
        command: the commanded position [m].
    """
    axes = barycentre(attained) - command
    return Accuracy(torch.linalg.vector_norm(axes, dim=-1), axes)


def orientation_accuracy(
    attained: Float[Tensor, "*batch n 3"], command: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 3"]:
    """Orientation accuracy AP_a, AP_b, AP_c [rad] (ISO 9283:1998, 7.2.1): `AP_a = ā - a_c`.

    Args:
        attained: angles of the n repeats [rad]; a full turn more or less makes no difference.
        command: the commanded angles [rad].
    """
    return wrap_to_pi(attained - command[..., None, :]).mean(-2)


def position_repeatability(attained: Float[Tensor, "*batch n 3"]) -> Float[Tensor, "*batch"]:
    """Positioning repeatability RP_l [m] (ISO 9283:1998, 7.2.2): radius of a sphere about the barycentre.

    `RP_l = l̄ + 3 S_l` with the distances `l_j` from the barycentre, their mean `l̄` and
    `S_l = √(Σ (l_j - l̄)² / (n - 1))`.

    Args:
        attained: positions of the n repeats [m], two or more.

    Raises:
        MeasurementError: there is one repeat only.
    """
    check_repeats(attained, "a command")
    distance = torch.linalg.vector_norm(attained - barycentre(attained)[..., None, :], dim=-1)
    radius: Tensor = distance.mean(-1) + 3 * distance.std(-1)
    return radius


def orientation_repeatability(attained: Float[Tensor, "*batch n 3"]) -> Float[Tensor, "*batch 3"]:
    """Orientation repeatability RP_a, RP_b, RP_c [rad] (ISO 9283:1998, 7.2.2).

    Returns:
        `3 S_a` with `S_a = √(Σ (a_j - ā)² / (n - 1))`; the standard writes it with ±.

    Raises:
        MeasurementError: there is one repeat only.
    """
    check_repeats(attained, "a command")
    spread: Tensor = wrap_to_pi(attained - attained[..., :1, :]).std(-2)
    return 3 * spread


def directional_position_variation(
    attained: Float[Tensor, "*batch directions n 3"],
) -> Float[Tensor, "*batch"]:
    """Multi-directional pose accuracy variation vAP_P [m] (ISO 9283:1998, 7.2.3).

    Largest distance between the barycentres of one pose that is approached along several paths:
    `vAP_P = max_{h,k} √((x̄_h - x̄_k)² + (ȳ_h - ȳ_k)² + (z̄_h - z̄_k)²)`.

    Args:
        attained: positions [m]; the standard asks for three directions, perpendicular to each other.
    """
    middle = barycentre(attained)
    apart = middle[..., :, None, :] - middle[..., None, :, :]
    largest: Tensor = torch.linalg.vector_norm(apart, dim=-1).amax((-1, -2))
    return largest


def directional_orientation_variation(
    attained: Float[Tensor, "*batch directions n 3"],
) -> Float[Tensor, "*batch 3"]:
    """Multi-directional pose accuracy variation vAP_a, vAP_b, vAP_c [rad] (ISO 9283:1998, 7.2.3).

    `vAP_a = max_{h,k} |ā_h - ā_k|`; a full turn more or less makes no difference.
    """
    middle = wrap_to_pi(attained - attained[..., :1, :1, :]).mean(-2)
    variation: Tensor = middle.amax(-2) - middle.amin(-2)
    return variation


def accuracy_drift(accuracy: Float[Tensor, "times *kinds"]) -> Float[Tensor, "times *kinds"]:
    """Drift of pose accuracy dAP (ISO 9283:1998, 7.6): `dAP = |AP_{t=1} - AP_{t=T}|`.

    Args:
        accuracy: AP at every time, of positions [m] or of angles [rad], such as `position_accuracy(...).length` of
            `(times, n, 3)`.

    Returns:
        The drift up to every time; the last is that of the standard, 0 is the first.
    """
    return (accuracy[:1] - accuracy).abs()


def repeatability_drift(repeatability: Float[Tensor, "times *kinds"]) -> Float[Tensor, "times *kinds"]:
    """Drift of pose repeatability dRP (ISO 9283:1998, 7.6): `dRP = RP_{t=1} - RP_{t=T}`.

    Args:
        repeatability: RP at every time, of positions [m] or of angles [rad].

    Returns:
        The drift up to every time, above 0 where the robot repeats better than at first; the last is that of the
        standard.
    """
    return repeatability[:1] - repeatability


def angular_deviations(
    attained: Float[Tensor, "*batch n 3 3"], command: Float[Tensor, "*batch 3 3"]
) -> Float[Tensor, "*batch n 3"]:
    """Angles a, b, c [rad] about the frame's x, y and z by which attained rotations are off the command.

    They are the rotation vector of `R_j R_c^T`, which has no singular orientation; the commanded angles are then 0.
    """
    return rotation_vector(attained @ command[..., None, :, :].mT)


def barycentre(attained: Float[Tensor, "*batch n 3"]) -> Float[Tensor, "*batch 3"]:
    """Mean of the attained positions [m]; the first is taken off before, so that no digits are lost."""
    first = attained[..., :1, :]
    return first[..., 0, :] + (attained - first).mean(-2)


def check_repeats(attained: Float[Tensor, "*batch n 3"], of: str) -> None:
    """Make sure that there are enough repeats for a spread.

    Args:
        attained: what was attained in the n repeats.
        of: what was repeated, such as "a command".

    Raises:
        MeasurementError: there is one repeat only.
    """
    if attained.shape[-2] < 2:
        raise MeasurementError(
            f"repeatability: 2 repeats of {of} or more were wanted, got {attained.shape[-2]}; the standard asks for "
            "30."
        )
