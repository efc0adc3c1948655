"""Mixtures of two populations of rows in one calibration: two arms, tools or frames, or two sizes of errors."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float64, Int64

from pisigma.validation.setup_faults.ordered_rows import OrderedRows, inverse_of

MIN_ROWS = 20
"""Minimum number of rows; with fewer, two arms cannot be distinguished."""
_MAX_ROWS = 300
"""Largest number of rows to which the populations are fitted, spread evenly over all rows."""
MIN_SHARE = 0.1
"""Smallest share of a population; smaller groups are outliers, to which the robust loss gives no weight."""
_TAILS = 5.0
"""Degrees of freedom of the t distribution of the residuals, so that outliers do not become a population."""
_MAX_USED = 0.9
"""Largest share of the values absorbed by parameters, relative to the share at which the likelihood is unbounded."""
_STARTS, _FIRST_ITERATIONS, MAX_ITERATIONS = 8, 6, 40
"""Number of starts of the expectation maximisation, their iterations, and iterations from the best start."""
_CONVERGENCE_TOLERANCE = 1e-2
"""Largest change of the probabilities, and relative change of the variance, at convergence."""
_ALTERNATING = 0.95
"""Share of the rows that must alternate; both populations may predict 1 in 20 equally well."""
_DIFFERENCE = 2.0
"""Ratio of the variance of the difference between two arms to that between an arm and the nominal arm."""
_APART = 4.0
"""Ratio of the distance of one population to the scatter of the other above which they are separate. Residuals of
healthy robots form a mixture with ratios of up to 2.5, because the unexplained errors depend on the pose."""
_NORMAL_ITERATIONS = 200
_FLOOR = 1e-6
"""Smallest standard deviation, as a share of the largest residual."""
_Differing = Literal["arm", "frame", "tool"]


@dataclass(frozen=True, eq=False)
class Populations:
    """Two populations of rows.

    Attributes:
        differing_part: what differs between the populations: base, tool or arm.
        in_smaller_population: mask of the measured rows that belong to the smaller population.
        evaluated_rows: number of rows that were evaluated.
        difference: difference of the base, tool or arm parameters of the populations [m or rad].
        error_increase_factor: ratio of the errors of the rows without and with the difference [1].
        absorbed_share: share of the values that all fitted parameters absorb [1].
        log_bayes_factor: logarithm of the odds against one population, by the Bayesian information criterion (Schwarz
            1978, Annals of Statistics 6, 461-464).
    """

    differing_part: _Differing
    in_smaller_population: Bool[np.ndarray, " rows"]
    evaluated_rows: int
    difference: Float64[np.ndarray, " numbers"]
    error_increase_factor: float
    absorbed_share: float
    log_bayes_factor: float


# cached, because the same rows are checked when they are added to a cell and in its calibration
@lru_cache(maxsize=2)
def find_populations(rows: OrderedRows, row_count: int) -> Populations | None:
    """Find the two populations that best explain the residuals of a calibration, whether they are likely or not.

    `r_i = X_i x + w_i Z_i m + e_i`: a row of the second population (w_i = 1) has the difference m in addition to the
    unknowns x of all rows. The probabilities of w_i, x, m and the variance of e_i are estimated by expectation
    maximisation (Dempster, Laird and Rubin 1977, JRSS B 39, 1-38) with t-distributed errors. The differences tried are
    those of the tool, of the frame, and of arm, base and tool together.

    Args:
        rows: residuals of a calibration.
        row_count: number of rows of the measurements.

    Returns:
        The populations; None if there are too few rows.
    """
    if len(rows.residual) < MIN_ROWS:
        return None
    index = np.unique(np.linspace(0, len(rows.residual) - 1, _MAX_ROWS).round().astype(int))
    some = index if len(rows.residual) > _MAX_ROWS else np.arange(len(rows.residual))
    independent = rows.degrees_of_freedom / max(rows.value_count - rows.effective_parameters, 1.0)
    found, one = [], _one_population(rows, some)
    for differing, Z, precision in _differences(rows):
        fit = _Mixture(rows, Z, precision).fit_from_starts(some, one)
        if fit.used > _most_used(rows.residual.shape[1]) * fit.values:
            continue
        second = np.zeros(row_count, dtype=bool)
        second[rows.row_index] = _alternating(fit.probability > 0.5)
        if second.sum() > len(rows.row_index) / 2:
            second[rows.row_index] = ~second[rows.row_index]
        found.append(
            Populations(
                differing,
                second,
                len(rows.row_index),
                fit.difference,
                fit.factor,
                fit.used / fit.values,
                fit.gain(independent),
            )
        )
    return max(found, key=lambda one: one.log_bayes_factor, default=None)


def _most_used(components: int) -> float:
    """Return the largest share of the values that the unknowns of two populations may absorb.

    If a fit passes through a share u of the rows exactly, the variance of the errors can go to 0. For rows with c
    components, the likelihood of the t distribution is then unbounded if c > (1 - u)(TAILS + c), that is
    u > TAILS/(TAILS + c): 5/8 for positions, 5/11 for poses.

    Args:
        components: number of components of the residual of a row.
    """
    return _MAX_USED * _TAILS / (_TAILS + components)


def _alternating(second: Bool[np.ndarray, " rows"]) -> Bool[np.ndarray, " rows"]:
    """Make nearly alternating rows alternate exactly, because rows that fit both populations may be in either."""
    odd: np.ndarray = np.arange(len(second)) % 2 == 1
    for turn in (odd, ~odd):
        if np.mean(second == turn) > _ALTERNATING:
            return turn
    return second


def _differences(
    rows: OrderedRows,
) -> Iterator[tuple[_Differing, Float64[np.ndarray, "rows values numbers"], Float64[np.ndarray, " numbers"]]]:
    """Yield derivatives with respect to all possible differences, with the prior precision of each."""
    kinds: tuple[tuple[_Differing, Literal["frame", "target"]], ...] = (
        ("tool", "target"),
        ("frame", "frame"),
    )
    for differing, kind in kinds:
        Z = rows.motion_derivative(kind)[1]
        yield differing, Z, np.zeros(Z.shape[2])
    active = len(rows.problem.active)
    yield "arm", rows.jacobian[:, :, :active], rows.prior_precision[:active] / _DIFFERENCE


@dataclass(frozen=True, eq=False)
class _Fit:
    """Result of fitting two populations.

    Attributes:
        probability: probability that a row belongs to the second population.
        difference: difference of the two populations.
        factor: ratio of the errors without and with the difference, see `Populations`.
        log_likelihood: log likelihood with the difference, and without it.
        used: effective number of unknowns.
        unknowns: effective number of unknowns of the difference.
        values: number of values.
    """

    probability: Float64[np.ndarray, " rows"]
    difference: Float64[np.ndarray, " numbers"]
    factor: float
    log_likelihood: tuple[float, float]
    used: float
    unknowns: float
    values: int

    def gain(self, independent: float) -> float:
        """Compute the log Bayes factor if only a share of the values is independent."""
        values = max(independent * self.values, 2.0)
        gain = (self.log_likelihood[0] - self.log_likelihood[1]) * independent
        return gain - (self.unknowns + 1) / 2 * math.log(values)


@dataclass(frozen=True, eq=False)
class _Mixture:
    """Mixture of two populations that differ in given unknowns."""

    rows: OrderedRows
    Z: Float64[np.ndarray, "rows values numbers"]
    precision: Float64[np.ndarray, " numbers"]

    def fit_from_starts(self, some: Int64[np.ndarray, " some"], one: "_State") -> _Fit:
        """Fit the mixture to some rows from several starts, and assign all rows to a population.

        Args:
            some: indices of the rows.
            one: fit of one population.
        """
        r, X, Z = self.rows.residual[some], self.rows.jacobian[some], self.Z[some]
        rng = np.random.default_rng(0)
        # Expectation maximisation finds local maxima, so it is started with alternating rows (two arms in turn) and at
        # random.
        starts = [np.arange(len(some)) % 2 * 0.8 + 0.1, *rng.uniform(0, 1, (_STARTS - 1, len(some)))]
        em = _Em(r, X, Z, np.r_[self.rows.prior_precision, self.precision])
        states = [em.run(em.start(start), _FIRST_ITERATIONS) for start in starts]
        state = em.run(max(states, key=lambda state: state.log_likelihood), MAX_ITERATIONS)
        difference = state.x[X.shape[2] :]
        # A difference present in a share p of the rows has the variance p (1 - p) times its square; the variance of a t
        # distribution is its squared scale times TAILS / (TAILS - 2).
        made = float(np.square(Z @ difference).mean()) * state.share * (1 - state.share)
        left = state.variance * r.size / max(r.size - state.used, 1.0) * _TAILS / (_TAILS - 2)
        every = _Em(self.rows.residual, self.rows.jacobian, self.Z, em.precision)
        return _Fit(
            probability=every.probabilities(every.squared_residuals(state.x), state.share, state.variance)[0],
            difference=difference,
            factor=(1 + made / left) ** 0.5,
            log_likelihood=(state.log_likelihood, one.log_likelihood),
            used=state.used,
            unknowns=state.used - one.used,
            values=r.size,
        )


@dataclass(frozen=True, eq=False)
class _State:
    """State of the expectation maximisation after an iteration."""

    probability: Float64[np.ndarray, " rows"]
    weights: Float64[np.ndarray, "2 rows"]
    x: Float64[np.ndarray, " unknowns"]
    share: float
    variance: float
    used: float
    log_likelihood: float


@dataclass(frozen=True, eq=False)
class _Em:
    """Expectation maximisation for rows `r = X x + w Z m + e` with t-distributed errors e."""

    r: Float64[np.ndarray, "rows values"]
    X: Float64[np.ndarray, "rows values common"]
    Z: Float64[np.ndarray, "rows values numbers"]
    precision: Float64[np.ndarray, " unknowns"]

    def start(self, probability: Float64[np.ndarray, " rows"]) -> _State:
        """Return the initial state for given probabilities of the second population."""
        variance = float(np.square(self.r).mean())
        ones = np.ones((2, len(self.r)))
        return _State(probability, ones, np.zeros(len(self.precision)), 0.5, variance, 0.0, -np.inf)

    def run(self, state: _State, iterations: int) -> _State:
        """Iterate until convergence, or for a number of iterations."""
        for _ in range(iterations):
            before = state
            state = self._step(state)
            change = np.abs(state.probability - before.probability).max(initial=0.0)
            if (
                change < _CONVERGENCE_TOLERANCE
                and abs(state.variance / before.variance - 1) < _CONVERGENCE_TOLERANCE
            ):
                break
        return state

    def _step(self, state: _State) -> _State:
        """Solve for the unknowns with the current probabilities (M step), and update these (E step)."""
        second = state.probability * state.weights[1]
        total = (1 - state.probability) * state.weights[0] + second
        rows, values, common = self.X.shape
        X, Z = self.X.reshape(-1, common), self.Z.reshape(rows * values, -1)
        wX, wZ = X * np.repeat(total, values)[:, None], Z * np.repeat(second, values)[:, None]
        mixed, flat = wX.T @ Z if not Z.shape[1] else X.T @ wZ, self.r.ravel()
        data = np.block([[wX.T @ X, mixed], [mixed.T, wZ.T @ Z]])
        # The data are not divided by the variance, so the precision of the prior is multiplied by it.
        normal = data + np.diag(self.precision * state.variance)
        inverse = inverse_of(normal)
        x = inverse @ np.concatenate([wX.T @ flat, wZ.T @ flat])
        used = float(np.einsum("ij,ji->", inverse, data))
        squares = self.squared_residuals(x)
        probability = np.stack([1 - state.probability, state.probability])
        variance = max(float((probability * state.weights * squares).sum()) / self.r.size, 1e-12)
        share = float(np.clip(state.probability.mean(), 1e-3, 1 - 1e-3))
        fresh, log_likelihood = self.probabilities(squares, share, variance)
        # Expected weight of a row under the t distribution: outliers have less.
        weights = (_TAILS + values) / (_TAILS + squares / variance)
        return _State(fresh, weights, x, share, variance, used, log_likelihood)

    def squared_residuals(self, x: Float64[np.ndarray, " unknowns"]) -> Float64[np.ndarray, "2 rows"]:
        """Compute the squared residuals of every row under either population."""
        common = self.X.shape[2]
        left = self.r - self.X @ x[:common]
        return np.stack([np.square(left).sum(1), np.square(left - self.Z @ x[common:]).sum(1)])

    def probabilities(
        self, squares: Float64[np.ndarray, "2 rows"], share: float, variance: float
    ) -> tuple[Float64[np.ndarray, " rows"], float]:
        """Compute the probability that a row belongs to the second population, and the log likelihood of all rows."""
        values = self.r.shape[1]
        logs = -(_TAILS + values) / 2 * np.log1p(squares / variance / _TAILS)
        if not self.Z.shape[2]:
            return np.zeros(len(self.r)), float(logs[0].sum()) - self.r.size / 2 * math.log(variance)
        logs = logs + np.log([1 - share, share])[:, None]
        odds = (logs[0] - logs[1]).clip(-500, 500)
        return 1 / (1 + np.exp(odds)), float(np.logaddexp(*logs).sum()) - self.r.size / 2 * math.log(variance)


def _one_population(rows: OrderedRows, some: Int64[np.ndarray, " some"]) -> _State:
    """Fit one population to some rows, with the errors and the prior of a mixture, which has to outperform it."""
    X = rows.jacobian[some]
    alone = _Em(rows.residual[some], X, X[:, :, :0], rows.prior_precision)
    return alone.run(alone.start(np.zeros(len(some))), MAX_ITERATIONS)


@dataclass(frozen=True)
class Mixture:
    """Mixture of two normal populations of residuals.

    Attributes:
        population_share: share of the population with the larger scatter, or of the smaller population if both scatter
            equally [1].
        offset: RMS distance of that population from the mean of the other, per component [m or rad].
        scatter: RMS distance of the other population from its mean, per component [m or rad].
        log_bayes_factor: logarithm of the odds against one population, by the Bayesian information criterion (Schwarz
            1978, Annals of Statistics 6, 461-464).
    """

    population_share: float
    offset: float
    scatter: float
    log_bayes_factor: float

    @property
    def are_distinct(self) -> bool:
        """Whether there are two populations, not one with an unusual shape."""
        return (
            self.log_bayes_factor > math.log(100.0)
            and min(self.population_share, 1 - self.population_share) >= MIN_SHARE
            and self.offset > _APART * self.scatter
        )


def two_populations(residuals: Float64[np.ndarray, "rows components"]) -> Mixture:
    """Fit a mixture of two normal populations by expectation maximisation.

    Args:
        residuals: residuals of one sensor [m or rad].
    """
    rows, components = residuals.shape
    centred = residuals - residuals.mean(0)
    # Without a floor the likelihood is unbounded: a population could shrink to one row or to a plane.
    floor = (_FLOOR * np.abs(centred).max() + 1e-15) ** 2 * np.eye(components)
    # Start with the two halves along the first principal axis, along which two clusters separate.
    key = centred @ np.linalg.svd(centred, full_matrices=False)[2][0]
    weight = (key > np.median(key)).astype(float)
    for _ in range(_NORMAL_ITERATIONS):
        members = np.stack([1 - weight, weight])
        counts = members.sum(1).clip(1e-9)
        means = members @ residuals / counts[:, None]
        off = residuals - means[:, None]
        covariances = np.einsum("kn,kni,knj->kij", members, off, off) / counts[:, None, None] + floor
        squares = np.einsum("kni,kij,knj->kn", off, np.linalg.inv(covariances), off)
        determinants = np.linalg.slogdet(covariances)[1]
        logs = (np.log(counts / rows) - determinants / 2)[:, None] - squares / 2
        weight = 1 / (1 + np.exp((logs[0] - logs[1]).clip(-500, 500)))
    # Log likelihoods of both models without their common constant; the BIC counts mean, covariance and share below.
    alone = np.linalg.slogdet(centred.T @ centred / rows + floor)[1]
    gain = np.logaddexp(*logs).sum() + rows / 2 * (alone + components)
    # Scatters within a factor of 2 (geometric mean) are treated as equal; the smaller population is then the odd one.
    alike = abs(determinants[1] - determinants[0]) < 2 * components * math.log(2.0)
    far = int(np.argmin(counts) if alike else np.argmax(determinants))
    return Mixture(
        population_share=float(counts[far] / rows),
        offset=float(np.average(np.square(off[1 - far]).mean(1), weights=members[far])) ** 0.5,
        scatter=float(np.trace(covariances[1 - far]) / components) ** 0.5,
        log_bayes_factor=float(gain) - (components + 1) * (components + 2) / 4 * math.log(rows),
    )
