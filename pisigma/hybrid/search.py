"""Which features, harmonics and product units: kept where the evidence and left-out rows say so."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pisigma.hybrid.design import Design, sum_up
from pisigma.hybrid.evidence import Posterior, Sums, maximise_evidence, solve_posterior
from pisigma.hybrid.left_out import left_out
from pisigma.hybrid.products import ProductFit
from pisigma.hybrid.rows import Rows
from pisigma.network.features import AbstractFeatures, FourierSeries

FOLDS = 4
"""Parts of the training rows on which product units are judged."""
MOST_CONFIGURATIONS = 600
"""Product units are chosen on so many configurations at most."""
BETTER = 0.99
"""Held-out RMS must fall below this share for product units to be kept."""
LEVEL = 1.03
"""Features that the evidence is for are kept unless the left-out RMS rises above so many times what it was."""
CLEARLY = 5.0
"""The log evidence has to rise by so much (a Bayes factor of 150: very strong, Kass and Raftery 1995)."""
ROUGHLY = 0.1
"""While features are chosen, a log evidence that rises by less has settled."""
FAILURES = 3
"""Series that do not help before no more harmonics are tried."""

Progress = Callable[[str], None]


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


class Search:
    """Tries one model after the other on the same rows."""

    def __init__(
        self,
        rows: Rows,
        noise: tuple[float, ...],
        widening: Sequence[float],
        largest: Sequence[AbstractFeatures],
        progress: Progress,
    ) -> None:
        """Sum up the normal equations of the largest unit of order 1.

        Args:
            rows: to fit to.
            noise: of the geometric calibration, per sensor.
            widening: prior sizes of the geometric calibration.
            largest: all features that may be tried, series with all its harmonics.
            progress: called with what is being tried.
        """
        self.rows, self.noise, self.widening = rows, noise, widening
        self.trials: list[Trial] = []
        self._progress = progress
        self._largest = Design(rows.problem, tuple(largest))
        self._sums = sum_up(self._largest, rows.values, rows.start(self._largest))
        self._unit = 1.0
        self.geometry = self.additive(())

    def additive(self, features: Sequence[AbstractFeatures], near: Additive | None = None) -> Additive:
        """Fit geometry and a unit of order 1, from the noise of another fit."""
        places = self._largest.places(features)
        design = Design(self.rows.problem, tuple(features))
        sums = self._sums.select(places)
        noise = self.noise if near is None else near.posterior.noise
        posterior = maximise_evidence(sums, design.prior(self.widening), noise, tolerance=ROUGHLY)
        return Additive(design, sums, posterior)

    def left_out_rms(self, design: Design, posterior: Posterior) -> float:
        """RMS of left-out values over the noise of the geometric calibration."""
        found = left_out(self.rows, design, posterior)
        scale = posterior.x.new_tensor(
            [mine / first for mine, first in zip(posterior.noise, self.noise, strict=True)]
        )
        return float((found.error * scale[found.sensor]).square().mean().sqrt())

    def note(
        self, name: str, design: Design, posterior: Posterior, rms: float, began: float, kept: bool
    ) -> None:
        """Add a line to the table."""
        if not self.trials:
            self._unit = rms
        self.trials.append(
            Trial(
                name,
                design.unknowns,
                posterior.log_evidence,
                rms / self._unit,
                time.monotonic() - began,
                kept,
            )
        )

    def best_additive(self, series: Sequence[FourierSeries], others: Sequence[AbstractFeatures]) -> Additive:
        """Geometry alone, then other features, then ever more harmonics, as long as it gets better."""
        began = time.monotonic()
        best = self.geometry
        rms = self.left_out_rms(best.design, best.posterior)
        self.note("geometry", best.design, best.posterior, rms, began, True)
        without: list[AbstractFeatures] = []
        for chosen in others:
            best, rms, better = self._tried([*without, chosen], best, rms)
            if better:
                without.append(chosen)
        with_series: list[AbstractFeatures] = list(without)
        failures = 0
        for chosen in series:
            best, rms, better = self._tried([*without, chosen], best, rms)
            failures = 0 if better else failures + 1
            if better:
                with_series = [*without, chosen]
            elif failures == FAILURES:
                break
        for chosen in others:
            if chosen not in with_series and len(with_series) > len(without):
                best, rms, better = self._tried([chosen, *with_series], best, rms)
                with_series = [chosen, *with_series] if better else with_series
        return best

    def _tried(
        self, features: Sequence[AbstractFeatures], best: Additive, rms: float
    ) -> tuple[Additive, float, bool]:
        """The better of a new unit of order 1 and the best so far, by evidence and by left-out rows."""
        name = " + ".join(described(chosen) for chosen in features)
        self._progress(name)
        began = time.monotonic()
        found = self.additive(features, best)
        own = self.left_out_rms(found.design, found.posterior)
        gain = found.posterior.log_evidence - best.posterior.log_evidence
        better = gain > CLEARLY and own < rms * LEVEL
        self.note(name, found.design, found.posterior, own, began, better)
        return (found, own, True) if better else (best, rms, False)

    def best_products(self, additive: Additive, choices: Sequence[tuple[int, ...]]) -> tuple[int, ...]:
        """Orders of the product units that predict held-out rows best; none where they do not help.

        Every choice is fitted to all but one of `FOLDS` parts of the rows at a time, and judged on that part.
        """
        best: tuple[int, ...] = ()
        folds = self._folds()
        squares = self._held_out(additive, (), folds)
        first = squares
        for orders in choices:
            name = f"{self._name(additive)} + products {orders}"
            self._progress(name)
            began = time.monotonic()
            own = self._held_out(additive, orders, folds)
            better = own < squares * BETTER**2
            rms = self.trials[-1].left_out if first == 0 else self._kept_rms() * (own / first) ** 0.5
            self.trials.append(
                Trial(name, additive.design.unknowns, float("nan"), rms, time.monotonic() - began, better)
            )
            if not better:
                break
            best, squares = orders, own
        return best

    def _kept_rms(self) -> float:
        return next(
            trial.left_out for trial in reversed(self.trials) if trial.kept and "products" not in trial.name
        )

    def _name(self, additive: Additive) -> str:
        return " + ".join(described(chosen) for chosen in additive.design.features) or "geometry"

    def _folds(self) -> list[Tensor]:
        """Masks over the configurations, of `FOLDS` parts of at most `MOST_CONFIGURATIONS`."""
        generator = torch.Generator().manual_seed(0)
        order = torch.randperm(self.rows.configurations, generator=generator)[:MOST_CONFIGURATIONS]
        parts = []
        for k in range(FOLDS):
            mask = torch.zeros(self.rows.configurations, dtype=torch.bool)
            mask[order[k::FOLDS]] = True
            parts.append(mask.to(self.rows.configuration.device))
        return parts

    def _held_out(self, additive: Additive, orders: tuple[int, ...], folds: Sequence[Tensor]) -> float:
        """Sum of squared residuals over variances of held-out rows."""
        everything = torch.stack(list(folds)).any(0)
        total = 0.0
        for fold in folds:
            train, test = self.rows.of(everything & ~fold), self.rows.of(fold)
            sums = sum_up(additive.design, train.values, train.start(additive.design))
            prior = additive.posterior.prior
            base = solve_posterior(sums, prior, additive.posterior.noise)
            if orders:
                fit = ProductFit(additive.design, train.values, train.start(additive.design), base, sums)
                products = fit.fit(orders, 0)
                total += float(test.left(products.design, products.posterior, additive.posterior.noise).sum())
            else:
                total += float(test.left(additive.design, base, additive.posterior.noise).sum())
        return total


def described(features: AbstractFeatures) -> str:
    """A choice of features in a table."""
    if isinstance(features, FourierSeries):
        return f"series {features.harmonics}"
    return features.name
