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
"""Rows that are so many times as far off as the others scatter are others. What a calibration leaves of healthy robots
is a mixture with ratios of up to 2.5, because the unexplained errors depend on the pose."""
SMALLEST_SHARE = 0.1
"""Of fewer rows the robust loss takes care, which names them as outliers."""
ROUNDS = 200
FLOOR = 1e-6
"""Of a standard deviation, as a share of the largest residual."""


@dataclass(frozen=True)
class Mixture:
    """Two normal populations of residuals.

    Attributes:
        share: of the population that scatters more, or of the smaller one where both scatter alike.
        off: RMS of that population's distance from the mean of the other, per component [m or rad].
        scatter: RMS of the other's distance from its mean, per component [m or rad].
        log_bayes_factor: against one population, by the Bayesian information criterion (Schwarz 1978, Annals of
            Statistics 6, 461-464).
    """

    share: float
    off: float
    scatter: float
    log_bayes_factor: float

    @property
    def apart(self) -> bool:
        """Whether these are two populations, and not the shape of one."""
        return (
            self.log_bayes_factor > math.log(100.0)
            and min(self.share, 1 - self.share) >= SMALLEST_SHARE
            and self.off > APART * self.scatter
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
            size, scatter = fit.off * 1e3, fit.scatter * 1e3
            yield Diagnostic(
                kind="two_populations",
                severity="warning",
                sentence=f"{fit.share:.0%} of the values of {sensor} are off by about {size:.2g} {unit}, where the "
                f"others scatter by {scatter:.2g} {unit} per axis: many rows are wrong, or something was different in "
                "them; look for a target or an instrument that was moved or hit.",
            )


def two_populations(residuals: Float64[np.ndarray, "rows components"]) -> Mixture:
    """Fit two normal populations by expectation maximisation, from the ends of the residuals' longest axis.

    Args:
        residuals: of one sensor [m or rad].
    """
    rows, components = residuals.shape
    centred = residuals - residuals.mean(0)
    floor = (FLOOR * np.abs(centred).max() + 1e-15) ** 2 * np.eye(components)
    key = centred @ np.linalg.svd(centred, full_matrices=False)[2][0]
    weight = (key > np.median(key)).astype(float)
    for _ in range(ROUNDS):
        members = np.stack([1 - weight, weight])
        counts = members.sum(1).clip(1e-9)
        means = members @ residuals / counts[:, None]
        off = residuals - means[:, None]
        covariances = np.einsum("kn,kni,knj->kij", members, off, off) / counts[:, None, None] + floor
        squares = np.einsum("kni,kij,knj->kn", off, np.linalg.inv(covariances), off)
        determinants = np.linalg.slogdet(covariances)[1]
        logs = (np.log(counts / rows) - determinants / 2)[:, None] - squares / 2
        weight = 1 / (1 + np.exp((logs[0] - logs[1]).clip(-500, 500)))
    alone = np.linalg.slogdet(centred.T @ centred / rows + floor)[1]
    gain = np.logaddexp(*logs).sum() + rows / 2 * (alone + components)
    alike = abs(determinants[1] - determinants[0]) < 2 * components * math.log(2.0)
    far = int(np.argmin(counts) if alike else np.argmax(determinants))
    return Mixture(
        share=float(counts[far] / rows),
        off=float(np.average(np.square(off[1 - far]).mean(1), weights=members[far])) ** 0.5,
        scatter=float(np.trace(covariances[1 - far]) / components) ** 0.5,
        log_bayes_factor=float(gain) - (components + 1) * (components + 2) / 4 * math.log(rows),
    )
