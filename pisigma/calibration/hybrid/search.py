"""Selection of features by evidence and by held-out rows."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from pisigma.calibration.hybrid.design import (
    FOLDS,
    FOLDS_OF_FEW,
    MAX_GROUPS,
    AbstractDesignRegression,
    Design,
    LinearisedRows,
)
from pisigma.calibration.hybrid.regression import build_regression, extend_regression
from pisigma.estimation.held_out import HeldOutErrors
from pisigma.estimation.regression import Posterior
from pisigma.joint_correction.feature import AbstractFeature

_LEVEL = 1.03
"""Ratio of the held-out RMS error to the lowest one so far above which features are rejected despite the evidence."""
CLEAR_EVIDENCE = 5.0
"""Increase of the log evidence needed to keep features (a Bayes factor of 150: very strong, Kass and Raftery 1995).

A threshold of 3 gains nothing for arms with joint errors: with 16 to 30 positions of the measured UR5 and UR10, the
errors are on average 0.998 and 1.001 times those with a threshold of 5 (80 fits each), and with 20 to 30 positions of
simulated arms 0.997 and 1.004 times (120 fits each). For simulated arms with errors of the geometry alone, it increases
the errors by 1.7 %."""
CLEAR_GAIN = 1.0
"""Decrease of the held-out squared errors [standard errors] that is regarded as an improvement."""
_STRONG_EVIDENCE = 3.0
"""Increase of the log evidence that is strong: a Bayes factor of 20 (Kass and Raftery 1995)."""
_MAX_EFFECTIVE_SHARE = 0.75
"""Largest effective number of unknowns per value; with more, they cannot be separated from the noise."""
MAX_USUAL_SHARE = 0.97
"""Largest effective number of unknowns per value if the prior scales of the weights start at their usual sizes, which
regularise what few values do not determine."""
MIN_USUAL_SCALE = 0.4
"""Prior scale of the geometry that is also tried if the estimated scale is smaller, because a geometric calibration of
few rows attributes the effects of missing features to noise and underestimates small errors of the geometry."""
_USUAL_UPDATES = 5
"""Number of updates of the usual sizes; few values hardly determine them, so more updates are not useful."""
ROUGH_TOLERANCE = 1.0
"""Increase of the log evidence per update below which fits have converged during the selection of features."""
FEW_GROUPS = 200
"""Number of groups up to which more folds are used."""
_FEW_TOGETHER = 60
"""Number of groups up to which all features are also tried together, starting with the usual sizes of their weights."""
FIRST_MODEL_SIZES = 3
"""Index of the size of a growing feature that is used in a model with all features."""
_MAX_FAILURES = 3
"""Number of successive sizes without improvement after which larger sizes are not tried."""

Progress = Callable[[str], None]


@dataclass(frozen=True)
class Trial:
    """One line of the table of trials.

    Attributes:
        name: features, such as "gravity + series 56 + products".
        unknowns: number of unknowns.
        log_evidence: log evidence up to a constant of the data.
        held_out_ratio: ratio of the held-out RMS error to that of the geometric calibration [1].
        seconds: duration [s].
        is_best_so_far: whether the trial was better than all previous trials.
    """

    name: str
    unknowns: int
    log_evidence: float
    held_out_ratio: float
    seconds: float
    is_best_so_far: bool


@dataclass(frozen=True, eq=False)
class FeatureFit:
    """Fit of the geometry and a set of features.

    Attributes:
        design: the unknowns.
        posterior: posterior of the unknowns.
        max_effective_share: largest allowed effective number of unknowns per value.
        held_out_errors: held-out predictions of the folds; None if they were not computed.
    """

    design: Design
    posterior: Posterior
    max_effective_share: float = _MAX_EFFECTIVE_SHARE
    held_out_errors: HeldOutErrors | None = None

    @property
    def name(self) -> str:
        """Labels of the features, for tables."""
        return " + ".join(chosen.label for chosen in self.design.features) or "geometry"

    def gain_in_standard_errors(self, before: "FeatureFit") -> float:
        """Compute the decrease of the held-out squared errors from another fit [standard errors]; 0 without any."""
        if self.held_out_errors is None or before.held_out_errors is None:
            return 0.0
        return self.held_out_errors.gain_in_standard_errors(
            self.posterior.noise, before.held_out_errors, before.posterior.noise
        )


@dataclass(frozen=True, eq=False)
class FeatureChoice:
    """Result of a search for features.

    Attributes:
        rows: rows used for the selection.
        fit_without_features: fit without features.
        best: fit with the chosen features.
        trials: the trials, in order.
        regression: regression of the rows on the best design, if available.
    """

    rows: LinearisedRows
    fit_without_features: FeatureFit
    best: FeatureFit
    trials: tuple[Trial, ...]
    regression: AbstractDesignRegression | None = None


class FeatureSearch:
    """Search for features of a joint correction, which tries one after another on the same rows."""

    def __init__(
        self,
        rows: LinearisedRows,
        noise: tuple[float, ...],
        prior_scale: Sequence[float],
        largest: Sequence[AbstractFeature],
        progress: Progress,
    ) -> None:
        """Build the regression on all features.

        Args:
            rows: the rows.
            noise: noise of the geometric calibration per sensor.
            prior_scale: prior scales of the geometric calibration.
            largest: all features that `select_features` may try; growing features in their largest size.
            progress: callback that is called with the current trial.
        """
        self.noise, self.prior_scale = noise, prior_scale
        self.trials: list[Trial] = []
        self.progress = progress
        self.rows = rows
        self._regression = build_regression(Design(rows.problem, tuple(largest)), rows)
        self._order = [one.name for one in largest]
        self._folds = rows.folds(FOLDS if rows.groups > FEW_GROUPS else FOLDS_OF_FEW, MAX_GROUPS)
        began = time.monotonic()
        self.fit_without_features, self._unit = self.fit_features(())
        self._least = self._unit
        self._note(self.fit_without_features, 1.0, began, True)

    def fit_features(
        self,
        features: Sequence[AbstractFeature],
        start: FeatureFit | None = None,
        sizes: Tensor | None = None,
    ) -> tuple[FeatureFit, float]:
        """Fit geometry and features, starting with the noise and prior scales of another fit.

        Args:
            features: the features.
            start: another fit; None to start with noise and prior scales of the geometric calibration.
            sizes: start values of the prior scales of the last feature.

        Returns:
            The fit, and the ratio of the held-out RMS error to the noise of the geometric calibration.
        """
        design = Design(self.rows.problem, tuple(features))
        noise, prior = self.noise, design.prior(self.prior_scale)
        if start is not None:
            noise, prior = (
                start.posterior.noise,
                design.prior_with_scales_of(start.design, start.posterior.prior),
            )
        if sizes is not None:
            prior = replace(prior, group_scales=torch.cat([prior.group_scales[: -len(sizes)], sizes]))
        chosen = self._regression.select(design)
        posterior = chosen.maximise_evidence(prior, noise, tolerance=ROUGH_TOLERANCE)
        errors = chosen.held_out_errors(posterior, self._folds)
        return FeatureFit(design, posterior, held_out_errors=errors), errors.rms(posterior.noise, self.noise)

    def _note(self, tried: FeatureFit, share: float, began: float, kept: bool) -> None:
        """Add a trial to the table of trials."""
        seconds, evidence = time.monotonic() - began, tried.posterior.log_evidence
        self.trials.append(Trial(tried.name, tried.design.unknowns, evidence, share, seconds, kept))

    def select_features(
        self,
        growing_features: Sequence[AbstractFeature],
        other_features: Sequence[AbstractFeature],
        final_features: Sequence[AbstractFeature] = (),
    ) -> FeatureFit:
        """Select features greedily: other features first, then growing features as long as they improve the fit.

        With few rows, individual features cannot be distinguished from the noise that missing features cause, so all
        features are also tried together.

        Args:
            growing_features: features of one name with increasing sizes.
            other_features: features that are tried before the growing features, and again after them if they did not
                help.
            final_features: features that are tried at the end; they must clearly reduce the held-out errors.
        """
        best = self.fit_without_features
        for chosen in other_features:
            best = self._tried([*best.design.features, chosen], best)
        before, failures, grown = best.design.features, 0, False
        for chosen in growing_features:
            tried = self._tried([*before, chosen], best)
            failures, grown = (failures + 1, grown) if tried is best else (0, True)
            best = tried
            if failures == _MAX_FAILURES:
                break
        for chosen in other_features if grown else ():
            if chosen not in before:
                best = self._tried([*best.design.features, chosen], best)
        together = [*other_features, *growing_features[:FIRST_MODEL_SIZES][-1:]]
        if len(together) > 1 and self.rows.groups <= _FEW_TOGETHER:
            usual = tuple(max(scale, MIN_USUAL_SCALE) for scale in self.prior_scale)
            for scale in dict.fromkeys((tuple(self.prior_scale), usual)):
                best = self._from_usual_sizes(together, scale, best)
        for chosen in final_features:
            gain, sizes = self._regression.evidence_gain(best.posterior, best.design, chosen)
            if gain > CLEAR_EVIDENCE / 2:
                best = self._tried([*best.design.features, chosen], best, sizes, least_gain=CLEAR_GAIN)
        return best

    def try_derived_feature(
        self, best: FeatureFit, feature: AbstractFeature | None, log_odds_against: float = 0.0
    ) -> FeatureChoice:
        """Finish the search, after trying a feature that was derived from its result.

        Args:
            best: the best fit so far.
            feature: feature that was chosen by its gain on the same rows; None for no feature.
            log_odds_against: logarithm of the prior odds against the feature, which the gain of log evidence must
                exceed.
        """
        if feature is not None:
            largest = [*best.design.features, feature]
            design = Design(self.rows.problem, tuple(largest))
            self._regression = extend_regression(self._regression, design, self.rows)
            self._order = [one.name for one in largest]
            best = self._tried(largest, best, odds=log_odds_against)
        same = self._regression.design.features == best.design.features
        return FeatureChoice(
            self.rows, self.fit_without_features, best, tuple(self.trials), self._regression if same else None
        )

    def _tried(
        self,
        features: Sequence[AbstractFeature],
        best: FeatureFit,
        sizes: Tensor | None = None,
        odds: float = 0.0,
        least_gain: float = -math.inf,
    ) -> FeatureFit:
        """Return the better of a fit with new features and the best fit so far, by evidence and held-out errors."""
        # Use the order of the largest design, whose equations need not be copied if all features are tried.
        features = sorted(features, key=lambda one: self._order.index(one.name))
        self.progress(" + ".join(chosen.label for chosen in features))
        began = time.monotonic()
        tried, held_out = self.fit_features(features, best, sizes)
        better = (
            tried.posterior.log_evidence - best.posterior.log_evidence > CLEAR_EVIDENCE + odds
            and held_out < self._least * _LEVEL
            and tried.gain_in_standard_errors(best) > least_gain
            and self._regression.absorbed_share(tried.posterior) < _MAX_EFFECTIVE_SHARE
        )
        self._note(tried, held_out / self._unit, began, better)
        if better:
            self._least = min(self._least, held_out)
        return tried if better else best

    def _from_usual_sizes(
        self, features: Sequence[AbstractFeature], prior_scale: Sequence[float], best: FeatureFit
    ) -> FeatureFit:
        """Return the better of a fit of all features, starting with usual sizes, and the best fit so far.

        If features have been kept already, strong evidence is sufficient, because few rows cannot give more. Otherwise,
        very strong evidence is required.
        """
        self.progress(" + ".join(chosen.label for chosen in features))
        began = time.monotonic()
        design = Design(self.rows.problem, tuple(features))
        fit = self._regression.select(design)
        posterior = fit.maximise_evidence(design.usual_prior(prior_scale), self.noise, _USUAL_UPDATES)
        errors = fit.held_out_errors(posterior, self._folds)
        held_out = errors.rms(posterior.noise, self.noise)
        better = (
            posterior.log_evidence - best.posterior.log_evidence
            > (_STRONG_EVIDENCE if best.design.features else CLEAR_EVIDENCE)
            and held_out < self._least * _LEVEL
            and fit.absorbed_share(posterior) < MAX_USUAL_SHARE
        )
        tried = FeatureFit(design, posterior, MAX_USUAL_SHARE, errors)
        self._note(tried, held_out / self._unit, began, better)
        if better:
            self._least = min(self._least, held_out)
        return tried if better else best
