"""Sockets, which are fixed points that hold the ball of the tool, and stated distances between sockets."""

import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.files.errors import IdentificationError, Phrase, Place, choice_remedy
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.sensor import (
    AbstractSensor,
    Derivative,
    InitialUnknowns,
    Poses,
    SensorRows,
    UnknownDerivative,
    UnknownGroup,
    Unknowns,
    Values,
    distinct_names,
    indices_of_names,
    owners_of,
    unit_vectors,
)
from pisigma.robot.kinematics.parameter_jacobian import ToolMotion

PairOfSockets = tuple[str, str]
SOCKET_COLUMNS = ("x", "y", "z")

_MAX_SCATTER = 0.05
"""Largest plausible scatter of the rows of one socket under the nominal robot, as a share of the reach."""

_OUTLIER_FACTOR = 4.0
"""Distance of a row from the median position, relative to the median distance, above which it is an outlier: about 6
standard deviations."""


@dataclass(frozen=True, eq=False)
class SocketSensor(AbstractSensor):
    """A ball that sits in a socket: `p_tool - p_socket = 0`, where the socket is unknown.

    Attributes:
        socket: index of every row's socket, -1 in rows without one.
        present: mask of the rows with a socket.
        sigma: standard deviation of a coordinate [m] of every row; None if it is estimated.
    """

    name = "socket"
    unit = "m"
    components = 3
    determines_frame = False
    socket: Int64[Tensor, " rows"]
    present: Bool[Tensor, " rows"]
    sigma: Float64[Tensor, " rows"] | None

    @classmethod
    def build(cls, rows: SensorRows) -> "SocketSensor | None":
        """Build the sensor from the rows whose ball sat in a socket; None if there are none."""
        names = rows.measurements.socket
        present = rows.measurements.is_measured("socket")
        if not bool(present.any()):
            return None
        return cls(rows.name_indices(names, distinct_names(names)), present, rows.sigma(present))

    def residual(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Values:
        """Return the socket's position minus the tool's position [m]."""
        return unknowns["socket"][:, self.socket[rows]] - motion.position

    def derivative(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Derivative:
        """Return the derivatives of the tool's position: the shift of the tool."""
        return motion.derivative[:, :3]

    def unknown_derivatives(
        self, motion: ToolMotion, unknowns: Unknowns, rows: slice
    ) -> tuple[UnknownDerivative, ...]:
        """Return the derivatives with respect to the socket's position: the negative identity."""
        socket = self.socket[rows]
        eye = torch.eye(3).to(motion.position)
        return (UnknownDerivative("socket", socket, -eye[..., None].expand(3, 3, len(socket))),)

    @classmethod
    def unknowns(cls, measurements: Measurements) -> UnknownGroup | None:
        """Return the sockets, each with a position."""
        owners, frames = owners_of(measurements, measurements.socket)
        return UnknownGroup("socket", SOCKET_COLUMNS, owners, frames) if owners else None

    @classmethod
    def initial_guess(
        cls, measurements: Measurements, T_frame_tool: Poses, reach: float
    ) -> InitialUnknowns | None:
        """Guess the position of every socket as the mean of its rows.

        Raises:
            IdentificationError: according to the nominal robot, the rows of one socket are far apart.
        """
        names = distinct_names(measurements.socket)
        if not names:
            return None
        socket = indices_of_names(measurements.socket, names, measurements.rows)
        points, socket = T_frame_tool[socket >= 0, :3, 3], socket[socket >= 0]
        middle = group_means(points, socket, len(names))
        usual = float((points - middle[socket]).norm(dim=-1).median())
        if usual > _MAX_SCATTER * reach:
            raise IdentificationError(
                expected="the nominal robot to place the rows of a socket at one position",
                value=Phrase(f"a median distance of {usual * 1e3:.3g} mm from their mean"),
                at=Place(measurements.source),
                remedy="check the directions and zeros of the joints, the tool, and the names of the sockets",
            )
        return InitialUnknowns(middle, torch.ones_like(middle, dtype=torch.bool))

    @classmethod
    def uncalibrated_unknowns(
        cls, measurements: Measurements, owner: str, T: Poses, calibrated_owners: Collection[str]
    ) -> Float64[Tensor, " columns"]:
        """Return the mean position of the rows of a socket, without outliers."""
        rows = indices_of_names(measurements.socket, (owner,), measurements.rows).to(T.device) == 0
        points = T[rows, :3, 3]
        off = (points - points.quantile(0.5, dim=0)).norm(dim=-1)
        middle: Tensor = points[off <= _OUTLIER_FACTOR * off.quantile(0.5)].mean(0)
        return middle


@dataclass(frozen=True, eq=False)
class SocketDistanceSensor(AbstractSensor):
    """Stated distances between two sockets, each assigned to a row of one of them.

    Attributes:
        first: index of one socket, -1 in rows without a distance.
        second: index of the other socket.
        measured: the distance [m].
        present: mask of the rows with a distance.
        sigma: standard deviation of the distance [m].
    """

    name = "socket distance"
    unit = "m"
    components = 1
    are_values_given = True
    determines_frame = False
    first: Int64[Tensor, " rows"]
    second: Int64[Tensor, " rows"]
    measured: Float64[Tensor, " rows"]
    present: Bool[Tensor, " rows"]
    sigma: Float64[Tensor, " rows"] | None

    @classmethod
    def build(cls, rows: SensorRows) -> "SocketDistanceSensor | None":
        """Return None, because the user states the distances; see `assign_distances`."""
        return None

    @classmethod
    def assign_distances(
        cls, measurements: Measurements, distances: Mapping[PairOfSockets, float], sigma: float
    ) -> "SocketDistanceSensor | None":
        """Assign distances to different rows of their sockets; None if there is no distance.

        Args:
            measurements: rows with sockets.
            distances: distances between two sockets [m].
            sigma: standard deviation of the distances [m].

        Raises:
            IdentificationError: a distance is not positive, or its sockets are equal or have no rows.
        """
        if not distances:
            return None
        order = distinct_names(measurements.socket)
        rows, device = measurements.rows, measurements.q.device
        first, second = (torch.full((rows,), -1, dtype=torch.int64) for _ in range(2))
        measured = torch.zeros(rows, dtype=torch.float64)
        free: dict[str, list[int]] = {name: [] for name in order}
        for row, name in enumerate(measurements.socket or ()):
            if name:
                free[name].append(row)
        for (one, other), distance in distances.items():
            _check_distance(one, other, distance, order, measurements.source)
            rows_left = free[one] or free[other]
            if not rows_left:
                raise IdentificationError(
                    f"the sockets '{one}' and '{other}' have more distances than rows",
                    option="socket_distances",
                    value=f"{one} and {other}",
                    at=Place(measurements.source),
                    remedy="give fewer distances",
                )
            row = rows_left.pop(0)
            first[row], second[row], measured[row] = order.index(one), order.index(other), distance
        tensors = (first, second, measured, first >= 0, torch.full_like(measured, sigma))
        return cls(*(tensor.to(device) for tensor in tensors))

    def residual(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Values:
        """Return stated minus predicted distances [m]."""
        residual: Tensor = self.measured[rows] - self._apart(unknowns, rows).norm(dim=0)
        return residual[None]

    def derivative(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Derivative:
        """Return 0, because the distances do not depend on the tool."""
        return torch.zeros_like(motion.derivative[:, :1])

    def unknown_derivatives(
        self, motion: ToolMotion, unknowns: Unknowns, rows: slice
    ) -> tuple[UnknownDerivative, ...]:
        """Return the derivatives for both sockets: the unit vector from the second to the first, and its negative."""
        direction = unit_vectors(self._apart(unknowns, rows))[:, None]
        return (
            UnknownDerivative("socket", self.first[rows], direction),
            UnknownDerivative("socket", self.second[rows], -direction),
        )

    def _apart(self, unknowns: Unknowns, rows: slice) -> Tensor:
        sockets = unknowns["socket"]
        apart: Tensor = sockets[:, self.first[rows]] - sockets[:, self.second[rows]]
        return apart


def _check_distance(one: str, other: str, distance: float, order: tuple[str, ...], source: str) -> None:
    for name in (one, other):
        if name not in order:
            raise IdentificationError(
                f"no row has the socket '{name}'",
                option="socket_distances",
                value=name,
                at=Place(source),
                remedy=choice_remedy(name, order),
            )
    if one == other or not distance > 0:
        raise IdentificationError(
            option="socket_distances",
            expected="a distance > 0 between two different sockets",
            value=Phrase(f"{distance * 1e3:.6g} mm between '{one}' and '{other}'"),
            at=Place(source),
        )


def group_means(
    values: Float64[Tensor, "rows size"], group: Int64[Tensor, " rows"], group_count: int
) -> Tensor:
    """Return the mean of the values over the rows of every group from 0 to `group_count - 1`."""
    total = values.new_zeros((group_count, values.shape[1])).index_add(0, group, values)
    return total / torch.bincount(group, minlength=group_count).clamp(min=1)[:, None]


def expand_socket_names(
    distances: Mapping[tuple[str, str], float], sockets: Iterable[str]
) -> dict[tuple[str, str], float]:
    """Return distances by names of sockets in the data, with "*" expanded; see `CalibrationSettings`."""
    names = dict.fromkeys(name for name in sockets if name)
    matching: dict[tuple[str, str], float] = {}
    for (first, second), distance in distances.items():
        pattern = re.compile(re.escape(first).replace(r"\*", "(.*)", 1))
        pairs = []
        for name in names:
            match = pattern.fullmatch(name)
            other = second.replace("*", match[1], 1) if match and "*" in first else second
            if match and other in names:
                pairs.append((name, other))
        if not pairs:
            raise IdentificationError(
                option="socket_distances",
                expected=f"names of two sockets of the data ({', '.join(names) or 'none'})",
                value=Phrase(f"{first} and {second}"),
            )
        for pair in pairs:
            known = matching.get(pair, matching.get((pair[1], pair[0]), distance))
            if known != distance:
                raise IdentificationError(
                    option="socket_distances",
                    expected=f"one distance between the sockets '{pair[0]}' and '{pair[1]}'",
                    value=Phrase(f"{known * 1e3:g} and {distance * 1e3:g} mm"),
                )
            matching[pair] = distance
    return matching
