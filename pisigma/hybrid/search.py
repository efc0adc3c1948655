"""Which features, harmonics and product units: kept where the evidence and left-out rows say so."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from pisigma.hybrid.design import Design, Rows, sum_up
from pisigma.hybrid.evidence import Posterior, Sums, effective_share, maximise_evidence, solve_posterior
from pisigma.hybrid.left_out import left_out
from pisigma.hybrid.products import ProductFit
from pisigma.joint_correction.feature import AbstractFeature

LEVEL = 1.03
"""Features that the evidence is for are kept unless the left-out RMS rises above so many times what it was."""
CLEARLY = 5.0
"""The log evidence has to rise by so much (a Bayes factor of 150: very strong, Kass and Raftery 1995)."""
LARGEST_EFFECTIVE_SHARE = 0.75
"""Unknowns may use up so much of the values, or the noise cannot be separated from them."""
ROUGHLY = 0.1
"""While features are chosen, a log evidence that rises by less has settled."""
FAILURES = 3
"""Sizes that do not help before no larger ones are tried."""

Progress = Callable[[str], None]
FOLDS = 4
"""Folds of the training rows on which product units are judged."""
MOST_CONFIGURATIONS = 600
"""They are judged on so many configurations at most."""
LEAST_CONFIGURATIONS = 40
"""They are not looked for among fewer."""
BETTER = 0.98
"""Held-out RMS must fall below this share for product units to be kept."""


@dataclass(frozen=True)
class Trial:
    """One line of the table of what was tried.

    Attributes:
        name: such as "gravity + series 56 + products (2, 2)".
        unknowns: how many.
        log_evidence: up to a constant of the data.
        left_out: RMS of values left out with their configuration, in units of the geometric calibration's.
        seconds: time it took.
        kept: whether it was better than what was kept before it.
    """

    name: str
    unknowns: int
    log_evidence: float
    left_out: float
    seconds: float
    kept: bool


@dataclass(frozen=True, eq=False)
class Additive:
    """A unit of order 1 beside the geometry, fitted.

    Attributes:
        design: its unknowns.
        sums: its normal equations.
        posterior: of them.
    """

    design: Design
    sums: Sums
    posterior: Posterior

    @property
    def name(self) -> str:
        """What it has, in a table."""
        return " + ".join(chosen.label for chosen in self.design.features) or "geometry"

    @property
    def size(self) -> int:
        """Of its feature that was tried in several sizes, such as its number of harmonics; 0 without one."""
        return sum(feature.size for feature in self.design.features)


class Search:
    """Tries one model after the other on the same rows."""

    def __init__(
        self,
        rows: Rows,
        noise: tuple[float, ...],
        prior_scale: Sequence[float],
        largest: Sequence[AbstractFeature],
        progress: Progress,
    ) -> None:
        """Sum up the normal equations of the largest unit of order 1.

        Args:
            rows: to fit to.
            noise: of the geometric calibration, per sensor.
            prior_scale: prior sizes of the geometric calibration.
            largest: all features that may be tried, those that are tried in several sizes in the largest.
            progress: called with what is being tried.
        """
        self.rows, self.noise, self.prior_scale = rows, noise, prior_scale
        self.trials: list[Trial] = []
        self.progress = progress
        self._largest = Design(rows.problem, tuple(largest))
        self._sums = sum_up(self._largest, rows.values, rows.start(self._largest))
        self._unit = 1.0
        self.fitted: list[Additive] = []
        self.geometry = self.additive(())

    def additive(self, features: Sequence[AbstractFeature], near: Additive | None = None) -> Additive:
        """Fit geometry and a unit of order 1, from the noise of another fit."""
        indices = self._largest.indices(features)
        design = Design(self.rows.problem, tuple(features))
        sums = self._sums.select(indices)
        noise, prior = self.noise, design.prior(self.prior_scale)
        if near is not None:
            noise, prior = near.posterior.noise, design.prior_like(near.design, near.posterior.prior)
        posterior = maximise_evidence(sums, prior, noise, tolerance=ROUGHLY)
        fitted = Additive(design, sums, posterior)
        self.fitted.append(fitted)
        return fitted

    def _left_out_rms(self, tried: Additive) -> float:
        """RMS of left-out values over the noise of the geometric calibration."""
        errors = left_out(self.rows, tried.design, tried.posterior)
        scale = errors.error.new_tensor(tried.posterior.noise) / errors.error.new_tensor(self.noise)
        return float((errors.error * scale[errors.sensor]).square().mean().sqrt())

    def _note(self, tried: Additive, rms: float, began: float, kept: bool) -> None:
        """Add a line to the table."""
        if not self.trials:
            self._unit = rms
        seconds, evidence, share = time.monotonic() - began, tried.posterior.log_evidence, rms / self._unit
        self.trials.append(Trial(tried.name, tried.design.unknowns, evidence, share, seconds, kept))

    def best_additive(
        self, growing: Sequence[AbstractFeature], others: Sequence[AbstractFeature]
    ) -> Additive:
        """Geometry alone, then other features, then ever larger ones, as long as it gets better."""
        began = time.monotonic()
        best = self.geometry
        rms = self._left_out_rms(best)
        self._note(best, rms, began, True)
        without: list[AbstractFeature] = []
        for chosen in others:
            best, rms, better = self._tried([*without, chosen], best, rms)
            if better:
                without.append(chosen)
        with_growing, failures = without, 0
        for chosen in growing:
            best, rms, better = self._tried([*without, chosen], best, rms)
            failures = 0 if better else failures + 1
            if better:
                with_growing = [*without, chosen]
            elif failures == FAILURES:
                break
        for chosen in others:
            if chosen not in with_growing and len(with_growing) > len(without):
                best, rms, better = self._tried([chosen, *with_growing], best, rms)
                with_growing = [chosen, *with_growing] if better else with_growing
        return best

    def _tried(
        self, features: Sequence[AbstractFeature], best: Additive, rms: float
    ) -> tuple[Additive, float, bool]:
        """The better of a new unit of order 1 and the best so far, by evidence and by left-out rows."""
        self.progress(" + ".join(chosen.label for chosen in features))
        began = time.monotonic()
        tried = self.additive(features, best)
        left_out_rms = self._left_out_rms(tried)
        gain = tried.posterior.log_evidence - best.posterior.log_evidence
        better = (
            gain > CLEARLY
            and left_out_rms < rms * LEVEL
            and effective_share(tried.sums, tried.posterior) < LARGEST_EFFECTIVE_SHARE
        )
        self._note(tried, left_out_rms, began, better)
        return (tried, left_out_rms, True) if better else (best, rms, False)


@dataclass(frozen=True, eq=False)
class _Fold:
    """Rows that are held out, and the additive model fitted to the others, prior sizes and noise fixed."""

    test: Rows
    base: Posterior
    fit: ProductFit

    def square(self, orders: tuple[int, ...], noise: tuple[float, ...]) -> float:
        """Squared errors of the held-out rows over variances; additive where there are no orders."""
        design, posterior = self.fit.design, self.base
        if orders:
            fitted = self.fit.fit(orders, 0)
            design, posterior = fitted.design, fitted.posterior
        return float(self.test.left(design, posterior, noise).sum())


def best_products(
    search: Search, additive: Additive, choices: Sequence[tuple[int, ...]]
) -> tuple[Additive, tuple[int, ...]]:
    """Choose product units, and then once more the series beside them.

    Every choice is fitted to all but one of `FOLDS` folds of the rows at a time, and judged on that fold. As long as
    interactions between joints are not modelled, a series takes up some of them; with product units fewer
    harmonics may be better.

    Args:
        search: the rows, and what was tried on them; its table gets a line for every choice.
        additive: the best unit of order 1.
        choices: orders of product units, tried in turn; if the first does not help, the others are not tried.

    Returns:
        The unit of order 1 and the orders; no orders where product units do not help.
    """
    if not choices or search.rows.configurations < LEAST_CONFIGURATIONS:
        return additive, ()
    last = next(trial.left_out for trial in reversed(search.trials) if trial.kept)
    folds = _folds(search, additive)
    first = least = sum(fold.square((), search.noise) for fold in folds)
    best: tuple[int, ...] = ()
    for orders in choices:
        square, better = _judged(search, additive, folds, orders, least, (last, first))
        if better:
            best, least = orders, square
        if not best:
            return additive, ()
    fewer = [
        other
        for other in search.fitted
        if 0 < other.size < additive.size
        and {c.name for c in other.design.features} == {c.name for c in additive.design.features}
    ]
    for other in sorted(fewer, key=lambda one: -one.size):
        square, better = _judged(search, other, _folds(search, other), best, least / BETTER**2, (last, first))
        if not better:
            break
        additive, least = other, square
    return additive, best


def _judged(
    search: Search,
    additive: Additive,
    folds: Sequence[_Fold],
    orders: tuple[int, ...],
    least: float,
    unit: tuple[float, float],
) -> tuple[float, bool]:
    """Squared errors of held-out rows, and whether they are clearly below the least so far; adds a line."""
    name = f"{additive.name} + products {orders}"
    search.progress(name)
    began = time.monotonic()
    square = sum(fold.square(orders, search.noise) for fold in folds)
    better = square < least * BETTER**2
    inputs = folds[0].fit.inputs
    unknowns = additive.design.unknowns + search.rows.problem.space.robot.dof * sum(orders) * inputs
    left_out = unit[0] * (square / unit[1]) ** 0.5
    seconds = time.monotonic() - began
    search.trials.append(Trial(name, unknowns, float("nan"), left_out, seconds, better))
    return square, better


def _folds(search: Search, additive: Additive) -> list[_Fold]:
    """Folds of at most `MOST_CONFIGURATIONS` configurations."""
    rows, design = search.rows, additive.design
    order = rows.shuffled()[:MOST_CONFIGURATIONS]
    folds = []
    for k in range(FOLDS):
        others = torch.cat([order[fold::FOLDS] for fold in range(FOLDS) if fold != k])
        train, test = rows.of(others), rows.of(order[k::FOLDS])
        sums = sum_up(design, train.values, train.start(design))
        base = solve_posterior(sums, additive.posterior.prior, additive.posterior.noise)
        fit = ProductFit(design, train.values, train.start(design), base, sums)
        folds.append(_Fold(test, base, fit))
    return folds
