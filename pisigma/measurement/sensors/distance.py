"""Distances from a fixed anchor to the tool, by draw wires and bars, and between the tool positions of two rows."""

from collections.abc import Collection
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.files.errors import IdentificationError, Place, choice_remedy
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
    component_along,
    distinct_names,
    indices_of_names,
    owners_of,
    unit_vectors,
)
from pisigma.robot.kinematics.parameter_jacobian import ToolMotion

ANCHOR_COLUMNS = ("x", "y", "z", "zero")
MIN_DISTANCES = 5
"""Smallest number of distances for an initial guess of an anchor's position and zero offset."""
_ITERATIONS = 30
"""Number of damped least-squares steps after the linear solution."""
MAX_NOMINAL_ERROR = 0.05
"""Largest plausible position error of the nominal robot, as a share of the reach."""
_MAX_COMPARED = 1_024
"""Largest number of distances that are compared with each other."""


@dataclass(frozen=True, eq=False)
class AnchorSensor(AbstractSensor):
    """A wire or bar from a fixed anchor: `|p_tool - p_anchor| + zero`.

    Attributes:
        anchor: index of every row's anchor, -1 in rows without one.
        measured: measured distances [m].
        present: mask of the rows with a distance.
        sigma: standard deviation of every row's distance [m]; None if it is estimated.
    """

    name = "distance"
    unit = "m"
    components = 1
    determines_frame = False
    anchor: Int64[Tensor, " rows"]
    measured: Float64[Tensor, " rows"]
    present: Bool[Tensor, " rows"]
    sigma: Float64[Tensor, " rows"] | None

    @classmethod
    def build(cls, rows: SensorRows) -> "AnchorSensor | None":
        """Build the sensor from the rows with a distance from an anchor; None if there are none."""
        data = rows.measurements
        names = distinct_names(data.anchor)
        if data.distance is None or not names:
            return None
        number = rows.name_indices(data.anchor, names)
        present = data.is_measured("distance") & (number >= 0)
        return cls(number, torch.where(present, data.distance, 0.0), present, rows.sigma(present))

    def residual(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Values:
        """Return measured minus predicted distances [m]."""
        zero = unknowns["anchor"][3, self.anchor[rows]]
        predicted = self._from_anchor(motion, unknowns, rows).norm(dim=0) + zero
        residual: Tensor = self.measured[rows] - predicted
        return residual[None]

    def derivative(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Derivative:
        """Return the derivatives of the distances: the shift of the tool away from the anchor."""
        return component_along(unit_vectors(self._from_anchor(motion, unknowns, rows)), motion.derivative)

    def unknown_derivatives(
        self, motion: ToolMotion, unknowns: Unknowns, rows: slice
    ) -> tuple[UnknownDerivative, ...]:
        """Return the negative unit vector along the wire for the anchor's position, and 1 for the zero offset."""
        direction = unit_vectors(self._from_anchor(motion, unknowns, rows))
        columns = torch.cat([-direction, torch.ones_like(direction[:1])])
        return (UnknownDerivative("anchor", self.anchor[rows], columns[:, None]),)

    def _from_anchor(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Tensor:
        vector: Tensor = motion.position - unknowns["anchor"][:3, self.anchor[rows]]
        return vector

    @classmethod
    def unknowns(cls, measurements: Measurements) -> UnknownGroup | None:
        """Return the anchors, each with a position and a zero offset."""
        owners, frames = owners_of(measurements, measurements.anchor)
        return UnknownGroup("anchor", ANCHOR_COLUMNS, owners, frames) if owners else None

    @classmethod
    def initial_guess(
        cls, measurements: Measurements, T_frame_tool: Poses, reach: float
    ) -> InitialUnknowns | None:
        """Guess zero offsets and, by multilateration, the positions that are not stated.

        Raises:
            IdentificationError: a distance contradicts most other distances, or an anchor has too few distances.
        """
        names = distinct_names(measurements.anchor)
        if measurements.distance is None or not names:
            return None
        values = torch.zeros(len(names), 4, dtype=torch.float64)
        free = torch.ones_like(values, dtype=torch.bool)
        number = indices_of_names(measurements.anchor, names, measurements.rows)
        for k, name in enumerate(names):
            rows = (number == k).nonzero()[:, 0]
            points, distance = T_frame_tool[rows, :3, 3], measurements.distance.cpu()[rows]
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
    def uncalibrated_unknowns(
        cls, measurements: Measurements, owner: str, T: Poses, calibrated_owners: Collection[str]
    ) -> Float64[Tensor, " columns"]:
        """Return the anchor's stated position with a zero offset of 0.

        Raises:
            IdentificationError: the position of the anchor is not stated.
        """
        row = (measurements.anchor or ()).index(owner)
        position = stated_position(measurements, row)
        if position is None:
            raise IdentificationError(
                f"anchor '{owner}' was not calibrated and its position is not given",
                at=measurements.place_of(row, "anchor"),
                value=owner,
                remedy=choice_remedy(owner, calibrated_owners),
            )
        return torch.cat([position, position.new_zeros(1)])


def stated_position(measurements: Measurements, row: int) -> Float64[Tensor, " 3"] | None:
    """Return the stated position of a row's anchor in the row's frame [m], or None."""
    place = measurements.anchor_place
    return place[row] if place is not None and bool(torch.isfinite(place[row]).all()) else None


def anchor_from_distances(
    points: Float64[Tensor, "*batch rows 3"], distance: Float64[Tensor, "*batch rows"]
) -> Float64[Tensor, "*batch 4"]:
    """Estimate an anchor and its zero offset from distances to points (multilateration).

    `(d - zero)² = |p - a|²` is linear in a, zero and `|a|² - zero²`; the solution is refined by least squares of
    `|p - a| + zero = d`.

    Args:
        points: positions of the tool according to the nominal robot [m].
        distance: measured distances [m].

    Returns:
        Position of the anchor in the base of the robot and zero offset: x, y, z, zero [m].
    """
    centre, middle = (
        points.mean(-2),
        distance.mean(-1, keepdim=True),
    )  # centred and scaled, for the condition of the linear system
    p, d = points - centre[..., None, :], distance - middle
    A = torch.cat([-2 * p, 2 * d[..., None], torch.ones_like(d)[..., None]], -1)
    squares = p.square().sum(-1)
    solution = torch.linalg.pinv(A, rtol=1e-4) @ (d.square() - squares)[..., None]
    # the linear system may not determine the zero offset, so a zero offset of 0 is a second start
    without_zero = (
        torch.linalg.pinv(A[..., [0, 1, 2, 4]], rtol=1e-6) @ (distance.square() - squares)[..., None]
    )
    starts = torch.stack([solution[..., :4, 0], torch.cat([without_zero[..., :3, 0], -middle], -1)])
    ends, errors = _refined(p, d, starts)
    best = ends.take_along_dim(errors.argmin(0)[None, ..., None], 0)[0]
    return best + torch.cat([centre, middle], -1)


def _refined(p: Tensor, d: Tensor, unknown: Tensor) -> tuple[Tensor, Tensor]:
    """Return anchors and zero offsets after damped least-squares steps, and the sums of squared residuals [m²]."""

    def linearised(unknown: Tensor) -> tuple[Tensor, Tensor]:
        vector = p - unknown[..., None, :3]
        length = vector.norm(dim=-1).clamp(min=1e-9)
        J = torch.cat([-vector / length[..., None], torch.ones_like(length)[..., None]], -1)
        return d - length - unknown[..., 3:], J

    residual, J = linearised(unknown)
    damping = torch.full_like(unknown[..., :1], 1e-6)
    for _ in range(_ITERATIONS):
        normal = J.mT @ J
        damped = normal + torch.diag_embed(damping * normal.diagonal(dim1=-2, dim2=-1))
        trial = unknown + torch.linalg.solve(damped, J.mT @ residual[..., None])[..., 0]
        trial_residual, trial_J = linearised(trial)
        better = (trial_residual.square().sum(-1) <= residual.square().sum(-1))[..., None]
        unknown, residual = torch.where(better, trial, unknown), torch.where(better, trial_residual, residual)
        J, damping = (
            torch.where(better[..., None], trial_J, J),
            torch.where(better, damping / 10, damping * 100),
        )
    return unknown, residual.square().sum(-1)


def _check_wire(
    measurements: Measurements,
    name: str,
    rows: Int64[Tensor, " rows"],
    points: Float64[Tensor, "rows 3"],
    reach: float,
) -> None:
    """Refuse distances from an anchor that no position of the anchor explains.

    By the triangle inequality, two distances differ by at most the distance between their points, for any zero offset.

    Raises:
        IdentificationError: a distance contradicts most other distances, or there are too few distances.
    """
    if len(rows) < MIN_DISTANCES:
        raise IdentificationError(
            expected=f"{MIN_DISTANCES} or more distances from anchor '{name}', whose position and zero are 4 unknowns",
            value=len(rows),
            at=Place(measurements.source),
            remedy="measure more poses from it, spread over the workspace",
        )
    assert measurements.distance is not None
    rows, points = rows[:_MAX_COMPARED], points[:_MAX_COMPARED]
    distance = measurements.distance.cpu()[rows]
    excess = (distance[:, None] - distance).abs() - torch.cdist(points, points) - MAX_NOMINAL_ERROR * reach
    wrong = (excess > 0).sum(1)
    worst = int(wrong.argmax())
    if int(wrong[worst]) == 0:
        return
    partner = int(excess[worst].argmax())
    short = distance[worst] < distance[partner]
    shown, other = (float(f"{float(distance[k]) * 1e3:.6g}") for k in (worst, partner))
    apart = f"{float((points[worst] - points[partner]).norm()) * 1e3:.4g} mm"
    raise IdentificationError(
        f"the distance {shown:g} mm from anchor '{name}' is {'shorter' if short else 'longer'} than any position of "
        f"the anchor allows, because it is {other:g} mm in {measurements.place(int(rows[partner]))}, and the two "
        f"positions of the tool are only {apart} apart",
        at=measurements.place_of(int(rows[worst]), "distance"),
        value=shown,
        remedy="correct it, or remove the row",
    )


MAX_PAIR_ERROR = 0.2
"""Largest plausible error of a distance between two poses of the nominal robot, as a share of the reach."""


@dataclass(frozen=True, eq=False)
class PairSensor(AbstractSensor):
    """The distance between the tool positions of two neighbouring rows, as a value of the first row.

    Attributes:
        measured: measured distance of every row [m].
        present: mask of the first rows of pairs, which have even indices.
        sigma: standard deviation of every row's distance [m]; None if it is estimated.
    """

    name = "pair"
    unit = "m"
    components = 1
    is_paired = True
    determines_frame = False
    measured: Float64[Tensor, " rows"]
    present: Bool[Tensor, " rows"]
    sigma: Float64[Tensor, " rows"] | None

    @classmethod
    def build(cls, rows: SensorRows) -> "PairSensor | None":
        """Build the sensor from the pairs, which come first as two consecutive rows each; None if there are none."""
        data = rows.measurements
        if data.distance is None or data.pair is None:
            return None
        paired = torch.tensor([bool(name) for name in data.pair], device=data.q.device)
        first = torch.arange(data.rows, device=paired.device) % 2 == 0
        present = data.is_measured("distance") & paired & first
        return cls(torch.where(present, data.distance, 0.0), present, rows.sigma(present))

    def residual(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Values:
        """Return measured minus predicted distances [m]."""
        residual: Tensor = self.measured[rows] - _apart(motion.position).norm(dim=0)
        return residual[None]

    def derivative(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Derivative:
        """Return the derivatives of the distances: the relative shift of the tools along their connecting line."""
        return component_along(unit_vectors(_apart(motion.position)), _apart(motion.derivative[:, :3]))

    def partner_derivative(self, motion: ToolMotion) -> Derivative:
        """Return the derivatives with respect to the next row's tool: its negative shift along the connecting line."""
        return -component_along(unit_vectors(_apart(motion.position)), _following(motion.derivative[:, :3]))

    @classmethod
    def initial_guess(
        cls, measurements: Measurements, T_frame_tool: Poses, reach: float
    ) -> InitialUnknowns | None:
        """Check the distances; there are no unknowns to guess.

        Raises:
            IdentificationError: a distance differs too much from that of the nominal robot.
        """
        if measurements.pair is None or measurements.distance is None:
            return None
        rows = torch.arange(0, 2 * len(distinct_names(measurements.pair)), 2)
        apart = (T_frame_tool[rows, :3, 3] - T_frame_tool[rows + 1, :3, 3]).norm(dim=-1)
        distance = measurements.distance.cpu()[rows]
        error = (distance - apart).abs()
        if len(error) == 0 or float(error.max()) <= MAX_PAIR_ERROR * reach:
            return None
        worst = int(error.argmax())
        row = int(rows[worst])
        raise IdentificationError(
            expected=f"about {float(apart[worst]) * 1e3:.4g} mm between the tool points of pair "
            f"'{measurements.pair[row]}', as for the nominal robot",
            value=float(f"{float(distance[worst]) * 1e3:.6g}"),
            at=measurements.place_of(row, "distance"),
            remedy="correct the distance or the names of the pairs",
        )


def _following(values: Tensor) -> Tensor:
    """Return the values of the next row, for every row."""
    return torch.cat([values[..., 1:], values[..., :1]], -1)


def _apart(values: Tensor) -> Tensor:
    """Return the value of every row minus that of the next row; used only for the first rows of pairs."""
    apart: Tensor = values - _following(values)
    return apart
