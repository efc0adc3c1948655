"""Which features: kept where the evidence and left-out rows say so."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from pisigma.calibration.hybrid.abstract_regression import AbstractRegression
from pisigma.calibration.hybrid.design import FOLDS, FOLDS_OF_FEW, MOST_GROUPS, Design, Rows
from pisigma.calibration.hybrid.evidence import LeftOut, Posterior
from pisigma.calibration.hybrid.regression import extended, regression
from pisigma.joint_correction.feature import AbstractFeature

LEVEL = 1.03
"""Features that the evidence is for are kept unless the left-out RMS rises above so many times the least so far."""
CLEARLY = 5.0
"""The log evidence has to rise by so much (a Bayes factor of 150: very strong, Kass and Raftery 1995).

A threshold of 3 gains nothing where joints err: on 16 to 30 positions of the measured UR5 and UR10 the errors are 0.998
and 1.001 times those at 5 in the mean of 80 fits each, on 20 to 30 of simulated arms 0.997 and 1.004 (120 fits each).
On simulated arms of which the geometry alone errs it costs 1.7 %."""
CLEAR_GAIN = 1.0
"""Standard errors by which left-out squares have to be smaller."""
STRONGLY = 3.0
"""A rise of the log evidence that is strong: a Bayes factor of 20, same source."""
LARGEST_EFFECTIVE_SHARE = 0.75
"""Unknowns may use up so much of the values, or the noise cannot be separated from them."""
LARGEST_USUAL_SHARE = 0.97
"""The same where the sizes of the weights start with the usual ones, which hold what few values do not determine."""
LEAST_USUAL_SCALE = 0.4
"""Prior sizes of the geometry, as shares of the stated ones, that are tried where the estimated ones are smaller:
without features a geometric calibration of few rows takes what they do for noise, and small errors of the geometry for
none."""
USUAL_UPDATES = 5
"""Updates of the usual sizes: more are not worth their time, as few values say little of them."""
ROUGHLY = 1.0
"""While features are chosen, a log evidence that rises by less has settled."""
FEW_GROUPS = 200
"""Up to so many there are more folds."""
FEW_TOGETHER = 60
"""Up to so many groups all features are tried together as well, from the usual sizes of their weights."""
FIRST_MODEL_SIZES = 3
"""A model with all features has one that comes in several sizes in the last of so many."""
FAILURES = 3
"""Sizes that do not help before no larger ones are tried."""

Progress = Callable[[str], None]


@dataclass(frozen=True)
class Trial:
    """One line of the table of what was tried.

    Attributes:
        name: such as "gravity + series 56 + products".
        unknowns: how many.
        log_evidence: up to a constant of the data.
        left_out: RMS of values left out with their group of rows, in units of the geometric calibration's.
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
class Fitted:
    """Some features beside the geometry, fitted.

    Attributes:
        design: the unknowns.
        posterior: of them.
        largest_share: of the values that the unknowns may use up.
        left_out: values of the folds, predicted without them; None where they were not.
    """

    design: Design
    posterior: Posterior
    largest_share: float = LARGEST_EFFECTIVE_SHARE
    left_out: LeftOut | None = None

    @property
    def name(self) -> str:
        """What it has, in a table."""
        return " + ".join(chosen.label for chosen in self.design.features) or "geometry"

    def gain(self, before: "Fitted") -> float:
        """By how many standard errors left-out squares are smaller than another fit's; 0 where none were left out."""
        if self.left_out is None or before.left_out is None:
            return 0.0
        return self.left_out.gain(self.posterior.noise, before.left_out, before.posterior.noise)


@dataclass(frozen=True, eq=False)
class Choice:
    """What a search came to.

    Attributes:
        rows: on which features were chosen.
        geometry: without features.
        best: with the features that were kept.
        trials: what was tried, in order.
        regression: of the rows on the best, where it is at hand.
    """

    rows: Rows
    geometry: Fitted
    best: Fitted
    trials: tuple[Trial, ...]
    regression: AbstractRegression | None = None


