"""Distance accuracy AD and distance repeatability RD, from commanded and attained distances between two poses."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pisigma.robot.se3 import wrap_to_pi
from pisigma.validation.iso9283.pose import Accuracy, check_repeats


@dataclass(frozen=True, eq=False)
class DistanceRepeatability:
    """Spread of attained distances; the standard writes both values with ±.

    Attributes:
        length: spread of the distance [m].
        axes: spread of the components of the distance along x, y, z [m].
    """

    length: Float[Tensor, "*batch"]
    axes: Float[Tensor, "*batch 3"]


def distance_accuracy(
    attained_first: Float[Tensor, "*batch n 3"],
    attained_second: Float[Tensor, "*batch n 3"],
    command_first: Float[Tensor, "*batch 3"],
    command_second: Float[Tensor, "*batch 3"],
) -> Accuracy:
    """Compute the positioning distance accuracy AD_P and AD_x, AD_y, AD_z [m] (ISO 9283:1998, 7.3.2).

    `AD_P = D̄ - D_c` with `D_j = |P_1j - P_2j|` and `D_c = |P_c1 - P_c2|`; along an axis
    `AD_x = D̄_x - D_cx` with `D_xj = |x_1j - x_2j|` and `D_cx = |x_c1 - x_c2|`.

    Args:
        attained_first: positions of the n repeats at the first pose [m].
        attained_second: positions of the n repeats at the second pose [m].
        command_first: commanded position of the first pose [m].
        command_second: commanded position of the second pose [m].
    """
    commanded = command_first - command_second
    length, axes = _distances(attained_first, attained_second)
    return Accuracy(
        length.mean(-1) - torch.linalg.vector_norm(commanded, dim=-1), axes.mean(-2) - commanded.abs()
    )


def distance_repeatability(
    attained_first: Float[Tensor, "*batch n 3"], attained_second: Float[Tensor, "*batch n 3"]
) -> DistanceRepeatability:
    """Compute the positioning distance repeatability RD and RD_x, RD_y, RD_z [m] (ISO 9283:1998, 7.3.3).

    `RD = ± 3 √(Σ (D_j - D̄)² / (n - 1))`, likewise for the components `D_xj` along an axis.

    Raises:
        MeasurementError: there is only one repeat.
    """
    check_repeats(attained_first, "a distance")
    length, axes = _distances(attained_first, attained_second)
    return DistanceRepeatability(3 * length.std(-1), 3 * axes.std(-2))


def angular_distance_accuracy(
    attained_first: Float[Tensor, "*batch n 3"],
    attained_second: Float[Tensor, "*batch n 3"],
    command_first: Float[Tensor, "*batch 3"],
    command_second: Float[Tensor, "*batch 3"],
) -> Float[Tensor, "*batch 3"]:
    """Compute the orientation distance accuracy AD_a, AD_b, AD_c [rad] (ISO 9283:1998, 7.3.2).

    `AD_a = D̄_a - D_ca` with `D_aj = |a_1j - a_2j|` and `D_ca = |a_c1 - a_c2|`, wrapped to ±π. The arguments are those
    of `distance_accuracy`, as angles [rad].
    """
    turned = _turned(attained_first, attained_second).mean(-2)
    return turned - wrap_to_pi(command_first - command_second).abs()


def angular_distance_repeatability(
    attained_first: Float[Tensor, "*batch n 3"], attained_second: Float[Tensor, "*batch n 3"]
) -> Float[Tensor, "*batch 3"]:
    """Compute the orientation distance repeatability RD_a, RD_b, RD_c [rad] (ISO 9283:1998, 7.3.3), written with ±.

    Raises:
        MeasurementError: there is only one repeat.
    """
    check_repeats(attained_first, "a distance")
    return 3 * _turned(attained_first, attained_second).std(-2)


def _distances(
    first: Float[Tensor, "*batch n 3"], second: Float[Tensor, "*batch n 3"]
) -> tuple[Float[Tensor, "*batch n"], Float[Tensor, "*batch n 3"]]:
    apart = first - second
    return torch.linalg.vector_norm(apart, dim=-1), apart.abs()


def _turned(
    first: Float[Tensor, "*batch n 3"], second: Float[Tensor, "*batch n 3"]
) -> Float[Tensor, "*batch n 3"]:
    return wrap_to_pi(first - second).abs()
