"""Rows of two populations in one calibration: two arms, two tools or two frames under one name."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float64, Int64

from pisigma.validation.setup_faults.ordered_rows import OrderedRows, inverse_of

FEWEST_ROWS = 20
"""Of fewer rows two arms are not told apart."""
MOST_ROWS = 300
"""The populations are fitted to so many rows at most, spread over all of them."""
SMALLEST_SHARE = 0.1
"""Fewer rows of another population are outliers, to which the robust loss gives no weight."""
TAILS = 5.0
"""Degrees of freedom of the t distribution of the residuals, so that outliers make no population."""
MOST_USED = 0.9
"""Of the share of the values from which on the likelihood has no bound, see `_most_used`."""
STARTS, FIRST_ROUNDS, ROUNDS = 8, 6, 40
"""Expectation maximisation is started so often, and goes on from the best after its first rounds."""
SETTLED = 1e-2
"""Probabilities have settled that change by less."""
ALTERNATING = 0.95
"""Rows alternate where so many of them do: 1 in 20 may be predicted equally well by both."""
DIFFERENCE = 2.0
"""Variance of the difference of two arms, over that of one from the drawn arm."""
_Differing = Literal["arm", "frame", "tool"]


@dataclass(frozen=True, eq=False)
class Populations:
    """Two populations of rows.

    Attributes:
        differing: by what they differ.
        second: whether a row of the measurements is of the smaller population.
        tried: how many rows were judged.
        difference: of base, tool or arm, as numbers of `differing` [m or rad].
        factor: how many times as large as without the difference the errors of the rows are.
        used: share of the values that everything fitted used up.
        log_bayes_factor: logarithm of the odds against one population, by the Bayesian information criterion (Schwarz
            1978, Annals of Statistics 6, 461-464).
    """

    differing: _Differing
    second: Bool[np.ndarray, " rows"]
    tried: int
    difference: Float64[np.ndarray, " numbers"]
    factor: float
    used: float
    log_bayes_factor: float


def find_populations(rows: OrderedRows, count: int) -> Populations | None:
    """Find the two populations that explain the residuals of a calibration best, likely or not.

    `r_i = X_i x + w_i Z_i m + e_i`: a row of the second population (w_i = 1) has the difference m besides what is
    unknown of all rows. The probabilities of w_i, x, m and the size of e_i are found by expectation maximisation
    (Dempster, Laird and Rubin 1977, JRSS B 39, 1-38), the errors having a t distribution. Tried are differences of the
    tool, of the frame, and of arm, base and tool together.

    Args:
        rows: residuals of a calibration.
        count: how many rows the measurements have.

    Returns:
        None where there are too few rows.
    """
    if len(rows.residual) < FEWEST_ROWS:
        return None
    index = np.unique(np.linspace(0, len(rows.residual) - 1, MOST_ROWS).round().astype(int))
    some = index if len(rows.residual) > MOST_ROWS else np.arange(len(rows.residual))
    independent = rows.independent / max(rows.values - rows.used, 1.0)
    found = []
    for differing, Z, precision in _differences(rows):
        fit = _Mixture(rows, Z, precision).best(some)
        if fit.used > _most_used(rows.residual.shape[1]) * fit.values:
            continue
        second = np.zeros(count, dtype=bool)
        second[rows.number] = _in_turn(fit.probability > 0.5)
        if second.sum() > len(rows.number) / 2:
            second[rows.number] = ~second[rows.number]
        found.append(
            Populations(
                differing,
                second,
                len(rows.number),
                fit.difference,
                fit.factor,
                fit.used / fit.values,
                fit.gain(independent),
            )
        )
    return max(found, key=lambda one: one.log_bayes_factor, default=None)


def _most_used(components: int) -> float:
    """Share of the values that the unknowns of two populations may use up.

    A fit that goes through a share u of the rows exactly lets the size of the errors go to 0. Of rows with c components
    the likelihood of the t distribution then has no bound where c > (1 - u)(TAILS + c), that is u > TAILS/(TAILS + c):
    5/8 of positions, 5/11 of poses.

    Args:
        components: of the residual of a row.
    """
    return MOST_USED * TAILS / (TAILS + components)


def _in_turn(second: Bool[np.ndarray, " rows"]) -> Bool[np.ndarray, " rows"]:
    """Take nearly every second row for every second row: rows where both agree are of either."""
    odd: np.ndarray = np.arange(len(second)) % 2 == 1
    for turn in (odd, ~odd):
        if np.mean(second == turn) > ALTERNATING:
            return turn
    return second


def _differences(
    rows: OrderedRows,
) -> Iterator[tuple[_Differing, Float64[np.ndarray, "rows values numbers"], Float64[np.ndarray, " numbers"]]]:
    """Derivatives by everything that may differ, with the precision of the prior."""
    space = rows.problem.space
    for kind, group in (("tool", rows.problem.target), ("frame", rows.problem.frame)):
        first = space.of("base" if kind == "frame" else "tool").start
        columns = first + 6 * group.cpu().numpy()[:, None] + np.arange(6)
        Z = np.take_along_axis(rows.derivative, columns[:, None], 2)
        turning = kind == "frame" or rows.residual.shape[1] > 3
        Z = Z if turning else Z[:, :, :3]
        yield ("tool" if kind == "tool" else "frame"), Z, np.zeros(Z.shape[2])
    active = len(rows.problem.active)
    yield "arm", rows.X[:, :, :active], rows.precision[:active] / DIFFERENCE


@dataclass(frozen=True, eq=False)
class _Fit:
    """Two populations that were fitted.

    Attributes:
        probability: that a row is of the second one.
        difference: of the two.
        factor: see `Populations`.
        log_likelihood: with the difference, and without it.
        used: how many numbers the values determine.
        unknowns: how many of them are the difference.
        values: how many there are.
    """

    probability: Float64[np.ndarray, " rows"]
    difference: Float64[np.ndarray, " numbers"]
    factor: float
    log_likelihood: tuple[float, float]
    used: float
    unknowns: float
    values: int

    def gain(self, independent: float) -> float:
        """Logarithm of the Bayes factor where only a share of the values is independent."""
        values = max(independent * self.values, 2.0)
        gain = (self.log_likelihood[0] - self.log_likelihood[1]) * independent
        return gain - (self.unknowns + 1) / 2 * math.log(values)


@dataclass(frozen=True, eq=False)
class _Mixture:
    """Fits two populations that differ by some numbers."""

    rows: OrderedRows
    Z: Float64[np.ndarray, "rows values numbers"]
    precision: Float64[np.ndarray, " numbers"]

    def best(self, some: Int64[np.ndarray, " some"]) -> _Fit:
        """Fit from several starts to some rows, and then say of all rows which population they are of."""
        r, X, Z = self.rows.residual[some], self.rows.X[some], self.Z[some]
        rng = np.random.default_rng(0)
        starts = [np.arange(len(some)) % 2 * 0.8 + 0.1, *rng.uniform(0, 1, (STARTS - 1, len(some)))]
        alone = _Em(r, X, Z[:, :, :0], np.r_[self.rows.precision])
        one = alone.run(alone.begin(np.zeros(len(some))), ROUNDS)
        em = _Em(r, X, Z, np.r_[self.rows.precision, self.precision])
        states = [em.run(em.begin(start), FIRST_ROUNDS) for start in starts]
        state = em.run(max(states, key=lambda state: state.log_likelihood), ROUNDS)
        difference = state.x[X.shape[2] :]
        made = float(np.square(Z @ difference).mean()) * state.share * (1 - state.share)
        left = state.variance * r.size / max(r.size - state.used, 1.0) * TAILS / (TAILS - 2)
        every = _Em(self.rows.residual, self.rows.X, self.Z, em.precision)
        return _Fit(
            probability=every.probabilities(state.x, state.share, state.variance)[0],
            difference=difference,
            factor=(1 + made / left) ** 0.5,
            log_likelihood=(state.log_likelihood, one.log_likelihood),
            used=state.used,
            unknowns=state.used - one.used,
            values=r.size,
        )


@dataclass(frozen=True, eq=False)
class _State:
    """One round of expectation maximisation."""

    probability: Float64[np.ndarray, " rows"]
    weights: Float64[np.ndarray, "2 rows"]
    x: Float64[np.ndarray, " unknowns"]
    share: float
    variance: float
    used: float
    log_likelihood: float


@dataclass(frozen=True, eq=False)
class _Em:
    """Expectation maximisation for rows `r = X x + w Z m + e`."""

    r: Float64[np.ndarray, "rows values"]
    X: Float64[np.ndarray, "rows values common"]
    Z: Float64[np.ndarray, "rows values numbers"]
    precision: Float64[np.ndarray, " unknowns"]

    def begin(self, probability: Float64[np.ndarray, " rows"]) -> _State:
        """Begin with probabilities of the second population."""
        variance = float(np.square(self.r).mean())
        ones = np.ones((2, len(self.r)))
        return _State(probability, ones, np.zeros(len(self.precision)), 0.5, variance, 0.0, -np.inf)

    def run(self, state: _State, rounds: int) -> _State:
        """Go on for some rounds, or until the probabilities have settled."""
        for _ in range(rounds):
            before = state
            state = self._step(state)
            change = np.abs(state.probability - before.probability).max(initial=0.0)
            if change < SETTLED and abs(state.variance / before.variance - 1) < SETTLED:
                break
        return state

    def _step(self, state: _State) -> _State:
        """Fit everything with the present probabilities, and compute new ones."""
        second = state.probability * state.weights[1]
        total = (1 - state.probability) * state.weights[0] + second
        rows, values, common = self.X.shape
        X, Z = self.X.reshape(-1, common), self.Z.reshape(rows * values, -1)
        wX, wZ = X * np.repeat(total, values)[:, None], Z * np.repeat(second, values)[:, None]
        mixed, flat = wX.T @ Z if not Z.shape[1] else X.T @ wZ, self.r.ravel()
        data = np.block([[wX.T @ X, mixed], [mixed.T, wZ.T @ Z]])
        normal = data + np.diag(self.precision * state.variance)
        inverse = inverse_of(normal)
        x = inverse @ np.concatenate([wX.T @ flat, wZ.T @ flat])
        used = float(np.einsum("ij,ji->", inverse, data))
        squares = self.squares(x)
        probability = np.stack([1 - state.probability, state.probability])
        variance = max(float((probability * state.weights * squares).sum()) / self.r.size, 1e-12)
        share = float(np.clip(state.probability.mean(), 1e-3, 1 - 1e-3))
        fresh, log_likelihood = self.probabilities(x, share, variance)
        weights = (TAILS + values) / (TAILS + squares / variance)
        return _State(fresh, weights, x, share, variance, used, log_likelihood)

    def squares(self, x: Float64[np.ndarray, " unknowns"]) -> Float64[np.ndarray, "2 rows"]:
        """Squared lengths of what is left of every row in either population."""
        common = self.X.shape[2]
        left = self.r - self.X @ x[:common]
        return np.stack([np.square(left).sum(1), np.square(left - self.Z @ x[common:]).sum(1)])

    def probabilities(
        self, x: Float64[np.ndarray, " unknowns"], share: float, variance: float
    ) -> tuple[Float64[np.ndarray, " rows"], float]:
        """Probability that a row is of the second population, and the logarithm of the likelihood of all."""
        values = self.r.shape[1]
        logs = -(TAILS + values) / 2 * np.log1p(self.squares(x) / variance / TAILS)
        if not self.Z.shape[2]:
            return np.zeros(len(self.r)), float(logs[0].sum()) - self.r.size / 2 * math.log(variance)
        logs = logs + np.log([1 - share, share])[:, None]
        odds = (logs[0] - logs[1]).clip(-500, 500)
        return 1 / (1 + np.exp(odds)), float(np.logaddexp(*logs).sum()) - self.r.size / 2 * math.log(variance)