class Search:
    """Tries one choice of features after the other on the same rows."""

    def __init__(
        self,
        rows: Rows,
        noise: tuple[float, ...],
        prior_scale: Sequence[float],
        largest: Sequence[AbstractFeature],
        progress: Progress,
    ) -> None:
        """Make the regression on all features.

        Args:
            rows: to fit to.
            noise: of the geometric calibration, per sensor.
            prior_scale: prior sizes of the geometric calibration.
            largest: all features that `best` may try, those that are tried in several sizes in the largest.
            progress: called with what is being tried.
        """
        self.noise, self.prior_scale = noise, prior_scale
        self.trials: list[Trial] = []
        self.progress = progress
        self.rows = rows
        self._regression = regression(Design(rows.problem, tuple(largest)), rows)
        self._order = [one.name for one in largest]
        self._folds = rows.folds(FOLDS if rows.groups > FEW_GROUPS else FOLDS_OF_FEW, MOST_GROUPS)
        began = time.monotonic()
        self.geometry, self._unit = self.fitted(())
        self._least = self._unit
        self._note(self.geometry, 1.0, began, True)

    def fitted(
        self, features: Sequence[AbstractFeature], near: Fitted | None = None, sizes: Tensor | None = None
    ) -> tuple[Fitted, float]:
        """Fit geometry and features, from the noise and the prior sizes of another fit; the last sizes may be given.

        Returns:
            The fit, and the root mean square of left-out values over the noise of the geometric calibration.
        """
        design = Design(self.rows.problem, tuple(features))
        noise, prior = self.noise, design.prior(self.prior_scale)
        if near is not None:
            noise, prior = near.posterior.noise, design.prior_like(near.design, near.posterior.prior)
        if sizes is not None:
            prior = replace(prior, sizes=torch.cat([prior.sizes[: -len(sizes)], sizes]))
        chosen = self._regression.select(design)
        posterior = chosen.maximise_evidence(prior, noise, tolerance=ROUGHLY)
        errors = chosen.left_out(posterior, self._folds)
        return Fitted(design, posterior, left_out=errors), errors.rms(posterior.noise, self.noise)

    def _note(self, tried: Fitted, share: float, began: float, kept: bool) -> None:
        """Add a line to the table."""
        seconds, evidence = time.monotonic() - began, tried.posterior.log_evidence
        self.trials.append(Trial(tried.name, tried.design.unknowns, evidence, share, seconds, kept))

    def best(
        self,
        growing: Sequence[AbstractFeature],
        others: Sequence[AbstractFeature],
        last: Sequence[AbstractFeature] = (),
    ) -> Fitted:
        """Geometry alone, then other features, then ever larger ones, as long as it gets better.

        One after the other, features of few rows do not stand out from the noise that the others leave; so these are
        tried all together as well.

        Args:
            growing: of one name, ever larger.
            others: tried before them, and those that did not help once more after them.
            last: tried when everything else is chosen; left-out rows have to be predicted better beyond the scatter.
        """
        best = self.geometry
        for chosen in others:
            best = self._tried([*best.design.features, chosen], best)
        before, failures, grown = best.design.features, 0, False
        for chosen in growing:
            tried = self._tried([*before, chosen], best)
            failures, grown = (failures + 1, grown) if tried is best else (0, True)
            best = tried
            if failures == FAILURES:
                break
        for chosen in others if grown else ():
            if chosen not in before:
                best = self._tried([*best.design.features, chosen], best)
        together = [*others, *growing[:FIRST_MODEL_SIZES][-1:]]
        if len(together) > 1 and self.rows.groups <= FEW_TOGETHER:
            usual = tuple(max(scale, LEAST_USUAL_SCALE) for scale in self.prior_scale)
            for scale in dict.fromkeys((tuple(self.prior_scale), usual)):
                best = self._from_usual_sizes(together, scale, best)
        for chosen in last:
            gain, sizes = self._regression.first_sizes(best.posterior, best.design, chosen)
            if gain > CLEARLY / 2:
                best = self._tried([*best.design.features, chosen], best, sizes, least_gain=CLEAR_GAIN)
        return best

    def extended(self, best: Fitted, feature: AbstractFeature | None, odds: float = 0.0) -> Choice:
        """The best so far, or that with a feature that comes out of it.

        Args:
            best: so far.
            feature: chosen by its gain on the same rows; None for none.
            odds: logarithm of the prior odds against it, which the evidence has to outweigh.
        """
        if feature is not None:
            largest = [*best.design.features, feature]
            design = Design(self.rows.problem, tuple(largest))
            self._regression = extended(self._regression, design, self.rows)
            self._order = [one.name for one in largest]
            best = self._tried(largest, best, odds=odds)
        same = self._regression.design.features == best.design.features
        return Choice(self.rows, self.geometry, best, tuple(self.trials), self._regression if same else None)

    def _tried(
        self,
        features: Sequence[AbstractFeature],
        best: Fitted,
        sizes: Tensor | None = None,
        odds: float = 0.0,
        least_gain: float = -math.inf,
    ) -> Fitted:
        """The better of new features and the best so far, by evidence and by left-out rows."""
        # in the order of the largest design, whose equations then need no copy for all of its features
        features = sorted(features, key=lambda one: self._order.index(one.name))
        self.progress(" + ".join(chosen.label for chosen in features))
        began = time.monotonic()
        tried, left_out = self.fitted(features, best, sizes)
        better = (
            tried.posterior.log_evidence - best.posterior.log_evidence > CLEARLY + odds
            and left_out < self._least * LEVEL
            and tried.gain(best) > least_gain
            and self._regression.effective_share(tried.posterior) < LARGEST_EFFECTIVE_SHARE
        )
        self._note(tried, left_out / self._unit, began, better)
        if better:
            self._least = min(self._least, left_out)
        return tried if better else best

    def _from_usual_sizes(
        self, features: Sequence[AbstractFeature], prior_scale: Sequence[float], best: Fitted
    ) -> Fitted:
        """The better of all features with weights of about the usual sizes and the best so far.

        Where something was kept already, strong evidence is enough, as few rows show no more. That there is anything
        beyond the geometry needs the usual evidence.
        """
        self.progress(" + ".join(chosen.label for chosen in features))
        began = time.monotonic()
        design = Design(self.rows.problem, tuple(features))
        fit = self._regression.select(design)
        posterior = fit.maximise_evidence(design.usual_prior(prior_scale), self.noise, USUAL_UPDATES)
        errors = fit.left_out(posterior, self._folds)
        left_out = errors.rms(posterior.noise, self.noise)
        better = (
            posterior.log_evidence - best.posterior.log_evidence
            > (STRONGLY if best.design.features else CLEARLY)
            and left_out < self._least * LEVEL
            and fit.effective_share(posterior) < LARGEST_USUAL_SHARE
        )
        tried = Fitted(design, posterior, LARGEST_USUAL_SHARE, errors)
        self._note(tried, left_out / self._unit, began, better)
        if better:
            self._least = min(self._least, left_out)
        return tried if better else best
