"""Which joint correction is delivered: the largest part of the chosen one that predicts nothing worse than geometry."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

from pisigma.calibration.geometric.problem.noise import view_of
from pisigma.calibration.geometric.result import SolvedCalibration
from pisigma.calibration.hybrid.design import Design
from pisigma.calibration.hybrid.left_out_rows import Comparison, SensorErrors, left_out_rows
from pisigma.calibration.hybrid.refinement import Refined, linearised, refine
from pisigma.calibration.hybrid.regression import regression
from pisigma.calibration.hybrid.search import CLEAR_GAIN, ROUGHLY, Choice, Fitted
from pisigma.estimation.regression import Posterior
from pisigma.joint_correction.feature import AbstractFeature
from pisigma.measurement.groups import groups_of_equal_joints

FOLDS, FOLDS_OF_FEW, FEW_GROUPS = 4, 8, 60
"""Folds that are left out, and of up to so many groups."""
MANY_GROUPS = 600
"""Up to so many, noise and prior sizes are updated for every fold."""
EXACT_GROUPS = 200
"""Up to so many poses or positions, left-out rows are predicted by exact fits; other sensors always are."""

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
