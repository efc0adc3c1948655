"""Wires and bars: the distance from a fixed anchor to the tool."""

from collections.abc import Collection
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
    along,
    names_of,
    numbers_of,
    owners_of,
    unit_vectors,
)
from pisigma.robot.kinematics.parameter_jacobian import ToolMotion

ANCHOR_COLUMNS = ("x", "y", "z", "zero")
FEWEST = 5
"""Distances from which the position and the zero of their anchor can be guessed."""
POLISH = 30
"""Damped steps after the linear solution."""
LARGEST_MISS = 0.05
"""[reach] The robot as drawn is not as wrong as this."""
COMPARED = 1_024
"""Distances that are compared with each other."""


@dataclass(frozen=True, eq=False)
class AnchorSensor(AbstractSensor):
    """A wire or bar from a fixed anchor: `|p_tool - p_anchor| + zero`.

    Attributes:
        anchor: index of every row's anchor, -1 where there is none.
        measured: what is shown [m].
        present: whether a row has one.
        sigma: standard deviation of every row [m], or None.
    """

    name = "distance"
    unit = "m"
    components = 1
    holds_frame = False
    anchor: Int64[Tensor, " rows"]
    measured: Float64[Tensor, " rows"]
    present: Bool[Tensor, " rows"]
    sigma: Float64[Tensor, " rows"] | None

    @classmethod
    def build(cls, rows: SensorRows) -> "AnchorSensor | None":
        """Gather the distances from anchors."""
        data = rows.measurements
        names = names_of(data.anchor)
        if data.distance is None or not names:
            return None
        number = rows.numbers(data.anchor, names)
        present = data.measured("distance") & (number >= 0)
        return cls(number, torch.where(present, data.distance, 0.0), present, rows.sigma(present))

    def residual(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Values:
        """Return shown minus predicted distances [m]."""
        zero = unknowns["anchor"][3, self.anchor[rows]]
        predicted = self._from_anchor(motion, unknowns, rows).norm(dim=0) + zero
        residual: Tensor = self.measured[rows] - predicted
        return residual[None]

    def derivative(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Derivative:
        """Return the tool's shift away from the anchor."""
        return along(unit_vectors(self._from_anchor(motion, unknowns, rows)), motion.derivative)

    def unknown_derivatives(
        self, motion: ToolMotion, unknowns: Unknowns, rows: slice
    ) -> tuple[UnknownDerivative, ...]:
        """Return minus the anchor's shift along the wire, and one for the zero."""
        direction = unit_vectors(self._from_anchor(motion, unknowns, rows))
        columns = torch.cat([-direction, torch.ones_like(direction[:1])])
        return (UnknownDerivative("anchor", self.anchor[rows], columns[:, None]),)

    def _from_anchor(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Tensor:
        away: Tensor = motion.position - unknowns["anchor"][:3, self.anchor[rows]]
        return away

    @classmethod
    def unknowns(cls, measurements: Measurements) -> UnknownGroup | None:
        """Name the anchors; each has a position and what its sensor shows at no distance."""
        owners, frames = owners_of(measurements, measurements.anchor)
        return UnknownGroup("anchor", ANCHOR_COLUMNS, owners, frames) if owners else None

    @classmethod
    def initial_guess(cls, measurements: Measurements, T: Poses, reach: float) -> InitialUnknowns | None:
        """Guess zeros, and by multilateration the positions that the measurements do not state.

        Raises:
            IdentificationError: a reading is impossible beside most of the others, or an anchor has too few.
        """
        names = names_of(measurements.anchor)
        if measurements.distance is None or not names:
            return None
        values = torch.zeros(len(names), 4, dtype=torch.float64)
        free = torch.ones_like(values, dtype=torch.bool)
        number = numbers_of(measurements.anchor, names, measurements.rows)
        for k, name in enumerate(names):
            rows = (number == k).nonzero()[:, 0]
            points, distance = T[rows, :3, 3], measurements.distance.cpu()[rows]
            _check_wire(measurements, name, rows, points, reach)
            position = stated_position(measurements, int(rows[0]))
            if position is None:
                values[k] = anchor_from_distances(points, distance)
            else:
                free[k, :3] = False
                zero = (distance - (points - position.cpu()).norm(dim=-1)).median()
                values[k] = torch.cat([position.cpu(), zero[None]])
        return InitialUnknowns(values, free)

    @classmethod
    def uncalibrated(
        cls, measurements: Measurements, owner: str, T: Poses, calibrated: Collection[str]
    ) -> Float64[Tensor, " columns"]:
        """Return the anchor's position that the measurements state, and no zero.

        Raises:
            IdentificationError: they state none.
        """
        row = (measurements.anchor or ()).index(owner)
        position = stated_position(measurements, row)
        if position is None:
            raise IdentificationError(
                f"{measurements.place(row)}: anchor '{owner}' was not calibrated and its position is not stated; "
                f"{nearest_choice(owner, calibrated)}"
            )
        return torch.cat([position, position.new_zeros(1)])


def stated_position(measurements: Measurements, row: int) -> Float64[Tensor, " 3"] | None:
    """Where the measurements state the anchor of a row in its frame [m]; None where they do not."""
    place = measurements.anchor_place
    return place[row] if place is not None and bool(torch.isfinite(place[row]).all()) else None


def anchor_from_distances(
    points: Float64[Tensor, "rows 3"], distance: Float64[Tensor, " rows"]
) -> Float64[Tensor, " 4"]:
    """Find an anchor and its zero from distances to points (multilateration).

    `(d - zero)² = |p - a|²` is linear in a, zero and `|a|² - zero²`; then `|p - a| + zero = d` is polished.

    Args:
        points: where the robot as drawn has the tool [m].
        distance: what was shown there [m].

    Returns:
        x, y, z, zero [m].
    """
    centre, middle = points.mean(0), distance.mean()
    p, d = points - centre, distance - middle
    A = torch.cat([-2 * p, 2 * d[:, None], torch.ones_like(d)[:, None]], -1)
    solution = torch.linalg.pinv(A, rtol=1e-4) @ (d.square() - p.square().sum(-1))
    # where the linear system does not determine the zero, a sensor that shows 0 at no distance is the other start
    without_zero = torch.linalg.pinv(A[:, [0, 1, 2, 4]], rtol=1e-6) @ (distance.square() - p.square().sum(-1))
    starts = solution[:4], torch.cat([without_zero[:3], -middle[None]])
    best, _ = min((_polished(p, d, start) for start in starts), key=lambda end: end[1])
    return best + torch.cat([centre, middle[None]])


def _polished(p: Tensor, d: Tensor, unknown: Tensor) -> tuple[Tensor, float]:
    """Anchor and zero after damped least-squares steps, and how far they miss the distances [m]."""

    def linearised(unknown: Tensor) -> tuple[Tensor, Tensor]:
        away = p - unknown[:3]
        length = away.norm(dim=-1).clamp(min=1e-9)
        J = torch.cat([-away / length[:, None], torch.ones_like(length)[:, None]], -1)
        return d - length - unknown[3], J

    residual, J = linearised(unknown)
    damping = 1e-6
    for _ in range(POLISH):
        normal = J.mT @ J
        trial = unknown + torch.linalg.solve(
            normal + damping * torch.diag(normal.diagonal()), J.mT @ residual
        )
        there, J_there = linearised(trial)
        if float(there.square().sum()) <= float(residual.square().sum()):
            unknown, residual, J, damping = trial, there, J_there, damping / 10
        else:
            damping *= 100
    return unknown, float(residual.square().mean().sqrt())


def _check_wire(
    measurements: Measurements,
    name: str,
    rows: Int64[Tensor, " rows"],
    points: Float64[Tensor, "rows 3"],
    reach: float,
) -> None:
    """Refuse distances from an anchor that no position of it allows.

    By the triangle's inequality two readings differ by no more than the points are apart, whatever the zero.

    Raises:
        IdentificationError: a reading is impossible beside most of the others, or there are too few.
    """
    if len(rows) < FEWEST:
        raise IdentificationError(
            f"{measurements.source}: anchor '{name}' has {len(rows)} distances, but its position and zero are 4 "
            "unknowns; measure more poses from it, spread over the workspace."
        )
    assert measurements.distance is not None
    rows, points = rows[:COMPARED], points[:COMPARED]
    distance = measurements.distance.cpu()[rows]
    excess = (distance[:, None] - distance).abs() - torch.cdist(points, points) - LARGEST_MISS * reach
    wrong = (excess > 0).sum(1)
    worst = int(wrong.argmax())
    if int(wrong[worst]) == 0:
        return
    partner = int(excess[worst].argmax())
    short = distance[worst] < distance[partner]
    raise IdentificationError(
        f"{measurements.place(int(rows[worst]))}: the distance {float(distance[worst]) * 1e3:.6g} mm from anchor "
        f"'{name}' is {'shorter' if short else 'longer'} than any position of the anchor allows: in "
        f"{measurements.place(int(rows[partner]))} it is {float(distance[partner]) * 1e3:.6g} mm, though the tool "
        f"is only {float((points[worst] - points[partner]).norm()) * 1e3:.4g} mm away; correct it or remove it."
    )
