"""Sockets: fixed points that the ball at the tool sits in, and stated distances between them."""

import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.files.errors import IdentificationError, nearest_choice
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
    names_of,
    numbers_of,
    owners_of,
    unit_vectors,
)
from pisigma.robot.kinematics.parameter_jacobian import ToolMotion

PairOfSockets = tuple[str, str]
SOCKET_COLUMNS = ("x", "y", "z")

LARGEST_SCATTER = 0.05
"""[reach] By the robot as drawn, rows of one socket are not farther apart than this."""

GROSS = 4.0
"""Rows that put a ball farther than so many times the median from its median are wrong: 6 standard deviations."""


@dataclass(frozen=True, eq=False)
class SocketSensor(AbstractSensor):
    """A ball that sits in a socket: `p_tool - p_socket = 0`, where the socket is unknown.

    Attributes:
        socket: index of every row's socket, -1 where there is none.
        present: whether a row has one.
        sigma: standard deviation of a coordinate [m] of every row, or None.
    """

    name = "socket"
    unit = "m"
    components = 3
    holds_frame = False
    socket: Int64[Tensor, " rows"]
    present: Bool[Tensor, " rows"]
    sigma: Float64[Tensor, " rows"] | None

    @classmethod
    def build(cls, rows: SensorRows) -> "SocketSensor | None":
        """Gather the rows whose ball sat in a socket."""
        names = rows.measurements.socket
        present = rows.measurements.measured("socket")
        if not bool(present.any()):
            return None
        return cls(rows.numbers(names, names_of(names)), present, rows.sigma(present))

    def residual(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Values:
        """Return the socket's position minus the tool's [m]."""
        return unknowns["socket"][:, self.socket[rows]] - motion.position

    def derivative(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Derivative:
        """Return the tool's shift."""
        return motion.derivative[:, :3]

    def unknown_derivatives(
        self, motion: ToolMotion, unknowns: Unknowns, rows: slice
    ) -> tuple[UnknownDerivative, ...]:
        """Return minus the socket's shift."""
        socket = self.socket[rows]
        eye = torch.eye(3).to(motion.position)
        return (UnknownDerivative("socket", socket, -eye[..., None].expand(3, 3, len(socket))),)

    @classmethod
    def unknowns(cls, measurements: Measurements) -> UnknownGroup | None:
        """Name the sockets; each has a position."""
        owners, frames = owners_of(measurements, measurements.socket)
        return UnknownGroup("socket", SOCKET_COLUMNS, owners, frames) if owners else None

    @classmethod
    def initial_guess(cls, measurements: Measurements, T: Poses, reach: float) -> InitialUnknowns | None:
        """Guess every socket at the mean of its rows.

        Raises:
            IdentificationError: by the robot as drawn, the rows of one socket are far from each other.
        """
        names = names_of(measurements.socket)
        if not names:
            return None
        socket = numbers_of(measurements.socket, names, measurements.rows)
        points, socket = T[socket >= 0, :3, 3], socket[socket >= 0]
        middle = means(points, socket, len(names))
        usual = float((points - middle[socket]).norm(dim=-1).median())
        if usual > LARGEST_SCATTER * reach:
            raise IdentificationError(
                f"{measurements.source}: by the robot as drawn the rows of one socket are about {usual * 1e3:.3g} mm "
                "away from each other; check the directions and zeros of the joints, the tool, and the names of the "
                "sockets."
            )
        return InitialUnknowns(middle, torch.ones_like(middle, dtype=torch.bool))

    @classmethod
    def uncalibrated(
        cls, measurements: Measurements, owner: str, T: Poses, calibrated: Collection[str]
    ) -> Float64[Tensor, " columns"]:
        """Return where the rows of a socket meet on average, but for gross errors."""
        rows = numbers_of(measurements.socket, (owner,), measurements.rows).to(T.device) == 0
        points = T[rows, :3, 3]
        off = (points - points.quantile(0.5, dim=0)).norm(dim=-1)
        middle: Tensor = points[off <= GROSS * off.quantile(0.5)].mean(0)
        return middle


@dataclass(frozen=True, eq=False)
class SocketDistanceSensor(AbstractSensor):
    """Stated distances between two sockets, each attached to a row of one of them.

    Attributes:
        first: index of one socket, -1 where a row has no such distance.
        second: index of the other.
        measured: the distance [m].
        present: whether a row has one.
        sigma: its standard deviation [m].
    """

    name = "socket distance"
    unit = "m"
    components = 1
    certain = True
    holds_frame = False
    first: Int64[Tensor, " rows"]
    second: Int64[Tensor, " rows"]
    measured: Float64[Tensor, " rows"]
    present: Bool[Tensor, " rows"]
    sigma: Float64[Tensor, " rows"] | None

    @classmethod
    def build(cls, rows: SensorRows) -> "SocketDistanceSensor | None":
        """Find none: the distances come from the user, see `between`."""
        return None

    @classmethod
    def between(
        cls, measurements: Measurements, distances: Mapping[PairOfSockets, float], sigma: float
    ) -> "SocketDistanceSensor | None":
        """Attach distances to rows of their sockets, each to another row; None where there is no distance.

        Args:
            measurements: rows with sockets.
            distances: between two sockets [m].
            sigma: standard deviation of the distances [m].

        Raises:
            IdentificationError: a distance is none, or names a socket that no row has, or twice the same.
        """
        if not distances:
            return None
        order = names_of(measurements.socket)
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
                    f"{measurements.source}: more distances of the sockets '{one}' and '{other}' are stated than they "
                    "have rows; give fewer distances."
                )
            row = rows_left.pop(0)
            first[row], second[row], measured[row] = order.index(one), order.index(other), distance
        tensors = (first, second, measured, first >= 0, torch.full_like(measured, sigma))
        return cls(*(tensor.to(device) for tensor in tensors))

    def residual(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Values:
        """Return stated minus present distances [m]."""
        residual: Tensor = self.measured[rows] - self._apart(unknowns, rows).norm(dim=0)
        return residual[None]

    def derivative(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Derivative:
        """Return 0: the tool has no part in it."""
        return torch.zeros_like(motion.derivative[:, :1])

    def unknown_derivatives(
        self, motion: ToolMotion, unknowns: Unknowns, rows: slice
    ) -> tuple[UnknownDerivative, ...]:
        """Return the direction from the second socket to the first, and back."""
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
                f"{source}: socket_distances names the socket '{name}', but no row has it; "
                f"{nearest_choice(name, order)}"
            )
    if one == other or not distance > 0:
        raise IdentificationError(
            f"{source}: socket_distances states {distance * 1e3:.6g} mm between '{one}' and '{other}'; a positive "
            "distance between two different sockets was wanted."
        )


def means(values: Float64[Tensor, "rows size"], number: Int64[Tensor, " rows"], count: int) -> Tensor:
    """Return the mean over the rows of every number from 0 to `count - 1`."""
    total = values.new_zeros((count, values.shape[1])).index_add(0, number, values)
    return total / torch.bincount(number, minlength=count).clamp(min=1)[:, None]


def matching_sockets(
    distances: Mapping[tuple[str, str], float], sockets: Iterable[str]
) -> dict[tuple[str, str], float]:
    """Distances by names of sockets in the data; see `CalibrationSettings`."""
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
                f"no two sockets of the data are called '{first}' and '{second}'; there are "
                f"{', '.join(names) or 'none'}."
            )
        for pair in pairs:
            known = matching.get(pair, matching.get((pair[1], pair[0]), distance))
            if known != distance:
                raise IdentificationError(
                    f"expected one distance of the sockets '{pair[0]}' and '{pair[1]}', got {known * 1e3:g} and "
                    f"{distance * 1e3:g} mm; state one."
                )
            matching[pair] = distance
    return matching
