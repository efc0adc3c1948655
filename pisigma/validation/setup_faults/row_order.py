"""Motions of a frame or a tool while the rows were measured, found from the residuals in the order of the rows."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float64, Int64
from numpy.polynomial.legendre import legvander

from pisigma.calibration.geometric.result import CalibrationResult
from pisigma.calibration.hybrid.result import HybridResult
from pisigma.estimation.loss import HampelLoss
from pisigma.validation.setup_faults.ordered_rows import OrderedRows, inverse_of

_MIN_ROWS = 3
"""Smallest number of rows before and after a motion."""
_MAX_USED = 0.8
"""Largest share of the values that parameters and motions may absorb; above it, the fit follows the noise."""
DEGREES = (1, 3, 6)
"""Degrees of the polynomials of slow motions, as functions of the share of the rows measured so far."""
_AS_LIKELY = 0.5
"""Share of the largest log Bayes factor above which a motion at the start of a frame explains the residuals as well."""
MAX_ITERATIONS = 6
"""Largest number of iterations of the reweighting."""
_CONVERGENCE_TOLERANCE = 1e-2
"""Largest change of the weights, and relative change of the noise, at convergence."""
_LOSS = HampelLoss()
_Moved = Literal["frame", "target", "tool"]


@dataclass(frozen=True, eq=False)
class Motion:
    """A rigid motion of a frame or of a tool while the rows were measured.

    Attributes:
        kind: "frame", "target" (one of several on the tool) or "tool".
        name: name of the frame or the target.
        row_indices: indices of the rows of the frame or target in the measurements, in the order of the file.
        first_moved_index: index in `row_indices` of the first row after the motion; None for a slow motion.
        shift: mean shift of the measured points [m], in their frame, or for a tool in the flange frame; for a slow
            motion the largest shift since the first row.
        turn: rotation angle of the frame or tool [rad]; for a slow motion the largest angle since the first row.
        log_bayes_factor: logarithm of the odds of the motion against no motion, at equal prior odds.
        error_increase_factor: ratio of the errors of the rows without and with the motion in the model [1].
        is_at_frame_start: whether a target or the tool moved exactly where rows of another frame start.
    """

    kind: _Moved
    name: str
    row_indices: Int64[np.ndarray, " rows"]
    first_moved_index: int | None
    shift: Float64[np.ndarray, " 3"]
    turn: float
    log_bayes_factor: float
    error_increase_factor: float
    is_at_frame_start: bool = False


def find_motion(result: CalibrationResult | HybridResult) -> Motion | None:
    """Find the motion of frame or tool that best explains the residuals of a calibration, even if it is unlikely.

    A frame or a tool that moves before row k shifts the values of the rows from k by `Z_i m` with six unknowns m. The
    model of the residuals r is linear in m and in x, the parameters of the calibration and the weights of a short
    series of the joint values: `r = X x + Z_k m + e`. The explained sum of squares has a closed form for every k, from
    sums over the later rows, for which large residuals are clipped. The best k is then fitted by iteratively reweighted
    least squares. Slow motions `Σ P_d(t) m_d`, polynomials of the share t of the rows measured so far, are fitted in
    the same way.

    The Bayes factor is for Zellner's g-prior of m with unit information (Liang et al. 2008, JASA 103, 410-423,
    eq. 6), divided by the number of rows k that were tried. Residuals of successive rows are correlated, because the
    geometry does not explain everything and rows were measured along a path or repeat a pose. Therefore the number of
    values is divided by the sum of the autocorrelations (Geyer 1992, Statistical Science 7, 473-483) or by the design
    effect of repeated poses (Kish 1965), whichever is larger, and by the ratio of values to effective principal
    components of a row's residuals, `values · tr(C²) / tr(C)²` with their covariance C.

    Returns:
        The motion; None if no position or orientation was measured, or if there are too few rows.
    """
    rows = OrderedRows.from_result(result)
    return None if rows is None else _motion_of(rows)


# the same rows are checked when they are added to a cell and when they are used in a calibration
@lru_cache(maxsize=2)
def _motion_of(rows: OrderedRows) -> Motion | None:
    search = _Search(rows)
    fits = [search.fit(candidate) for candidate in search.candidates()]
    # Candidates are compared as if all values were independent: the residuals of a wrong candidate are correlated.
    odds = [search.log_bayes_factor(fit, 1.0) for fit in fits]
    if not fits:
        return None
    best = int(np.argmax(odds))
    motion, chosen = search.motion(fits[best]), fits[best].candidate
    starts = search.frame_starts(chosen)
    alike = (
        search.log_bayes_factor(search.reweighted_fit(one), 1.0) > _AS_LIKELY * odds[best] for one in starts
    )
    return replace(motion, is_at_frame_start=any(alike))


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A motion that is tried.

    Attributes:
        moved: see `Motion`.
        number: index of the frame or the target.
        index: indices of the rows of the frame or target, in the order of the file.
        full: derivative of the values of these rows with respect to the motion.
        course: share of every motion completed at each row: 0 or 1 for a sudden motion.
        first: see `Motion`.
    """

    moved: _Moved
    number: int
    index: Int64[np.ndarray, " own"]
    full: Float64[np.ndarray, "own values motion"]
    course: Float64[np.ndarray, "own courses"]
    first: int | None = None

    @cached_property
    def columns(self) -> Float64[np.ndarray, "own values motions"]:
        """Derivative of the rows' values with respect to all its motions."""
        return np.concatenate([self.full * course[:, None, None] for course in self.course.T], 2)

    @property
    def candidates_tried(self) -> int:
        """Number of candidates from which this one was chosen."""
        return 1 if self.first is None else len(self.index) - 2 * _MIN_ROWS

    def from_row(self, first: int) -> "_Candidate":
        """Return the candidate with a sudden motion before a row."""
        return replace(self, first=first, course=(np.arange(len(self.index)) >= first)[:, None] * 1.0)


