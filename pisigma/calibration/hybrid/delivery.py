"""Which joint correction is delivered: the largest part of the chosen one that predicts nothing worse than geometry."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.calibration.geometric.problem.noise import view_of
from pisigma.calibration.geometric.result import SolvedCalibration
from pisigma.calibration.hybrid.design import Design, Rows, weigh
from pisigma.calibration.hybrid.refinement import (
    MOST_ROUNDS,
    SETTLED,
    Refined,
    in_chunks,
    linearised,
    network,
    refine,
)
from pisigma.calibration.hybrid.regression import regression
from pisigma.calibration.hybrid.search import CLEAR_GAIN, ROUGHLY, Choice, Fitted
from pisigma.calibration.hybrid.sensor_values import SensorValues, sensor_values
from pisigma.estimation.left_out import standard_errors
from pisigma.estimation.regression import Posterior
from pisigma.joint_correction.feature import AbstractFeature
from pisigma.measurement.groups import groups_of_equal_joints

FOLDS, FOLDS_OF_FEW, FEW_GROUPS = 4, 8, 60
"""Folds that are left out, and of up to so many groups."""
MANY_GROUPS = 600
"""Up to so many, noise and prior sizes are updated for every fold."""
EXACT_GROUPS = 200
"""Up to so many poses or positions, left-out rows are predicted by exact fits; other sensors always are."""

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


Errors = Sequence[SensorErrors | None]


@dataclass(frozen=True, eq=False)
class Delivered:
    """A joint correction that earns its place.

    Attributes:
        choice: with the features that are delivered as the best.
        refined: fitted to the rows of the search.
        left_out: RMS error of left-out rows over that of the geometric calibration, of the sensor that gains most.
    """

    choice: Choice
    refined: Refined
    left_out: float


def delivered(solved: SolvedCalibration, choice: Choice, progress: Callable[[str], None]) -> Delivered | None:
    """Give the largest part of the chosen features that serves every sensor, each part fitted exactly.

    Left-out errors of linearised rows are those of the exact fit only where the linearisation holds. It holds where
    many poses or positions are measured; where few are, or anything else is, the rows of the search are left out again,
    fold by fold, of exact fits with and without the correction. It is delivered where no sensor's rows and left-out
    rows are predicted worse with it and one sensor's are predicted better beyond the scatter.

    Returns:
        The part that serves; None where the geometric calibration is to be delivered.
    """
    problem = choice.rows.problem
    # whole anchors and sockets are for the search: too little may be left to fit a few of them exactly
    group = choice.rows.group if problem.pairs else groups_of_equal_joints(problem.q)
    count = int(group.max()) + 1
    if count > EXACT_GROUPS and set(solved.setup.measurements.kinds) <= {"position", "rotation"}:
        return Delivered(choice, refine(problem, choice.rows.group, choice), _left_out_of_search(choice))
    folds = replace(choice.rows, group=group).folds(FOLDS if count > FEW_GROUPS else FOLDS_OF_FEW, count)
    updates = int(count <= MANY_GROUPS)
    before = left_out_rows(Design(problem, ()), _geometric_posterior(solved, choice), group, folds, updates)
    for part in _parts(choice):
        progress(f"left-out rows, {part.best.name}")
        refined = refine(problem, choice.rows.group, part)
        errors = left_out_rows(refined.design, refined.posterior, group, folds, updates)
        compared = _compared(errors, before)
        if not any(one.is_worse for one in compared) and any(one.gain > CLEAR_GAIN for one in compared):
            return Delivered(part, refined, min(one.left_out for one in compared))
    return None


def _left_out_of_search(choice: Choice) -> float:
    """The ratio that the search found, of linearised rows."""
    return [trial.left_out for trial in choice.trials if trial.kept][-1]


def _compared(errors: Errors, before: Errors) -> list[Comparison]:
    """The errors of every sensor that measures something."""
    pairs = zip(errors, before, strict=True)
    return [one.compare(other) for one, other in pairs if one is not None and other is not None]


def _geometric_posterior(solved: SolvedCalibration, choice: Choice) -> Posterior:
    """The geometric calibration as what the rows of the search say of its parameters."""
    problem, group = choice.rows.problem, choice.rows.group
    design, view = Design(problem, ()), view_of(solved.solution.linearisation)
    x = (solved.solution.linearisation.point - problem.nominal)[problem.active]
    rows = linearised(design, x, choice.geometry.posterior.effective, group)
    prior = design.prior(view.prior_scale.tolist())
    return regression(design, rows).solve(prior, tuple(view.noise.tolist()))


def _parts(choice: Choice) -> Iterator[Choice]:
    """The chosen features, and ever fewer of them, the last one that was tried going first."""
    yield choice
    features = choice.best.design.features
    for count in range(len(features) - 1, 0, -1):
        yield _part(choice, features[:count])


def _part(choice: Choice, features: tuple[AbstractFeature, ...]) -> Choice:
    """The choice with some of its features as the best."""
    best, design = choice.best, Design(choice.rows.problem, features)
    fit = (choice.regression or regression(best.design, choice.rows)).select(design)
    prior = design.prior_like(best.design, best.posterior.prior)
    posterior = fit.maximise_evidence(prior, best.posterior.noise, tolerance=ROUGHLY)
    return replace(choice, best=Fitted(design, posterior, best.largest_share), regression=fit)
