"""Rows predicted without them by exact fits to the others: what a joint correction has to improve to be delivered."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.calibration.hybrid.design import Design, Rows, weigh
from pisigma.calibration.hybrid.refinement import MOST_ROUNDS, SETTLED, in_chunks, network
from pisigma.calibration.hybrid.regression import regression
from pisigma.calibration.hybrid.sensor_values import SensorValues, sensor_values
from pisigma.estimation.left_out import standard_errors
from pisigma.estimation.regression import Posterior

TOLERANCE = 1.005
"""Errors count as worse from this ratio of their RMS: a smaller difference is no difference to anybody."""
REFITS = 10
"""Gauss-Newton steps for unknowns of which only left-out rows say something, such as where their socket is."""


@dataclass(frozen=True, eq=False)
class SensorErrors:
    """Errors of one sensor's rows, in the fit of all rows and left out of it.

    Attributes:
        group: number of every row's group, see `Rows.group`.
        fitted: lengths of the errors of all rows [m or rad], or in standard deviations where the rows state them.
        left_out: the same under fits without the row's fold; NaN in rows that were in no fold.
        weight: 1 in rows that the fit takes in full, 0 in those that it rejects.
    """

    group: Int64[Tensor, " values"]
    fitted: Float64[Tensor, " values"]
    left_out: Float64[Tensor, " values"]
    weight: Float64[Tensor, " values"]

    def compare(self, before: "SensorErrors") -> "Comparison":
        """Compare with the errors of the same rows under another fit; a row counts that either of them takes."""
        weight = torch.maximum(self.weight, before.weight)
        judged = torch.isfinite(before.left_out)  # a fit that predicts nothing is worse than any
        fitted = [(weight * one.fitted.square()).sum() for one in (self, before)]
        squares = [(weight * one.left_out.square())[judged] for one in (self, before)]
        gain = torch.zeros(int(self.group.max()) + 1 if len(self.group) else 0).to(weight)
        gain = gain.index_add(0, self.group[judged], squares[1] - squares[0])
        return Comparison(
            _ratio(fitted[0], fitted[1]),
            _ratio(squares[0].sum(), squares[1].sum()),
            standard_errors(gain[torch.unique(self.group[judged])]),
        )


@dataclass(frozen=True)
class Comparison:
    """Errors of one sensor under a fit over those under another.

    Attributes:
        fitted: ratio of the RMS errors of all rows.
        left_out: ratio of the RMS errors of left-out rows.
        gain: by how many standard errors the left-out squares are smaller, groups being independent.
    """

    fitted: float
    left_out: float
    gain: float

    @property
    def is_worse(self) -> bool:
        """Whether rows or left-out rows are predicted worse."""
        return not (self.fitted <= TOLERANCE and self.left_out <= TOLERANCE)


def left_out_rows(
    design: Design,
    posterior: Posterior,
    group: Int64[Tensor, " rows"],
    folds: Sequence[Int64[Tensor, " _groups"]],
    updates: int = 0,
) -> tuple[SensorErrors | None, ...]:
    """Leave out one fold after the other and predict its rows with an exact fit to the others.

    The fit is linearised again until linearised and true residuals of the rows that it is made of agree. An unknown of
    which only left-out rows say something is fitted to them.

    Args:
        design: the unknowns.
        posterior: of all rows.
        group: see `Rows.group`.
        folds: groups that are left out together.
        updates: of noise and prior sizes for every fold.

    Returns:
        Errors per sensor; None of sensors that are certain.
    """
    values = _values(design, posterior.x)
    weights = weigh(design.problem, values, posterior.effective)
    rows = Rows.linearised(design, posterior.x, values, weights, group)
    fit = regression(design, rows)
    left_out = [torch.full_like(one.root, torch.nan) for one in values]
    for groups in folds:
        held = torch.isin(group, groups.to(group.device))
        others = torch.unique(group[~held])
        rest = fit.without(groups).maximise_evidence(posterior.prior, posterior.noise, updates)
        here, x = rows, rest.x
        for _ in range(MOST_ROUNDS):
            seen = _values(design, x)
            there = Rows.linearised(design, x, seen, weights, group)
            differs = there.of(others).difference(here.of(others), x, design, rest.noise)
            if not differs >= SETTLED * rest.effective:
                break
            rest = regression(design, there).without(groups).solve(rest.prior, rest.noise)
            here, x = there, rest.x
        x = _with_own_unknowns(design, x, posterior.x, values, held)
        for errors, one in zip(left_out, _values(design, x), strict=True):
            chosen = held[one.row]
            errors[chosen] = (one.residual.norm(dim=1) * one.root)[chosen]
    return tuple(
        None if one.certain else SensorErrors(group[one.row], one.residual.norm(dim=1) * one.root, *errors)
        for one, *errors in zip(values, left_out, weights, strict=True)
    )


def _values(design: Design, x: Float64[Tensor, " unknowns"]) -> tuple[SensorValues, ...]:
    """All rows as they are under some unknowns."""
    problem = design.problem
    point = problem.nominal.index_add(0, problem.active, x[: design.active])
    return sensor_values(problem, point, in_chunks(network(design, x)) if design.features else None)


def _with_own_unknowns(
    design: Design,
    x: Float64[Tensor, " unknowns"],
    start: Float64[Tensor, " unknowns"],
    values: Sequence[SensorValues],
    held: Bool[Tensor, " rows"],
) -> Float64[Tensor, " unknowns"]:
    """The unknowns with those that only left-out rows depend on fitted to these, from where all rows have them."""
    moving = torch.zeros(design.active, dtype=torch.bool, device=x.device)
    for one in values:
        if not one.certain:
            moving |= (one.geometry[~held[one.row]] != 0).flatten(0, 1).any(0)
    own = (~moving).nonzero()[:, 0]
    if not len(own):
        return x
    x = x.index_copy(0, own, start[own])
    for _ in range(REFITS):
        blocks = []
        for one in _values(design, x):
            chosen = held[one.row] | one.certain
            columns = one.geometry[chosen][..., own] * one.root[chosen][:, None, None]
            errors = one.residual[chosen] * one.root[chosen][:, None]
            blocks.append((columns.flatten(0, 1), errors.flatten()))
        J, r = (torch.cat(parts) for parts in zip(*blocks, strict=True))
        step = torch.linalg.lstsq(J, r[:, None], driver="gelsd").solution[:, 0]
        x = x.index_add(0, own, step)
        if float((J @ step).norm()) <= 1e-9 * max(float(r.norm()), 1e-300):
            break
    return x


def _ratio(after: Tensor, before: Tensor) -> float:
    """Ratio of root mean squares; 1 of two that are 0."""
    return 1.0 if float(after) == float(before) == 0 else float((after / before).sqrt())
