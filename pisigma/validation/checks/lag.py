"""Check whether joint values were logged before the robot arrived at the pose or after it left."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pisigma.calibration.hybrid.search import CLEAR_EVIDENCE
from pisigma.measurement.conditions import motions_between_rows
from pisigma.measurement.dataset import Measurements
from pisigma.validation.checks.check import CheckedCalibration
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.setup_faults.ordered_rows import OrderedRows

MIN_ROWS = 12
LIKELY = CLEAR_EVIDENCE + math.log(100.0)
"""Log Bayes factor above which a lag is reported."""
NOTICED, _LARGE = 1.1, 1.5
"""Ratios of the errors with and without the lag above which a warning is given, and above which the calibration is
implausible."""


@dataclass(frozen=True)
class Lag:
    """Lag between the logged joint values and the measured pose, as a share of the motion between two rows.

    Attributes:
        logged_before_arrival: whether joint values were logged before the arrival, on the way from the previous row;
            otherwise they were logged after departure.
        share_of_motion: lag as a share of the motion between two rows [1].
        error_increase_factor: ratio of the errors with and without the lag [1].
        log_bayes_factor: logarithm of the odds of a lag against no lag.
    """

    logged_before_arrival: bool
    share_of_motion: float
    error_increase_factor: float
    log_bayes_factor: float


def check_lag(checked: CheckedCalibration) -> Iterator[Diagnostic]:
    """Test the residuals for a share λ of the motions between the rows: `r = X x + λ J Δq + e`.

    `J Δq` is the change of a row's values by the motion from the previous row, or to the next row.
    """
    rows = OrderedRows.from_result(checked.geometric)
    lag = None if rows is None else find_lag(rows, checked.rows)
    if lag is None or lag.log_bayes_factor < LIKELY or lag.error_increase_factor < NOTICED:
        return
    when = "before the robot had arrived" if lag.logged_before_arrival else "after the robot had left"
    motion = "from the previous row" if lag.logged_before_arrival else "to the next row"
    yield Diagnostic(
        kind="lag",
        severity="implausible" if lag.error_increase_factor > _LARGE else "warning",
        sentence=f"The joint values were logged {when}: they differ from those at the measurement by "
        f"{abs(lag.share_of_motion):.2g} of the motion {motion} and make the errors {lag.error_increase_factor:.3g} "
        "times as large; log them when the robot has stopped.",
        cause="before_arrival" if lag.logged_before_arrival else "after_departure",
        values={
            "share": lag.share_of_motion,
            "factor": lag.error_increase_factor,
            "log_odds": lag.log_bayes_factor,
        },
        remedy="Log them when the robot has stopped.",
    )


def find_lag(rows: OrderedRows, measurements: Measurements) -> Lag | None:
    """Fit a lag to the residuals of a calibration, whether it is likely or not; None if there are too few rows.

    Args:
        rows: residuals of a calibration.
        measurements: the rows of the calibration.
    """
    if len(rows.residual) < MIN_ROWS:
        return None
    rows, found = rows.with_estimated_noise, []
    for before, motion in zip((True, False), motions_between_rows(measurements), strict=True):
        z = (rows.joint_derivative @ np.nan_to_num(motion[rows.row_index])[..., None]).reshape(-1, 1)
        free = rows.project_out_parameters(z)
        if (free**2).sum() > 1e-12 * (z**2).sum():
            effect = rows.evidence_of(free)
            found.append(
                Lag(
                    before,
                    float(effect.effect_sizes[0]),
                    effect.error_increase_factor,
                    effect.log_bayes_factor,
                )
            )
    return max(found, key=lambda lag: lag.log_bayes_factor, default=None)
