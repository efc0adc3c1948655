"""Pose accuracy AP, pose repeatability RP, drift of both, and variation with the direction of approach."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pisigma.files.errors import MeasurementError
from pisigma.robot.se3 import rotation_vector, wrap_to_pi


@dataclass(frozen=True, eq=False)
class Accuracy:
    """Difference between the mean attained value and the command.

    Attributes:
        length: distance of positions, or error of a distance [m].
        axes: signed components along x, y, z [m].
    """

    length: Float[Tensor, "*batch"]
    axes: Float[Tensor, "*batch 3"]


def position_accuracy(attained: Float[Tensor, "*batch n 3"], command: Float[Tensor, "*batch 3"]) -> Accuracy:
    """Compute the positioning accuracy AP_P and AP_x, AP_y, AP_z [m] (ISO 9283:1998, 7.2.1).

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
    """Compute the orientation accuracy AP_a, AP_b, AP_c [rad] (ISO 9283:1998, 7.2.1): `AP_a = ā - a_c`.

    Args:
        attained: angles of the n repeats [rad], modulo 2π.
        command: the commanded angles [rad].
    """
    return wrap_to_pi(attained - command[..., None, :]).mean(-2)


def position_repeatability(attained: Float[Tensor, "*batch n 3"]) -> Float[Tensor, "*batch"]:
    """Compute the positioning repeatability RP_l [m] (ISO 9283:1998, 7.2.2): radius of a sphere about the barycentre.

    `RP_l = l̄ + 3 S_l` with the distances `l_j` from the barycentre, their mean `l̄` and
    `S_l = √(Σ (l_j - l̄)² / (n - 1))`.

    Args:
        attained: positions of the n repeats [m], two or more.

    Raises:
        MeasurementError: there is only one repeat.
    """
    check_repeats(attained, "a command")
    distance = torch.linalg.vector_norm(attained - barycentre(attained)[..., None, :], dim=-1)
    radius: Tensor = distance.mean(-1) + 3 * distance.std(-1)
    return radius


def orientation_repeatability(attained: Float[Tensor, "*batch n 3"]) -> Float[Tensor, "*batch 3"]:
    """Compute the orientation repeatability RP_a, RP_b, RP_c [rad] (ISO 9283:1998, 7.2.2).

    Returns:
        `3 S_a` with `S_a = √(Σ (a_j - ā)² / (n - 1))`; the standard writes it with ±.

    Raises:
        MeasurementError: there is only one repeat.
    """
    check_repeats(attained, "a command")
    spread: Tensor = wrap_to_pi(attained - attained[..., :1, :]).std(-2)
    return 3 * spread


def directional_position_variation(
    attained: Float[Tensor, "*batch directions n 3"],
) -> Float[Tensor, "*batch"]:
    """Compute the multi-directional pose accuracy variation vAP_P [m] (ISO 9283:1998, 7.2.3).

    It is the largest distance between the barycentres of one pose that is approached from several directions:
    `vAP_P = max_{h,k} √((x̄_h - x̄_k)² + (ȳ_h - ȳ_k)² + (z̄_h - z̄_k)²)`.

    Args:
        attained: positions [m]; the standard requires three mutually perpendicular directions.
    """
    middle = barycentre(attained)
    apart = middle[..., :, None, :] - middle[..., None, :, :]
    largest: Tensor = torch.linalg.vector_norm(apart, dim=-1).amax((-1, -2))
    return largest


def directional_orientation_variation(
    attained: Float[Tensor, "*batch directions n 3"],
) -> Float[Tensor, "*batch 3"]:
    """Compute the multi-directional pose accuracy variation vAP_a, vAP_b, vAP_c [rad] (ISO 9283:1998, 7.2.3).

    `vAP_a = max_{h,k} |ā_h - ā_k|`, for angles modulo 2π.
    """
    middle = wrap_to_pi(attained - attained[..., :1, :1, :]).mean(-2)
    variation: Tensor = middle.amax(-2) - middle.amin(-2)
    return variation


def accuracy_drift(accuracy: Float[Tensor, "times *kinds"]) -> Float[Tensor, "times *kinds"]:
    """Compute the drift of pose accuracy dAP (ISO 9283:1998, 7.6): `dAP = |AP_{t=1} - AP_{t=T}|`.

    Args:
        accuracy: AP at every time, of positions [m] or of angles [rad], for example `position_accuracy(...).length` of
            `(times, n, 3)`.

    Returns:
        The drift up to every time; the first is 0, and the last is the drift of the standard.
    """
    return (accuracy[:1] - accuracy).abs()


def repeatability_drift(repeatability: Float[Tensor, "times *kinds"]) -> Float[Tensor, "times *kinds"]:
    """Compute the drift of pose repeatability dRP (ISO 9283:1998, 7.6): `dRP = RP_{t=1} - RP_{t=T}`.

    Args:
        repeatability: RP at every time, of positions [m] or of angles [rad].

    Returns:
        The drift up to every time, > 0 if the repeatability has improved; the last is the drift of the standard.
    """
    return repeatability[:1] - repeatability


def angular_deviations(
    attained: Float[Tensor, "*batch n 3 3"], command: Float[Tensor, "*batch 3 3"]
) -> Float[Tensor, "*batch n 3"]:
    """Compute the angles a, b, c [rad] about the frame's x, y and z between attained and commanded rotations.

    The angles are the rotation vector of `R_j R_c^T`, which has no singular orientation; the commanded angles are
    then 0.
    """
    return rotation_vector(attained @ command[..., None, :, :].mT)


def barycentre(attained: Float[Tensor, "*batch n 3"]) -> Float[Tensor, "*batch 3"]:
    """Compute the mean attained position [m], relative to the first position so that no digits are lost."""
    first = attained[..., :1, :]
    return first[..., 0, :] + (attained - first).mean(-2)


def check_repeats(attained: Float[Tensor, "*batch n 3"], repeated_item: str) -> None:
    """Refuse a single repeat, which has no spread.

    Args:
        attained: values of the n repeats.
        repeated_item: what was repeated, such as "a command".

    Raises:
        MeasurementError: there is only one repeat.
    """
    if attained.shape[-2] < 2:
        raise MeasurementError(
            option="attained",
            expected=f"2 or more repeats of {repeated_item}",
            value=attained.shape[-2],
            remedy="measure 30, as the standard requires",
        )