@dataclass(frozen=True, eq=False)
class _Fit:
    """Robust fit of a candidate together with the parameters of the calibration.

    Attributes:
        candidate: the candidate.
        motion: its estimated motions.
        after: remaining residuals.
        scale: standard deviation of one residual, per sensor.
        effective_unknowns: effective number of unknowns, including the motions.
    """

    candidate: _Candidate
    motion: Float64[np.ndarray, " motions"]
    after: Float64[np.ndarray, "rows values"]
    scale: tuple[float, ...]
    effective_unknowns: float

    @property
    def shifts(self) -> Float64[np.ndarray, "own values"]:
        """Changes of the rows' values due to the motion."""
        shifts: np.ndarray = self.candidate.columns @ self.motion
        return shifts

    @property
    def weights(self) -> Float64[np.ndarray, "rows values"]:
        """Weight of every value."""
        return _by_sensor(self.after, self.scale, _LOSS.weight)

    def robust_costs(self, residual: Float64[np.ndarray, "rows values"]) -> Float64[np.ndarray, " rows"]:
        """Compute the robust cost of every row for given residuals."""
        cost: np.ndarray = _by_sensor(residual, self.scale, _LOSS.cost).sum(1) / 3
        return cost


@dataclass(frozen=True, eq=False)
class _Search:
    """Search that fits motions to the residuals of a calibration.

    Attributes:
        rows: the residuals.
    """

    rows: OrderedRows

    def candidates(self) -> Iterator[_Candidate]:
        """Yield everything that may have moved, suddenly at the best row or slowly."""
        for candidate in self._rigid():
            count = len(candidate.index)
            if count > 2 * _MIN_ROWS:
                yield candidate.from_row(self._best_step(self.rows.clipped_residual, candidate))
                time = (2 * np.arange(count) + 1) / count - 1
                for degree in DEGREES:
                    # A constant motion is one of base or tool, which the calibration fits.
                    yield replace(candidate, course=legvander(time, degree)[:, 1:])

    def frame_starts(self, candidate: _Candidate) -> Iterator[_Candidate]:
        """Yield sudden motions of the same target or tool where rows of another frame start."""
        frame = self.rows.problem.frame.cpu().numpy()[candidate.index]
        changes = np.flatnonzero(np.diff(frame)) + 1
        if candidate.moved != "frame" and len(changes) < len(self.rows.problem.space.frames):
            yield from (candidate.from_row(int(first)) for first in changes)

    def _rigid(self) -> Iterator[_Candidate]:
        """Yield whatever may have moved rigidly: frames, single targets (if there are several), and the tool."""
        space = self.rows.problem.space
        tool: _Moved = "target" if len(space.targets) > 1 else "tool"
        kinds: tuple[tuple[_Moved, Literal["frame", "target"]], ...] = (("frame", "frame"), (tool, "target"))
        for moved, kind in kinds:
            group, Z = self.rows.motion_derivative(kind)
            for number in range(int(group.max()) + 1):
                index = np.flatnonzero(group == number)
                yield _Candidate(moved, number, index, Z[index], np.ones((len(index), 1)))
        if len(space.targets) > 1:
            point = self.rows.result.solved.refined_linearisation.point
            arms = space.split(point)[2][:, :3].cpu().numpy()[group]
            lever = np.cross(np.eye(3)[:, None], arms)  # e_k × p, (3, rows, 3)
            turned = np.einsum("nvx,knx->nvk", Z[:, :, :3], lever)
            both = np.concatenate([Z[:, :, :3], turned], 2)
            yield _Candidate("tool", 0, np.arange(len(group)), both, np.ones((len(group), 1)))

    def _best_step(self, residual: Float64[np.ndarray, "rows values"], candidate: _Candidate) -> int:
        """Find the row of the sudden motion that explains most of the residuals, in closed form for all rows."""
        index, Z, X = candidate.index, candidate.full, self.rows.jacobian[candidate.index]

        def sum_of_later_rows(terms: np.ndarray) -> np.ndarray:
            """Return the sum over every row and all later rows."""
            sums: np.ndarray = terms[::-1].cumsum(0)[::-1]
            return sums

        # Frisch-Waugh: eliminating x leaves `information · m = gain` for every row, with x's covariance in between.
        ZX, ZZ = (
            sum_of_later_rows(np.einsum("nvm,nva->nma", Z, X)),
            sum_of_later_rows(np.einsum("nvm,nvk->nmk", Z, Z)),
        )
        pull = np.einsum("nva,nv->a", self.rows.jacobian, residual)
        gain = (
            sum_of_later_rows(np.einsum("nvm,nv->nm", Z, residual[index])) - ZX @ self.rows.covariance @ pull
        )
        scale = 1 / np.sqrt(np.maximum(ZZ[0].diagonal(), 1e-300))
        information = (ZZ - ZX @ self.rows.covariance @ ZX.transpose(0, 2, 1)) * scale * scale[:, None]
        solution = np.linalg.solve(information + 1e-6 * np.eye(len(scale)), (scale * gain)[..., None])
        explained = (scale * gain * solution[..., 0]).sum(1)
        return _MIN_ROWS + int(explained[_MIN_ROWS : len(index) - _MIN_ROWS].argmax())

    def fit(self, candidate: _Candidate) -> _Fit:
        """Fit a candidate together with the parameters; the row of a sudden motion is then searched once more."""
        fit = self.reweighted_fit(candidate)
        if candidate.first is None:
            return fit
        still = fit.after.copy()
        still[candidate.index] += fit.shifts
        moved = still.copy()
        size = candidate.full.shape[2]
        moved[candidate.index] -= candidate.full @ fit.motion[:size]
        gain = (fit.robust_costs(still) - fit.robust_costs(moved))[candidate.index][::-1].cumsum()[::-1]
        first = _MIN_ROWS + int(gain[_MIN_ROWS : len(gain) - _MIN_ROWS].argmax())
        return fit if first == candidate.first else self.reweighted_fit(candidate.from_row(first))

    @cached_property
    def fit_without_motion(self) -> _Fit:
        """The fit without a motion."""
        nothing = np.zeros((len(self.rows.residual), self.rows.residual.shape[1], 0))
        index = np.arange(len(self.rows.residual))
        return self.reweighted_fit(_Candidate("frame", 0, index, nothing, np.zeros((len(index), 1))))

    def reweighted_fit(self, candidate: _Candidate) -> _Fit:
        """Fit a candidate by iteratively reweighted least squares, starting with full weights."""
        size, motions = self.rows.jacobian.shape[2], candidate.columns.shape[2]
        A = np.concatenate([self.rows.jacobian, np.zeros((*self.rows.jacobian.shape[:2], motions))], 2)
        A[candidate.index, :, size:] = candidate.columns
        A = A.reshape(-1, size + motions)
        held = np.diag(np.concatenate([self.rows.prior_precision, np.zeros(motions)]))
        # Fitted residuals are too small by the root of the share of values that the parameters leave free.
        left = max(1 - (self.rows.effective_parameters + motions) / self.rows.value_count, 1e-2)
        weight, scale = np.ones_like(self.rows.residual), np.ones(self.rows.residual.shape[1] // 3)
        for _ in range(MAX_ITERATIONS):
            weighted = A * (weight / np.repeat(scale, 3) ** 2).reshape(-1, 1)
            normal = weighted.T @ A
            covariance = inverse_of(normal + held)
            x = covariance @ (weighted.T @ self.rows.residual.ravel())
            after = self.rows.residual - (A @ x).reshape(self.rows.residual.shape)
            old, scale = scale, np.array([_scale(part) for part in _sensors(after)]) / left**0.5
            effective = float(np.einsum("ij,ji->", covariance, normal))
            fit = _Fit(candidate, x[size:], after, tuple(scale.tolist()), effective)
            before, weight = weight, fit.weights
            changes = np.abs(weight - before).max(), np.abs(scale / old - 1).max()
            if max(changes) < _CONVERGENCE_TOLERANCE:
                break
        return fit

    def log_bayes_factor(self, fit: _Fit, values_per_independent: float) -> float:
        """Compute the log odds of a candidate against no motion.

        If motions and parameters absorb nearly all values, nothing can contradict them, so the odds are 0.

        Args:
            fit: fit of the candidate.
            values_per_independent: number of values per independent value.
        """
        if fit.effective_unknowns > _MAX_USED * self.rows.value_count:
            return -math.inf
        # Correlated values and repeats contain no more information than one pose per configuration.
        values = max(
            min(
                (self.rows.value_count - self.rows.effective_parameters) / values_per_independent,
                self.rows.degrees_of_freedom,
            ),
            1.0,
        )
        # Without a motion, at the candidate's scale: residuals of the calibration or of a refit, if this costs less.
        before = min(
            float(fit.robust_costs(residual).sum())
            for residual in (self.rows.residual, self.fit_without_motion.after)
        )
        left = float(fit.robust_costs(fit.after).sum()) / max(before, 1e-300)
        # Liang et al. 2008, eq. 6, with g = values and left = 1 - R².
        gain = (values - len(fit.motion)) * math.log1p(values) - values * math.log1p(values * min(left, 1.0))
        return gain / 2 - math.log(fit.candidate.candidates_tried)

    def values_per_independent(self, fit: _Fit) -> float:
        """Estimate the number of values per independent value from the correlation of the residuals."""
        left = fit.after * np.sqrt(fit.weights)
        own = left[fit.candidate.index]
        total = max(float((own**2).sum()), 1e-150)
        together: float = own.shape[1] * float(np.square(own.T @ own).sum()) / total**2
        alike = 1.0
        # Geyer's initial positive sequence: sums of two successive autocorrelations, up to the first negative one.
        for lag in range(1, len(own) // 2, 2):
            two = sum(float((own[near:] * own[:-near]).sum()) for near in (lag, lag + 1)) / total
            if two < 0:
                break
            alike += 2 * two
        repeated, configuration = 1.0, self.rows.configuration_index
        if configuration is not None:
            count = np.bincount(configuration)
            means = np.stack([np.bincount(configuration, column) for column in left.T]) ** 2 / count
            repeated = float(means.sum()) / len(count) / float(np.square(left).sum()) * len(left)
        return together * float(max(alike, repeated, 1.0))

    def motion(self, fit: _Fit) -> Motion:
        """Return the motion of a fit, in metres and radians."""
        candidate = fit.candidate
        weight = fit.weights[candidate.index]
        left = (weight * fit.after[candidate.index] ** 2).sum(0) / np.maximum(weight.sum(0), 1e-300)
        # Base and tool absorb the mean shift in a fit without the motion, so only its variance adds to the errors.
        parts = zip(_sensors(fit.shifts.var(0)[None]), _sensors(left[None]), strict=True)
        factor = max(math.sqrt(1 + added.sum() / max(rest.sum(), 1e-300)) for added, rest in parts)
        course = candidate.course - candidate.course[0]
        whole = course @ fit.motion.reshape(-1, candidate.full.shape[2])  # motion up to every row
        largest = whole[np.linalg.norm(candidate.full[:, :3] @ whole[..., None], axis=(1, 2)).argmax()]
        shift, turn = largest[:3], largest[:2:-1]  # rotations about x, y, z, stored as roll, pitch, yaw
        names = self.rows.problem.space.targets
        if candidate.moved == "frame":
            names = self.rows.problem.space.frames
            anchor = self.rows.result.solved.setup.reference_frames.bases[candidate.number].cpu().numpy()
            center = self._center(self.rows.row_index[candidate.index[candidate.first or 0 :]])
            # The base rotates about its anchor, so the shift of the measured points is that of their centre.
            lever = anchor[:3, :3].T @ (center - anchor[:3, 3])
            shift = anchor[:3, :3] @ (shift + np.cross(turn, lever))
        return Motion(
            candidate.moved,
            names[candidate.number],
            self.rows.row_index[candidate.index],
            candidate.first,
            shift,
            float(np.linalg.norm(turn)),
            self.log_bayes_factor(fit, self.values_per_independent(fit)),
            factor,
        )

    def _center(self, rows: Int64[np.ndarray, " chosen"]) -> Float64[np.ndarray, " 3"]:
        """Return the mean measured position of rows [m]; 0 if no position was measured."""
        position = self.rows.result.solved.measurements.position
        if position is None:
            return np.zeros(3)
        center: np.ndarray = np.nan_to_num(position[rows].nanmean(0).cpu().numpy())
        return center


def _sensors(values: Float64[np.ndarray, "rows values"]) -> Sequence[Float64[np.ndarray, "rows 3"]]:
    """Return the values of every sensor."""
    return np.split(values, values.shape[1] // 3, 1)


def _scale(residual: Float64[np.ndarray, "rows 3"]) -> float:
    """Estimate the standard deviation of one value from the median of the measured rows."""
    lengths = np.linalg.norm(residual, axis=1)
    if not lengths.any():
        return 1.0
    return max(float(_LOSS.scale(torch.from_numpy(lengths[lengths > 0]), 3, 0.0)), 1e-6)


def _by_sensor(
    values: Float64[np.ndarray, "rows values"],
    scale: Sequence[float],
    function: Callable[[torch.Tensor, int], torch.Tensor],
) -> Float64[np.ndarray, "rows values"]:
    """Apply a function to the scaled length of every sensor's values, and repeat the result for its components."""
    lengths = [np.linalg.norm(part, axis=1) / one for part, one in zip(_sensors(values), scale, strict=True)]
    return np.repeat(np.stack([function(torch.from_numpy(one), 3).numpy() for one in lengths], 1), 3, axis=1)
