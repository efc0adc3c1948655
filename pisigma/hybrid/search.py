"""Which features, harmonics and product units: kept where the evidence and left-out rows say so."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from pisigma.hybrid.design import Design, sum_up
from pisigma.hybrid.evidence import Posterior, Sums, effective_share, maximise_evidence
from pisigma.hybrid.left_out import left_out
from pisigma.hybrid.rows import Rows
from pisigma.joint_correction.feature import AbstractFeature

LEVEL = 1.03
"""Features that the evidence is for are kept unless the left-out RMS rises above so many times what it was."""
CLEARLY = 5.0
"""The log evidence has to rise by so much (a Bayes factor of 150: very strong, Kass and Raftery 1995)."""
LARGEST_EFFECTIVE_SHARE = 0.75
"""Unknowns may use up so much of the values, or the noise cannot be told from them."""
ROUGHLY = 0.1
"""While features are chosen, a log evidence that rises by less has settled."""
FAILURES = 3
"""Sizes that do not help before no larger ones are tried."""

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
        places = self._largest.places(features)
        design = Design(self.rows.problem, tuple(features))
        sums = self._sums.select(places)
        noise, prior = self.noise, design.prior(self.prior_scale)
        if near is not None:
            noise, prior = near.posterior.noise, design.prior_like(near.design, near.posterior.prior)
        posterior = maximise_evidence(sums, prior, noise, tolerance=ROUGHLY)
        found = Additive(design, sums, posterior)
        self.fitted.append(found)
        return found

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

    def best_additive(
        self, growing: Sequence[AbstractFeature], others: Sequence[AbstractFeature]
    ) -> Additive:
        """Geometry alone, then other features, then ever larger ones, as long as it gets better."""
        began = time.monotonic()
        best = self.geometry
        rms = self.left_out_rms(best.design, best.posterior)
        self.note("geometry", best.design, best.posterior, rms, began, True)
        without: list[AbstractFeature] = []
        for chosen in others:
            best, rms, better = self._tried([*without, chosen], best, rms)
            if better:
                without.append(chosen)
        with_growing: list[AbstractFeature] = list(without)
        failures = 0
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
        found = self.additive(features, best)
        own = self.left_out_rms(found.design, found.posterior)
        gain = found.posterior.log_evidence - best.posterior.log_evidence
        better = (
            gain > CLEARLY
            and own < rms * LEVEL
            and effective_share(found.sums, found.posterior) < LARGEST_EFFECTIVE_SHARE
        )
        self.note(found.name, found.design, found.posterior, own, began, better)
        return (found, own, True) if better else (best, rms, False)
