"""Path accuracy AT and path repeatability RT, and resampling of measured paths at the points of the command."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pisigma.files.errors import MeasurementError
from pisigma.robot.se3 import wrap_to_pi
from pisigma.validation.iso9283.pose import (
    barycentre,
    orientation_accuracy,
    orientation_repeatability,
    position_repeatability,
)

_CROSSINGS = 2**21
"""Number of pairs of a command point and a segment of a measured path that are in memory at a time."""


@dataclass(frozen=True, eq=False)
class PathPoints:
    """Measured paths at the planes normal to the commanded path.

    Attributes:
        position: position of every measured path at every point of the commanded path [m].
        angles: angles of every measured path at these points [rad], or None.
    """

    position: Float[Tensor, "n points 3"]
    angles: Float[Tensor, "n points 3"] | None


def path_tangents(command: Float[Tensor, "points 3"]) -> Float[Tensor, "points 3"]:
    """Compute unit vectors along a commanded path [1]; those at inner points follow from both neighbours.

    Raises:
        MeasurementError: there is only one point, or neighbours coincide.
    """
    if len(command) < 2:
        raise MeasurementError(option="command", expected="2 or more command points", value=len(command))
    along = torch.cat([command[1:2] - command[:1], command[2:] - command[:-2], command[-1:] - command[-2:-1]])
    length = torch.linalg.vector_norm(along, dim=-1, keepdim=True)
    if (length == 0).any():
        point = int((length[:, 0] == 0).nonzero()[0])
        raise MeasurementError(
            f"the path has no direction at point {point} (counted from 0)",
            option="command",
            value=point,
            remedy="give points that differ",
        )
    tangents: Tensor = along / length
    return tangents


def resample_paths(
    measured: Float[Tensor, "n samples 3"],
    command: Float[Tensor, "points 3"],
    angles: Float[Tensor, "n samples 3"] | None = None,
    tangents: Float[Tensor, "points 3"] | None = None,
) -> PathPoints:
    """Compute where measured paths cross the planes normal to the commanded path at its points.

    The planes are those of ISO 9283:1998, 8.2. Paths are interpolated linearly between samples. If a path crosses a
    plane several times in the direction of the command, the crossing nearest to the command point is used.

    Args:
        measured: samples of n repeats of the path [m]; shorter paths end with NaN.
        command: points of the commanded path [m], in the order in which they are passed.
        angles: angles of the samples [rad].
        tangents: directions of the command at its points, if they differ from `path_tangents`, for example at corners.

    Raises:
        MeasurementError: a path does not cross a plane; it must start before the first point and end after the last.
    """
    tangents = path_tangents(command) if tangents is None else tangents
    step = max(1, _CROSSINGS // max(1, measured[..., 0].numel()))
    crossings = [
        _crossings(measured, command[first : first + step], tangents[first : first + step], first)
        for first in range(0, len(command), step)
    ]
    piece, share = (torch.cat(chunks, 1)[..., None] for chunks in zip(*crossings, strict=True))
    position = _between(measured, measured[:, 1:] - measured[:, :-1], piece, share)
    if angles is None:
        return PathPoints(position, None)
    return PathPoints(position, _between(angles, wrap_to_pi(angles[:, 1:] - angles[:, :-1]), piece, share))


def path_accuracy(
    attained: Float[Tensor, "n points 3"], command: Float[Tensor, "points 3"]
) -> Float[Tensor, ""]:
    """Compute the positioning path accuracy AT_P [m] (ISO 9283:1998, 8.2).

    `AT_P = max_i √((x̄_i - x_ci)² + (ȳ_i - y_ci)² + (z̄_i - z_ci)²)` over the points of the command.

    Args:
        attained: n repeats of the path at the command points [m], see `resample_paths`.
        command: command points [m].
    """
    off: Tensor = torch.linalg.vector_norm(barycentre(attained.movedim(0, 1)) - command, dim=-1)
    return off.amax()


def path_orientation_accuracy(
    attained: Float[Tensor, "n points 3"], command: Float[Tensor, "points 3"]
) -> Float[Tensor, " 3"]:
    """Compute the orientation path accuracy AT [rad] (ISO 9283:1998, 8.2): `AT_a = max_i |ā_i - a_ci|`, AT_b, AT_c."""
    return orientation_accuracy(attained.movedim(0, 1), command).abs().amax(0)


def path_repeatability(attained: Float[Tensor, "n points 3"]) -> Float[Tensor, ""]:
    """Compute the positioning path repeatability RT_P [m] (ISO 9283:1998, 8.3).

    `RT_P = max_i (l̄_i + 3 S_li)`, the largest positioning repeatability of the points of the command.

    Raises:
        MeasurementError: there is only one repeat.
    """
    return position_repeatability(attained.movedim(0, 1)).amax()


def path_orientation_repeatability(attained: Float[Tensor, "n points 3"]) -> Float[Tensor, " 3"]:
    """Compute the orientation path repeatability RT_a, RT_b, RT_c [rad] (ISO 9283:1998, 8.3): `max_i 3 S_ai`.

    Raises:
        MeasurementError: there is only one repeat.
    """
    return orientation_repeatability(attained.movedim(0, 1)).amax(0)


def _crossings(
    measured: Float[Tensor, "n samples 3"],
    command: Float[Tensor, "some 3"],
    tangents: Float[Tensor, "some 3"],
    first: int,
) -> tuple[Tensor, Tensor]:
    """Return the segment that crosses the plane, for every path and command point, and the position on it (0 to 1)."""
    off = measured[:, None] - command[:, None]
    ahead = (off * tangents[:, None]).sum(-1)
    before, behind = ahead[..., :-1], ahead[..., 1:]
    crosses = (before <= 0) & (behind >= 0) & (before < behind)
    share = torch.where(crosses, before / (before - behind), 0.0)
    place = off[..., :-1, :] + share[..., None] * (off[..., 1:, :] - off[..., :-1, :])
    distance = torch.where(crosses, place.square().sum(-1), torch.inf)
    nearest, piece = distance.min(-1)
    if torch.isinf(nearest).any():
        path, point = torch.isinf(nearest).nonzero()[0].tolist()
        raise MeasurementError(
            f"path {path} does not pass command point {first + point} (both counted from 0)",
            option="measured",
            value=(path, first + point),
            remedy="record it from before the first point to after the last, or omit the points at the ends",
        )
    return piece, share.gather(-1, piece[..., None])[..., 0]


def _between(values: Tensor, steps: Tensor, piece: Tensor, share: Tensor) -> Tensor:
    """Interpolate linearly between the start of a segment and its end."""
    where = piece.expand(-1, -1, 3)
    return values.gather(1, where) + share * steps.gather(1, where)
