"""Whether many rows are off beside others that are right."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from pisigma.judging.diagnostic import Diagnostic
from pisigma.sensors.registry import SENSORS
from pisigma.verification.checks.check import AbstractCheck, CheckedCalibration

FEWEST = 20
"""With fewer rows two populations of three components each are not told apart."""
APART = 4.0
"""Populations whose means are so many standard deviations apart, or whose standard deviations have this ratio, are two.
What a calibration leaves of healthy robots is a mixture with ratios of up to 2.5, because the unexplained errors depend
on the pose."""
SMALLEST_SHARE = 0.1
"""Of fewer rows the robust loss takes care, which names them as outliers."""
ROUNDS = 200


@dataclass(frozen=True)
class Mixture:
    """Two normal populations of residuals.

    Attributes:
        share: of the population that is farther off, or of the smaller one where both are equally far.
        distance: between the means [m or rad].
        sigma: standard deviations of a component, the smaller first [m or rad].
        log_bayes_factor: against one population, by the Bayesian information criterion (Schwarz 1978, Annals of
            Statistics 6, 461-464).
    """

    share: float
    distance: float
    sigma: tuple[float, float]
    log_bayes_factor: float

    @property
    def apart(self) -> bool:
        """Whether these are two populations, and not the shape of one."""
        low, high = self.sigma
        return (
            self.log_bayes_factor > math.log(100.0)
            and min(self.share, 1 - self.share) >= SMALLEST_SHARE
            and max(high / low, self.distance / high) > APART
        )


class TwoPopulationsCheck(AbstractCheck):
    """Fits two populations to the residuals of every sensor.

    Up to a tenth of wrong rows are outliers, and the robust loss gives them no weight. Of more it need not.
    """

    def diagnose(self, checked: CheckedCalibration) -> Iterator[Diagnostic]:
        """See `AbstractCheck.diagnose`."""
        for sensor, errors in checked.final_errors.items():
            residuals = np.asarray(errors)
            residuals = residuals[np.isfinite(residuals).all(1)]
            if len(residuals) < FEWEST or not (fit := two_populations(residuals)).apart:
                continue
            unit = "mm" if SENSORS[sensor].unit == "m" else "mrad"
            size, scatter = max(fit.distance, fit.sigma[1]) * 1e3, fit.sigma[0] * 1e3
            yield Diagnostic(
                kind="two_populations",
                severity="warning",
                sentence=f"{fit.share:.0%} of the values of {sensor} are off by about {size:.2g} {unit}, where the "
                f"others scatter by {scatter:.2g} {unit} per axis: many rows are wrong, or something was different in "
                "them; look for a target or an instrument that was moved or hit.",
            )


def two_populations(residuals: Float64[np.ndarray, "rows components"]) -> Mixture:
    """Fit two isotropic normal populations by expectation maximisation, from the ends of the residuals' longest axis.

    Args:
        residuals: of one sensor [m or rad].
    """
    rows, components = residuals.shape
    floor = 1e-12 * float(np.square(residuals).max()) + 1e-30
    centred = residuals - residuals.mean(0)
    key = centred @ np.linalg.svd(centred, full_matrices=False)[2][0]
    weight = (key > np.median(key)).astype(float)
    for _ in range(ROUNDS):
        shares = np.array([1 - weight.mean(), weight.mean()]).clip(1e-9)
        members = np.stack([1 - weight, weight])
        counts = members.sum(1).clip(1e-9)
        means = members @ residuals / counts[:, None]
        squares = np.square(residuals - means[:, None]).sum(2)
        variances = (members * squares).sum(1) / counts / components + floor
        logs = (
            np.log(shares)[:, None]
            - components / 2 * np.log(variances)[:, None]
            - squares / variances[:, None] / 2
        )
        weight = 1 / (1 + np.exp((logs[0] - logs[1]).clip(-500, 500)))
    variance = np.square(centred).sum() / rows / components + floor
    gain = np.logaddexp(*logs).sum() + rows * components / 2 * (np.log(variance) + 1)
    far = (
        int(variances[1] > variances[0])
        if max(variances) > 2 * min(variances)
        else int(shares[1] < shares[0])
    )
    return Mixture(
        float(shares[far]),
        float(np.linalg.norm(means[1] - means[0])),
        (float(min(variances)) ** 0.5, float(max(variances)) ** 0.5),
        float(gain) - (components + 2) / 2 * math.log(rows),
    )
