"""From measurements to sensors, seen from the bases' anchors."""

from collections.abc import Mapping

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.errors import IdentificationError, nearest_choice
from pisigma.measurement.dataset import Measurements
from pisigma.se3 import invert
from pisigma.sensors.distance import DistanceSensor, PairSensor
from pisigma.sensors.sensor import AbstractSensor, PositionSensor, RotationSensor
from pisigma.sensors.socket import SocketDistanceSensor, SocketSensor
from pisigma.sensors.touch import TouchSensor

PairOfSockets = tuple[str, str]


def build_sensors(
    measurements: Measurements,
    bases: Float64[Tensor, "frames 4 4"],
    tools: Float64[Tensor, "targets 3 3"],
    frame: Int64[Tensor, " rows"],
    target: Int64[Tensor, " rows"],
) -> list[AbstractSensor]:
    """The measured values as sensors, seen from the bases' anchors and freed of the tools' anchors.

    Raises:
        IdentificationError: a standard deviation is given in some rows of a kind only.
    """
    Ts = invert(bases).to(measurements.q.device)[frame]
    sensors = [
        _positions(measurements, Ts),
        _rotations(measurements, Ts, tools.to(Ts.device)[target]),
        _touches(measurements, bases.to(Ts.device)[frame]),
        _sockets(measurements),
        _distances(measurements),
        _pairs(measurements),
    ]
    return [sensor for sensor in sensors if sensor is not None]


def numbers_of(names: tuple[str, ...] | None, order: tuple[str, ...], rows: int) -> Int64[Tensor, " rows"]:
    """Where every row's name stands in an order, -1 where it is in none."""
    numbers = {name: number for number, name in enumerate(order)}
    different = set(names or ("",))
    if len(different) == 1:
        return torch.full((rows,), numbers.get(different.pop(), -1), dtype=torch.int64)
    return torch.tensor([numbers.get(name, -1) for name in names or ()], dtype=torch.int64)


def names_of(names: tuple[str, ...] | None) -> tuple[str, ...]:
    """The different names, in the order in which they come; "" is none."""
    return tuple(name for name in dict.fromkeys(names or ()) if name)


def _positions(measurements: Measurements, Ts: Tensor) -> AbstractSensor | None:
    seen = measurements.measured("position") | measurements.measured("pose")
    if measurements.position is None or not bool(seen.any()):
        return None
    position = (Ts[:, :3, :3] @ measurements.position[..., None])[..., 0] + Ts[:, :3, 3]
    sigma = _sigma(measurements, measurements.sigma_position, seen, "sigma_mm")
    return PositionSensor(torch.where(seen, position.t(), 0.0).contiguous(), seen, sigma)


def _rotations(measurements: Measurements, Ts: Tensor, R_tool: Tensor) -> AbstractSensor | None:
    seen = measurements.measured("rotation") | measurements.measured("pose")
    if measurements.rotation is None or not bool(seen.any()):
        return None
    rotation = Ts[:, :3, :3] @ measurements.rotation @ R_tool.mT
    eye = torch.eye(3, dtype=rotation.dtype, device=rotation.device)
    rotation = torch.where(seen[:, None, None], rotation, eye).permute(1, 2, 0).contiguous()
    return RotationSensor(
        rotation, seen, _sigma(measurements, measurements.sigma_rotation, seen, "sigma_deg")
    )


def _touches(measurements: Measurements, bases: Tensor) -> AbstractSensor | None:
    """`e · (R p + t) = coordinate` is `(R^T e) · p = coordinate - e · t`."""
    seen = measurements.measured("touch")
    if measurements.touch is None or not bool(seen.any()):
        return None
    axis = numbers_of(measurements.touch_axis, ("x", "y", "z"), measurements.rows).to(seen.device)
    rows = bases[torch.arange(measurements.rows, device=seen.device), axis]
    sigma = _sigma(measurements, measurements.sigma_position, seen, "sigma_mm")
    measured = torch.where(seen, measurements.touch - rows[:, 3], 0.0)
    return TouchSensor(rows[:, :3].t().contiguous(), measured, seen, sigma)


