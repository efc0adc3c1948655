"""Whether the rows are of two populations: two arms, tools or frames under one name, or right rows and wrong ones."""

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
from pisigma.validation.setup_faults.populations import SMALLEST_SHARE, Populations, find_populations

FEWEST = 20
"""With fewer rows two populations of three components each are not told apart."""
APART = 4.0
"""Rows that are so many times as far off as the others scatter are others. What a calibration leaves of healthy robots
is a mixture with ratios of up to 2.5, because the unexplained errors depend on the pose."""
CERTAIN = 30.0
"""Log Bayes factor from which on rows differ. What the joints' gears and sag leave of one arm has factors of up to 90
with frames, and of up to 30 else, but small differences."""
LARGE = {"tool": 1.6, "frame": 2.2, "arm": 2.2}
"""Errors that are so many times as large as without the difference come from two populations. Of one arm
(simulated with gears and sag, and measured: UR5, UR10, FANUC R-2000iC) it is 1.3, 1.9 and 1.9 at most."""
HARDLY_USED = 0.38
"""Share of the values from which on the factors of one arm grow, as few of many ways to part the rows leave little: 24
sets of 60 positions (share 0.35) have 1.7 at most, of 40 positions (0.5) 2.9, and arms of 7 joints (0.63) 3.1."""
IMPLAUSIBLE = 5.0
"""Where it is so much for a tool or a frame, the calibration is of neither; two arms never make one calibration."""
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
    """Looks for rows of another arm, tool or frame; where there are none, for two sizes of errors.

    Up to a tenth of wrong rows are outliers, and the robust loss gives them no weight. Of more it need not. A hybrid
    leaves less of the rows, so that smaller differences show; but a large one becomes a part of it, so that both
    calibrations are looked at.
    """

    def diagnose(self, checked: CheckedCalibration) -> Iterator[Diagnostic]:
        """See `AbstractCheck.diagnose`."""
        learned = (
            checked.hybrid if checked.hybrid is not None and checked.hybrid.learned is not None else None
        )
        for result in (checked.geometric, learned):
            ordered = None if result is None else OrderedRows.of(result)
            found = None if ordered is None else find_populations(ordered, checked.rows.rows)
            if found is not None and _differ(found):
                yield _two_populations(checked.rows, found)
                return
        yield from self._two_sizes(checked)

    def _two_sizes(self, checked: CheckedCalibration) -> Iterator[Diagnostic]:
        """Fit two normal populations to the residuals of every sensor."""
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


def _differ(found: Populations) -> bool:
    """Whether these are two populations, and not what the errors of one arm look like."""
    return (
        found.log_bayes_factor > CERTAIN
        and found.factor > LARGE[found.differing] * max((1 - HARDLY_USED) / (1 - found.used), 1.0)
        and int(found.second.sum()) >= SMALLEST_SHARE * found.tried
    )


def _two_populations(rows: Measurements, found: Populations) -> Diagnostic:
    """Say which rows are of the smaller population, and by what they differ."""
    second = torch.from_numpy(found.second)
    size, moved = int(second.sum()), f"{length_text(math.hypot(*found.difference[:3]))}"
    difference, advice = {
        "arm": ("of another arm than the others", "Calibrate each robot with its own rows"),
        "tool": (
            f"of another target than the others, {moved} away on the tool",
            "Name another target in these rows (column 'target'), or leave them out",
        ),
        "frame": (
            "in another frame than the others, as the instrument or the robot was moved",
            "Name another frame in these rows (column 'frame'), or leave them out",
        ),
    }[found.differing]
    implausible = found.differing == "arm" or found.factor > IMPLAUSIBLE
    return Diagnostic(
        kind="two_populations",
        severity="implausible" if implausible else "warning",
        sentence=f"Two populations are mixed: {size} of {found.tried} rows are {difference} "
        f"({what_distinguishes(rows, second)}); together, the errors are {found.factor:.2g} times as large as apart. "
        f"{advice}.",
        rows=tuple(rows.place(row) for row in second.nonzero()[:, 0].tolist()),
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
