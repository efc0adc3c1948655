"""Whether the rows come from two populations: two arms, tools or frames under one name, or correct and wrong rows."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64

from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.registry import SENSORS
from pisigma.validation.checks.check import AbstractCheck, CheckedCalibration
from pisigma.validation.checks.rows.distinguishing import what_distinguishes
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.setup_faults.cause import length_text
from pisigma.validation.setup_faults.ordered_rows import OrderedRows
from pisigma.validation.setup_faults.populations import MIN_SHARE, Populations, find_populations

MIN_ROWS = 20
"""With fewer rows, two populations of three components each cannot be distinguished."""
APART = 4.0
"""Distance of a population over the scatter of the other above which it is separate. Residuals of healthy robots are a
mixture with ratios of up to 2.5, because the unexplained errors depend on the pose."""
CERTAIN = 30.0
"""Log Bayes factor above which rows differ. For one arm, unmodelled gear errors and sag give factors of up to 90 with
frames, and of up to 30 otherwise, but small differences."""
LARGE = {"tool": 1.6, "frame": 2.2, "arm": 2.2}
"""Errors over those without the difference above which there are two populations. For one arm (simulated with gear
errors and sag, and measured: UR5, UR10, FANUC R-2000iC) the ratio is 1.3, 1.9 and 1.9 at most."""
HARDLY_USED = 0.38
"""Share of the values used up by parameters above which the ratios of one arm grow, because the best of many ways to
split the rows overfits: 24 sets of 60 positions (share 0.35) have 1.7 at most, of 40 positions (0.5) 2.9, and arms of 7
joints (0.63) 3.1."""
IMPLAUSIBLE = 5.0
"""The same ratio for a tool or a frame above which the calibration is wrong; for two arms it always is."""
MAX_ITERATIONS = 200
FLOOR = 1e-6
"""Smallest standard deviation, as a share of the largest residual."""


@dataclass(frozen=True)
class Mixture:
    """Mixture of two normal populations of residuals.

    Attributes:
        share: share of the population with the larger scatter, or of the smaller one if both scatter equally [1].
        off: RMS distance of that population from the mean of the other one, per component [m or rad].
        scatter: RMS distance of the other one from its mean, per component [m or rad].
        log_bayes_factor: logarithm of the odds against one population, by the Bayesian information criterion (Schwarz
            1978, Annals of Statistics 6, 461-464).
    """

    share: float
    off: float
    scatter: float
    log_bayes_factor: float

    @property
    def are_distinct(self) -> bool:
        """Whether these are two populations, and not the shape of a single one."""
        return (
            self.log_bayes_factor > math.log(100.0)
            and min(self.share, 1 - self.share) >= MIN_SHARE
            and self.off > APART * self.scatter
        )


class TwoPopulationsCheck(AbstractCheck):
    """Looks for rows of another arm, tool or frame; if there are none, for two sizes of errors.

    Up to a tenth of wrong rows are outliers, which the robust loss gives no weight; more need not be. A hybrid has
    smaller residuals, so smaller differences show; but it absorbs a part of large ones, so both calibrations are
    tested.
    """

    def diagnose(self, checked: CheckedCalibration) -> Iterator[Diagnostic]:
        """See `AbstractCheck.diagnose`."""
        learned = (
            checked.hybrid if checked.hybrid is not None and checked.hybrid.learned is not None else None
        )
        for result in (checked.geometric, learned):
            ordered = None if result is None else OrderedRows.from_result(result)
            found = None if ordered is None else find_populations(ordered, checked.rows.rows)
            if found is not None and _differ(found):
                yield _two_populations(checked.rows, found)
                return
        yield from self._two_sizes(checked)

    def _two_sizes(self, checked: CheckedCalibration) -> Iterator[Diagnostic]:
        """Report sensors whose residuals come from two normal populations."""
        for sensor, errors in checked.final_errors.items():
            residuals = np.asarray(errors)
            residuals = residuals[np.isfinite(residuals).all(1)]
            if len(residuals) < MIN_ROWS or not (fit := two_populations(residuals)).are_distinct:
                continue
            unit = "mm" if SENSORS[sensor].unit == "m" else "mrad"
            size, scatter = fit.off * 1e3, fit.scatter * 1e3
            yield Diagnostic(
                kind="two_populations",
                severity="warning",
                sentence=f"{fit.share:.0%} of the values of {sensor} are off by about {size:.2g} {unit}, while the "
                f"others scatter by {scatter:.2g} {unit} per axis: many rows are wrong, or were measured under "
                "different conditions; check whether a target or an instrument was moved or hit.",
                cause="sizes",
                values={"sensor": sensor, "share": fit.share},
            )


def _differ(found: Populations) -> bool:
    """Say whether these are two populations, and not what unmodelled errors of one arm look like."""
    return (
        found.log_bayes_factor > CERTAIN
        and found.factor > LARGE[found.differing] * max((1 - HARDLY_USED) / (1 - found.used), 1.0)
        and int(found.second.sum()) >= MIN_SHARE * found.tried
    )


def _two_populations(rows: Measurements, found: Populations) -> Diagnostic:
    """Report the rows of the smaller population, and how they differ from the others."""
    second = torch.from_numpy(found.second)
    distinction = what_distinguishes(rows, second)
    size, moved = int(second.sum()), f"{length_text(math.hypot(*found.difference[:3]))}"
    difference, advice = {
        "arm": ("belong to another arm than the others", "Calibrate each robot with its own rows"),
        "tool": (
            f"belong to another target than the others, {moved} away on the tool",
            "Name another target in these rows (column 'target'), or leave them out",
        ),
        "frame": (
            "are in another frame than the others, because the instrument or the robot was moved",
            "Name another frame in these rows (column 'frame'), or leave them out",
        ),
    }[found.differing]
    implausible = found.differing == "arm" or found.factor > IMPLAUSIBLE
    return Diagnostic(
        kind="two_populations",
        severity="implausible" if implausible else "warning",
        sentence=f"Two populations are mixed: {size} of {found.tried} rows {difference} ({distinction.clause}); the "
        f"errors of all rows together are {found.factor:.2g} times as large as separately. {advice}.",
        rows=tuple(rows.place(row) for row in second.nonzero()[:, 0].tolist()),
        cause=found.differing,
        values={"factor": found.factor, "distinguished_by": distinction.by},
    )


def two_populations(residuals: Float64[np.ndarray, "rows components"]) -> Mixture:
    """Fit a mixture of two normal populations by expectation maximisation.

    Args:
        residuals: residuals of one sensor [m or rad].
    """
    rows, components = residuals.shape
    centred = residuals - residuals.mean(0)
    floor = (FLOOR * np.abs(centred).max() + 1e-15) ** 2 * np.eye(components)
    # Start with the two halves along the first principal axis: two clusters separate along it.
    key = centred @ np.linalg.svd(centred, full_matrices=False)[2][0]
    weight = (key > np.median(key)).astype(float)
    for _ in range(MAX_ITERATIONS):
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
    alike = abs(determinants[1] - determinants[0]) < 2 * components * math.log(2.0)
    far = int(np.argmin(counts) if alike else np.argmax(determinants))
    return Mixture(
        share=float(counts[far] / rows),
        off=float(np.average(np.square(off[1 - far]).mean(1), weights=members[far])) ** 0.5,
        scatter=float(np.trace(covariances[1 - far]) / components) ** 0.5,
        log_bayes_factor=float(gain) - (components + 1) * (components + 2) / 4 * math.log(rows),
    )
