"""Check whether joint values or positions were rounded so coarsely that rounding explains part of the errors."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from pisigma.calibration.geometric.result import CalibrationResult
from pisigma.measurement.dataset import Measurements
from pisigma.robot.description import Robot
from pisigma.validation.checks.check import CheckedCalibration
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.setup_faults.cause import joints_text, length_text
from pisigma.validation.setup_faults.ordered_rows import OrderedRows

STEPS = tuple(factor * 10.0**power for power in (1, 0, -1, -2, -3) for factor in (5, 2, 1))
"""Rounding steps [deg or mm] that are tried, coarsest first."""
_ON_LATTICE = 1e-4
"""Largest distance of a rounded value from a multiple of the step, in steps."""
_MIN_ROWS = 12
_MIN_SHARE = 0.25
"""Share of the squared errors above which rounding is reported."""
_MAX_SHARE = 1.7
"""Largest ratio of the predicted to the observed squared error of rounded rows; the series of joint errors absorbs part
of it."""
_LIKELY = math.log(100.0)
"""Log likelihood ratio above which rounding causes the errors."""
_SIZES = np.geomspace(1e-3, 1e3, 61)
"""Sizes of all other errors that are tried, relative to the noise."""


@dataclass(frozen=True)
class Rounding:
    """Rounding of joint values, and its effect on the errors.

    Attributes:
        steps: rounding step of every joint [rad or m]; 0 for joints that are not rounded.
        rms_error: RMS position error caused by the rounding [m].
        error_share: share of the rows' squared errors that is caused by rounding [1].
    """

    steps: tuple[float, ...]
    rms_error: float
    error_share: float


def check_rounding(checked: CheckedCalibration) -> Iterator[Diagnostic]:
    """Compare the errors that rounding causes with the errors of the rows.

    Joints that were commanded to whole degrees have round values without a rounding error. Therefore the pattern of the
    errors must also agree with rounding: errors must be large where a joint moves the tool far.
    """
    rounding = joint_rounding(checked.geometric, checked.rows)
    if rounding is not None:
        yield Diagnostic(
            kind="rounding",
            severity="warning",
            sentence=f"The joint values are rounded to {_steps_text(checked.robot, rounding.steps)}: this alone "
            f"causes position errors of {length_text(rounding.rms_error)} RMS ({100 * rounding.error_share:.0f} % of "
            "the squared errors of the rows); log them with more decimals.",
            cause="joint_values",
            values={"error_mm": rounding.rms_error * 1e3, "share": rounding.error_share},
        )
    step = (
        _common_step(checked.rows.position.cpu().numpy() * 1e3) if checked.rows.position is not None else 0.0
    )
    errors = checked.errors["geometric"].get("position")
    if step and errors is not None:
        made, rms = (
            step * 1e-3 / 2,
            float(errors.square().sum(1).nanmean().sqrt()),
        )  # sqrt(3) step / sqrt(12)
        if made**2 > _MIN_SHARE * rms**2:
            yield Diagnostic(
                kind="rounding",
                severity="warning",
                sentence=f"The positions are rounded to {step:g} mm: this alone causes errors of "
                f"{length_text(made)} RMS, while those of the rows are {length_text(rms)}; write the positions "
                "with more decimals.",
                cause="positions",
                values={"step_mm": step, "error_mm": made * 1e3},
            )


def joint_rounding(result: CalibrationResult, measurements: Measurements) -> Rounding | None:
    """Return the rounding of joint values that causes part of the errors; None if there is none.

    With the derivative `J` of a row's values, rounding to steps `s` adds the covariance `J diag(s²/12) J^T` of a
    uniform distribution to the covariance of the other errors, `σ² I`. The maximum likelihoods over σ with and
    without rounding are compared.

    Args:
        result: a geometric calibration.
        measurements: the rows of the calibration.
    """
    q = measurements.q.cpu().numpy()
    coupling = result.robot.coupling
    steps = np.zeros(q.shape[1])
    # Coupled axes are rounded before the coupling, so the DH values have no common step.
    if coupling is None:
        unit = np.where(result.robot.revolute, math.degrees(1), 1e3)
        steps = np.array([_common_step(column[:, None]) for column in (q * unit).T]) / unit
    rows = OrderedRows.from_result(result) if steps.any() else None
    if rows is None or len(rows.residual) < _MIN_ROWS:
        return None
    made = rows.joint_derivative * steps / math.sqrt(12)
    # Residuals of a fit are too small, because the parameters absorbed part of the errors.
    left = rows.residual_after_fit * math.sqrt(
        rows.value_count / max(rows.value_count - rows.effective_parameters, 1.0)
    )
    share = float(np.square(made).sum() / max(np.square(left).sum(), 1e-300))
    if not _MIN_SHARE < share < _MAX_SHARE or _gain(left, made) < _LIKELY:
        return None
    position = (made * rows.noise[:, None])[:, :3]
    error = math.sqrt(np.square(position).sum() / len(position))
    return Rounding(tuple(steps.tolist()), error, min(share, 1.0))


def _gain(
    residual: Float64[np.ndarray, "rows values"], made: Float64[np.ndarray, "rows values dof"]
) -> float:
    """Compute the log likelihood ratio of rounding against no rounding."""
    covariance = made @ made.transpose(0, 2, 1)
    sizes, axes = np.linalg.eigh(covariance)
    along = np.square(np.einsum("nvk,nv->nk", axes, residual))

    def likelihood(share: float) -> float:
        variances = share * sizes + np.square(_SIZES)[:, None, None]
        return float((-np.log(variances) - along / variances).sum((1, 2)).max() / 2)

    return likelihood(1.0) - likelihood(0.0)


def _common_step(values: Float64[np.ndarray, "rows columns"]) -> float:
    """Return the coarsest step of which all values are multiples; 0 if there is none."""
    values = values[np.isfinite(values).all(1)]
    if len(values) < _MIN_ROWS or np.ptp(values, 0).min() <= 0:
        return 0.0
    for step in STEPS:
        counts = values / step
        if np.abs(counts - np.round(counts)).max() < _ON_LATTICE:
            return step
    return 0.0


def _steps_text(robot: Robot, steps: Sequence[float]) -> str:
    """Return a text that lists the rounding steps and their joints."""
    texts = []
    for step in dict.fromkeys(step for step in steps if step):
        joints = tuple(joint for joint, one in enumerate(steps) if one == step)
        revolute = robot.revolute[joints[0]]
        size = f"{math.degrees(step):.3g} deg" if revolute else f"{step * 1e3:.3g} mm"
        texts.append(f"{size} ({joints_text(joints)})")
    return " and ".join(texts)
