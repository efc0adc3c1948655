"""Choose the final joint correction: the largest part of the selected correction that increases no held-out error."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.calibration.geometric.problem.noise import contributions_and_noise_of
from pisigma.calibration.geometric.result import SolvedCalibration
from pisigma.calibration.hybrid.design import Design, LinearisedRows, robust_weights
from pisigma.calibration.hybrid.refinement import (
    CONVERGENCE_TOLERANCE,
    MAX_LINEARISATIONS,
    RefinedFit,
    chunked_correction,
    correction_from_weights,
    linearise_rows,
    refine,
)
from pisigma.calibration.hybrid.regression import build_regression
from pisigma.calibration.hybrid.search import CLEAR_GAIN, ROUGH_TOLERANCE, FeatureChoice, FeatureFit
from pisigma.calibration.hybrid.sensor_values import SensorValues, sensor_values
from pisigma.estimation.held_out import sum_in_standard_errors
from pisigma.estimation.regression import Posterior
from pisigma.joint_correction.feature import AbstractFeature
from pisigma.measurement.groups import groups_of_equal_joints

_FOLDS, _FOLDS_OF_FEW, FEW_GROUPS = 4, 8, 60
"""Number of folds that are held out, number of folds for few groups, and number of groups up to which groups are
few."""
_MANY_GROUPS = 600
"""Number of groups up to which noise and prior scales are updated for every fold."""
EXACT_GROUPS = 200
"""Number of poses or positions up to which held-out rows are predicted by exact fits; rows of other sensors always
are."""

TOLERANCE = 1.005
"""Ratio of RMS errors above which errors are treated as larger; a smaller difference does not matter in practice."""
_REFITS = 10
"""Number of Gauss-Newton steps for unknowns that only held-out rows determine, such as the position of their socket."""


@dataclass(frozen=True, eq=False)
class SensorErrors:
    """Errors of the rows of a sensor, in the fit of all rows and in fits without them.

    Attributes:
        group: index of every row's group, see `Rows.group`.
        fitted_errors: lengths of the errors of all rows [m or rad], or in standard deviations if the rows state them.
        held_out_errors: lengths of the errors in fits without the row's fold; NaN for rows that were not held out.
        robust_weight: robust weight, 1 for full weight and 0 for rejected rows.
    """

    group: Int64[Tensor, " values"]
    fitted_errors: Float64[Tensor, " values"]
    held_out_errors: Float64[Tensor, " values"]
    robust_weight: Float64[Tensor, " values"]

    def compare(self, before: "SensorErrors") -> "Comparison":
        """Return the comparison with errors under another fit, for the rows that either fit uses."""
        weight = torch.maximum(self.robust_weight, before.robust_weight)
        judged = torch.isfinite(
            before.held_out_errors
        )  # a fit that predicts no value is worse than any other fit
        fitted = [(weight * one.fitted_errors.square()).sum() for one in (self, before)]
        squares = [(weight * one.held_out_errors.square())[judged] for one in (self, before)]
        gain = torch.zeros(int(self.group.max()) + 1 if len(self.group) else 0).to(weight)
        gain = gain.index_add(0, self.group[judged], squares[1] - squares[0])
        return Comparison(
            _ratio(fitted[0], fitted[1]),
            _ratio(squares[0].sum(), squares[1].sum()),
            sum_in_standard_errors(gain[torch.unique(self.group[judged])]),
        )


@dataclass(frozen=True)
class Comparison:
    """Ratios of the errors of a sensor under two fits.

    Attributes:
        fitted_ratio: ratio of the RMS errors of all rows.
        held_out_ratio: ratio of the RMS errors of held-out rows.
        gain_in_standard_errors: decrease of the held-out squares [standard errors], with independent groups.
    """

    fitted_ratio: float
    held_out_ratio: float
    gain_in_standard_errors: float

    @property
    def is_worse(self) -> bool:
        """Whether the errors of all rows or of held-out rows are larger."""
        return not (self.fitted_ratio <= TOLERANCE and self.held_out_ratio <= TOLERANCE)


def held_out_row_errors(
    design: Design,
    posterior: Posterior,
    group: Int64[Tensor, " rows"],
    folds: Sequence[Int64[Tensor, " _groups"]],
    noise_update_count: int = 0,
) -> tuple[SensorErrors | None, ...]:
    """Leave out every fold, and predict its rows with an exact fit to the other folds.

    The fit is linearised again until linearised and true residuals of its rows agree. Unknowns that only held-out
    rows determine are fitted to the held-out rows.

    Args:
        design: the unknowns.
        posterior: posterior from all rows.
        group: see `Rows.group`.
        folds: groups that are held out together.
        noise_update_count: number of updates of noise and prior scales for every fold.

    Returns:
        Errors per sensor; None for sensors whose values are given.
    """
    values = _values(design, posterior.x)
    weights = robust_weights(design.problem, values, posterior.effective_unknowns)
    rows = LinearisedRows.from_linearisation(design, posterior.x, values, weights, group)
    fit = build_regression(design, rows)
    held_out = [torch.full_like(one.weight_root, torch.nan) for one in values]
    for groups in folds:
        held = torch.isin(group, groups.to(group.device))
        others = torch.unique(group[~held])
        rest = fit.without_groups(groups).maximise_evidence(
            posterior.prior, posterior.noise, noise_update_count
        )
        here, x = rows, rest.x
        for _ in range(MAX_LINEARISATIONS):
            seen = _values(design, x)
            there = LinearisedRows.from_linearisation(design, x, seen, weights, group)
            differs = there.select_groups(others).squared_difference(
                here.select_groups(others), x, design, rest.noise
            )
            if not differs >= CONVERGENCE_TOLERANCE * rest.effective_unknowns:
                break
            rest = build_regression(design, there).without_groups(groups).solve(rest.prior, rest.noise)
            here, x = there, rest.x
        x = _with_own_unknowns(design, x, posterior.x, values, held)
        for errors, one in zip(held_out, _values(design, x), strict=True):
            chosen = held[one.row]
            errors[chosen] = (one.residual.norm(dim=1) * one.weight_root)[chosen]
    return tuple(
        None
        if one.are_values_given
        else SensorErrors(group[one.row], one.residual.norm(dim=1) * one.weight_root, *errors)
        for one, *errors in zip(values, held_out, weights, strict=True)
    )


def _values(design: Design, x: Float64[Tensor, " unknowns"]) -> tuple[SensorValues, ...]:
    """Return all rows linearised at given unknowns."""
    problem = design.problem
    point = problem.prior_mean.index_add(0, problem.active, x[: design.active_count])
    return sensor_values(
        problem, point, chunked_correction(correction_from_weights(design, x)) if design.features else None
    )


def _with_own_unknowns(
    design: Design,
    x: Float64[Tensor, " unknowns"],
    start: Float64[Tensor, " unknowns"],
    values: Sequence[SensorValues],
    held: Bool[Tensor, " rows"],
) -> Float64[Tensor, " unknowns"]:
    """Fit unknowns on which only held-out rows depend to these rows, starting with their values from all rows."""
    moving = torch.zeros(design.active_count, dtype=torch.bool, device=x.device)
    for one in values:
        if not one.are_values_given:
            moving |= (one.geometry_derivatives[~held[one.row]] != 0).flatten(0, 1).any(0)
    own = (~moving).nonzero()[:, 0]
    if not len(own):
        return x
    x = x.index_copy(0, own, start[own])
    for _ in range(_REFITS):
        blocks = []
        for one in _values(design, x):
            chosen = held[one.row] | one.are_values_given
            columns = one.geometry_derivatives[chosen][..., own] * one.weight_root[chosen][:, None, None]
            errors = one.residual[chosen] * one.weight_root[chosen][:, None]
            blocks.append((columns.flatten(0, 1), errors.flatten()))
        J, r = (torch.cat(parts) for parts in zip(*blocks, strict=True))
        step = torch.linalg.lstsq(J, r[:, None], driver="gelsd").solution[:, 0]
        x = x.index_add(0, own, step)
        if float((J @ step).norm()) <= 1e-9 * max(float(r.norm()), 1e-300):
            break
    return x


def _ratio(after: Tensor, before: Tensor) -> float:
    """Return the ratio of two root mean squares; 1 if both are 0."""
    return 1.0 if float(after) == float(before) == 0 else float((after / before).sqrt())


Errors = Sequence[SensorErrors | None]


@dataclass(frozen=True, eq=False)
class FinalCorrection:
    """The final joint correction, which reduces held-out errors.

    Attributes:
        choice: the choice, with the final features as its best.
        refined: the model fitted to the rows of the search.
        held_out_ratio: ratio of the held-out RMS errors with the correction and of the geometric calibration, for the
            sensor with the largest gain [1].
    """

    choice: FeatureChoice
    refined: RefinedFit
    held_out_ratio: float


def choose_final_correction(
    solved: SolvedCalibration, choice: FeatureChoice, progress: Callable[[str], None]
) -> FinalCorrection | None:
    """Return the largest part of the selected features that increases no sensor's errors, by exact fits of every part.

    Held-out errors computed by linearisation equal those of an exact fit only if the linearisation is accurate,
    which is the case for many poses or positions. For few poses or positions, or for other sensors, the rows of the
    search are held out again, fold by fold, from exact fits with and without the correction. A part is accepted if
    it increases the errors and held-out errors of no sensor, and clearly reduces the held-out errors of one.

    Returns:
        The accepted part; None if the geometric calibration is to be kept.
    """
    problem = choice.rows.problem
    # The search leaves out whole anchors and sockets; exact fits to the few remaining ones may be undetermined.
    group = choice.rows.group if problem.pair_count else groups_of_equal_joints(problem.q)
    count = int(group.max()) + 1
    if count > EXACT_GROUPS and set(solved.setup.measurements.kinds) <= {"position", "rotation"}:
        return FinalCorrection(
            choice, refine(problem, choice.rows.group, choice), _held_out_in_search(choice)
        )
    folds = replace(choice.rows, group=group).folds(_FOLDS if count > FEW_GROUPS else _FOLDS_OF_FEW, count)
    updates = int(count <= _MANY_GROUPS)
    before = held_out_row_errors(
        Design(problem, ()), _geometric_posterior(solved, choice), group, folds, updates
    )
    for part in _parts(choice):
        progress(f"held-out rows, {part.best.name}")
        refined = refine(problem, choice.rows.group, part)
        errors = held_out_row_errors(refined.design, refined.posterior, group, folds, updates)
        compared = _compared(errors, before)
        if not any(one.is_worse for one in compared) and any(
            one.gain_in_standard_errors > CLEAR_GAIN for one in compared
        ):
            return FinalCorrection(part, refined, min(one.held_out_ratio for one in compared))
    return None


def _held_out_in_search(choice: FeatureChoice) -> float:
    """Return the ratio of held-out errors that the search computed with linearised rows."""
    return [trial.held_out_ratio for trial in choice.trials if trial.is_best_so_far][-1]


def _compared(errors: Errors, before: Errors) -> list[Comparison]:
    """Return a comparison of the errors for every sensor with measured values."""
    pairs = zip(errors, before, strict=True)
    return [one.compare(other) for one, other in pairs if one is not None and other is not None]


def _geometric_posterior(solved: SolvedCalibration, choice: FeatureChoice) -> Posterior:
    """Return the posterior of the geometric calibration given the rows of the search."""
    problem, group = choice.rows.problem, choice.rows.group
    design, view = Design(problem, ()), contributions_and_noise_of(solved.solution.linearisation)
    x = (solved.solution.linearisation.point - problem.prior_mean)[problem.active]
    rows = linearise_rows(design, x, choice.fit_without_features.posterior.effective_unknowns, group)
    prior = design.prior(view.prior_scale.tolist())
    return build_regression(design, rows).solve(prior, tuple(view.noise.tolist()))


def _parts(choice: FeatureChoice) -> Iterator[FeatureChoice]:
    """Yield the selected features, then always one feature fewer, removing the feature that was tried last."""
    yield choice
    features = choice.best.design.features
    for count in range(len(features) - 1, 0, -1):
        yield _part(choice, features[:count])


def _part(choice: FeatureChoice, features: tuple[AbstractFeature, ...]) -> FeatureChoice:
    """Return the choice with a subset of its features as the best fit."""
    best, design = choice.best, Design(choice.rows.problem, features)
    fit = (choice.regression or build_regression(best.design, choice.rows)).select(design)
    prior = design.prior_with_scales_of(best.design, best.posterior.prior)
    posterior = fit.maximise_evidence(prior, best.posterior.noise, tolerance=ROUGH_TOLERANCE)
    return replace(choice, best=FeatureFit(design, posterior, best.max_effective_share), regression=fit)