def _sockets(measurements: Measurements) -> AbstractSensor | None:
    seen = measurements.measured("socket")
    if not bool(seen.any()):
        return None
    names = names_of(measurements.socket)
    number = numbers_of(measurements.socket, names, measurements.rows).to(seen.device)
    return SocketSensor(number, seen, _sigma(measurements, measurements.sigma_position, seen, "sigma_mm"))


def _distances(measurements: Measurements) -> AbstractSensor | None:
    names = names_of(measurements.anchor)
    if measurements.distance is None or not names:
        return None
    number = numbers_of(measurements.anchor, names, measurements.rows).to(measurements.q.device)
    seen = measurements.measured("distance") & (number >= 0)
    sigma = _sigma(measurements, measurements.sigma_position, seen, "sigma_mm")
    return DistanceSensor(number, torch.where(seen, measurements.distance, 0.0), seen, sigma)


def _pairs(measurements: Measurements) -> AbstractSensor | None:
    """The rows of pairs come first, side by side."""
    if measurements.distance is None or measurements.pair is None:
        return None
    names = torch.tensor([bool(name) for name in measurements.pair], device=measurements.q.device)
    first = torch.arange(measurements.rows, device=names.device) % 2 == 0
    seen = measurements.measured("distance") & names & first
    sigma = _sigma(measurements, measurements.sigma_position, seen, "sigma_mm")
    return PairSensor(torch.where(seen, measurements.distance, 0.0), seen, sigma)


def build_socket_distances(
    measurements: Measurements, known: Mapping[PairOfSockets, float], sigma: float
) -> AbstractSensor | None:
    """Known distances between sockets, each attached to another row of one of its sockets.

    Raises:
        IdentificationError: a distance is none, or names a socket that no row has, or twice the same.
    """
    if not known:
        return None
    order = names_of(measurements.socket)
    rows, device = measurements.rows, measurements.q.device
    first, second = (torch.full((rows,), -1, dtype=torch.int64) for _ in range(2))
    measured = torch.zeros(rows, dtype=torch.float64)
    free = {name: [] for name in order}  # type: dict[str, list[int]]
    for row, name in enumerate(measurements.socket or ()):
        if name:
            free[name].append(row)
    for (one, other), distance in known.items():
        _check_socket_distance(one, other, distance, order, measurements.source)
        rows_left = free[one] or free[other]
        if not rows_left:
            raise IdentificationError(
                f"{measurements.source}: more distances are known of sockets '{one}' and '{other}' than they have "
                "rows; give fewer distances."
            )
        row = rows_left.pop(0)
        first[row], second[row], measured[row] = order.index(one), order.index(other), distance
    seen = first >= 0
    parts = (part.to(device) for part in (first, second, measured, seen, torch.full_like(measured, sigma)))
    return SocketDistanceSensor(*parts)


def _check_socket_distance(
    one: str, other: str, distance: float, order: tuple[str, ...], source: str
) -> None:
    for name in (one, other):
        if name not in order:
            raise IdentificationError(
                f"{source}: socket_distances names the socket '{name}', but no row has it; "
                f"{nearest_choice(name, order)}"
            )
    if one == other or not distance > 0:
        raise IdentificationError(
            f"{source}: socket_distances gives {distance * 1e3:.6g} mm between '{one}' and '{other}'; a positive "
            "distance between two different sockets was wanted."
        )


def _sigma(measurements: Measurements, sigma: Tensor | None, seen: Tensor, column: str) -> Tensor | None:
    """Standard deviations of the rows of a kind, all or none."""
    if sigma is None or not bool(torch.isfinite(sigma[seen]).any()):
        return None
    lacking = seen & ~torch.isfinite(sigma)
    if bool(lacking.any()):
        row = int(lacking.nonzero()[0, 0])
        raise IdentificationError(
            f"{measurements.source}: {column} is given in some rows but not in {measurements.place(row)}; "
            "give it in every row or in none, then it is estimated."
        )
    return sigma
