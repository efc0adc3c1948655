"""Whether joint values were logged before the robot arrived, or after it had left."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from pisigma.calibration.hybrid.search import CLEARLY
from pisigma.measurement.dataset import Measurements
from pisigma.validation.checks.check import AbstractCheck, CheckedCalibration
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.setup_faults.ordered_rows import OrderedRows

CAP = 3.0
"""Residuals longer than so many times their upper quartile count as so long."""
FEWEST_ROWS = 12
LIKELY = CLEARLY + math.log(100.0)
"""Log Bayes factor from which on a lag is reported."""
NOTICED, LARGE = 1.1, 1.5
"""Errors that are so many times as large as without the lag are worth a warning, and make the calibration
implausible."""


@dataclass(frozen=True)
class Lag:
    """The share of a motion that the logged joint values are away from where the robot was measured.

    Attributes:
        before: whether they were logged before the arrival, on the way from the row before; else after it.
        share: of the motion between two rows.
        factor: how many times as large as without the lag the errors of the rows are.
        log_bayes_factor: logarithm of the odds of a lag against none.
    """

    before: bool
    share: float
    factor: float
    log_bayes_factor: float


class LagCheck(AbstractCheck):
    """Tests residuals against the motions between the rows: `r = X x + λ J Δq + e`.

    `J Δq` is what the motion from the row before, or to the next, would make of a row's values.
    """

    def diagnose(self, checked: CheckedCalibration) -> Iterator[Diagnostic]:
        """See `AbstractCheck.diagnose`."""
        rows = OrderedRows.of(checked.geometric)
        lag = None if rows is None else find_lag(rows, checked.rows)
        if lag is None or lag.log_bayes_factor < LIKELY or lag.factor < NOTICED:
            return
        when = "before the robot had arrived" if lag.before else "after the robot had left"
        motion = "from the row before" if lag.before else "to the next row"
        yield Diagnostic(
            kind="lag",
            severity="implausible" if lag.factor > LARGE else "warning",
            sentence=f"The joint values were logged {when}: they are {abs(lag.share):.2g} of the motion {motion} away "
            f"from where the robot was measured, which makes the errors {lag.factor:.3g} times as large; log them "
            "when the robot stands still.",
        )


def find_lag(rows: OrderedRows, measurements: Measurements) -> Lag | None:
    """Fit a lag to the residuals of a calibration, likely or not; None where there are too few rows.

    Args:
        rows: residuals of a calibration.
        measurements: with which was calibrated.
    """
    if len(rows.residual) < FEWEST_ROWS:
        return None
    lengths = np.linalg.norm(rows.residual, axis=1)
    longest = CAP * np.quantile(lengths, 0.75)
    r = (rows.residual * np.minimum(1.0, longest / np.maximum(lengths, 1e-300))[:, None]).ravel()
    X = rows.X.reshape(len(r), -1)
    covariance, spare = rows.covariance, max(rows.values - rows.used, 1.0)
    left = r - X @ (covariance @ (X.T @ r))
    found = []
    for before, motion in zip((True, False), _motions(measurements), strict=True):
        z = (rows.by_joints @ motion[rows.number][..., None]).reshape(len(r), -1)[:, 0]
        free = z - X @ (covariance @ (X.T @ z))
        information = float(free @ free)
        if information <= 1e-12 * float(z @ z):
            continue
        share = float(free @ left) / information
        ratio = max(1 - share**2 * information / float(left @ left), 1e-12)
        gain = -rows.independent / 2 * math.log(ratio) - math.log(max(rows.independent, 2.0)) / 2
        found.append(Lag(before, share, math.sqrt(spare / max(spare - 1, 1.0) / ratio), gain))
    return max(found, key=lambda lag: lag.log_bayes_factor, default=None)


def _motions(
    measurements: Measurements,
) -> tuple[Float64[np.ndarray, "rows dof"], Float64[np.ndarray, "rows dof"]]:
    """Motions [rad or m] of every row from the row before it, and from the next back to it; 0 beyond a file."""
    q = measurements.q.cpu().numpy()
    order = (
        np.argsort(np.array(measurements.line), kind="stable")
        if not measurements.origin
        else np.arange(len(q))
    )
    origin = np.array(measurements.origin or ("",) * len(q))[order]
    step = np.diff(q[order], axis=0) * (origin[1:] == origin[:-1])[:, None]
    none = np.zeros((1, q.shape[1]))
    before, after = np.empty_like(q), np.empty_like(q)
    before[order], after[order] = np.concatenate([none, step]), np.concatenate([-step, none])
    return before, after
