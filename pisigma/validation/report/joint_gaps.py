"""Parts of the joint ranges that were not measured, and the errors of rows beyond the measured joint values."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.hybrid.arm import JointCoverage
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.validation.held_out.judged_rows import JudgedRows

Stretch = tuple[float, float]
"""Lowest and highest joint value [rad or m]."""

_COVERED = 0.98
"""Share of a joint's range above which no gap is reported."""
_NOT_MOVED = 1e-3
"""Share of a joint's range below which the joint is treated as not moved."""


@dataclass(frozen=True)
class JointGap:
    """A joint whose range was only partially measured.

    Attributes:
        joint: name of the joint.
        unit: "deg" or "mm", of all values.
        measured: measured stretches of the range; the constant value if the joint was not moved.
        range: the whole range.
        measured_share: share of the range that was measured.
        whole_turn: whether the range is one revolution.
    """

    joint: str
    unit: str
    measured: tuple[Stretch, ...]
    range: Stretch
    measured_share: float
    whole_turn: bool

    @property
    def was_moved(self) -> bool:
        """Whether the joint was moved at all."""
        return self.measured_share >= _NOT_MOVED


@dataclass(frozen=True)
class OutsideErrors:
    """Errors of rows with joint values beyond the values with which the model was calibrated.

    Attributes:
        outside: number of rows beyond the calibrated joint values.
        rows: number of all rows.
        rms_outside: RMS position error of these rows [mm]; None if unknown.
        rms_inside: RMS position error of the other rows [mm]; None if unknown.
    """

    outside: int
    rows: int
    rms_outside: float | None
    rms_inside: float | None


def joint_gaps(model: CalibratedModel, rows: JudgedRows | None) -> tuple[JointGap, ...]:
    """Return the joints whose range was only partially measured.

    Args:
        model: the model.
        rows: evaluated rows, whose joint values are used unless they belong to another file; None for the joint values
            that the model stores.
    """
    q = model.starts if rows is None or rows.origin == "other" else rows.measurements.q
    if not len(q):
        return ()
    gaps = []
    for j, (stretches, (low, high)) in enumerate(measured_intervals(model, q)):
        revolute = bool(model.robot.revolute[j])
        share = sum(b - a for a, b in stretches) / (high - low) if high > low else 1.0
        if not math.isfinite(high - low) or share >= _COVERED:
            continue
        factor, unit = (math.degrees(1.0), "deg") if revolute else (1e3, "mm")
        measured = stretches if share >= _NOT_MOVED else [(float(q[0, j]), float(q[0, j]))]
        gaps.append(
            JointGap(
                joint=model.robot.joints[j].name,
                unit=unit,
                measured=tuple((a * factor, b * factor) for a, b in measured),
                range=(low * factor, high * factor),
                measured_share=share,
                whole_turn=revolute and high - low > 2 * math.pi - 1e-6,
            )
        )
    return tuple(gaps)


def outside_errors(rows: JudgedRows | None) -> OutsideErrors | None:
    """Return errors of rows beyond the measured joint values and of other rows; None if there are no such rows."""
    if rows is None or bool(rows.inside.all()):
        return None
    after = rows.after.position.numpy() * 1e3
    apart = [after[mask & np.isfinite(after)] for mask in (~rows.inside.numpy(), rows.inside.numpy())]
    rms = [float(np.sqrt((errors**2).mean())) if len(errors) else None for errors in apart]
    return OutsideErrors(int((~rows.inside).sum()), rows.measurements.rows, rms[0], rms[1])


def measured_intervals(
    model: CalibratedModel, q: Float64[Tensor, "rows dof"]
) -> list[tuple[list[Stretch], Stretch]]:
    """Return the measured stretches of every joint and its range [rad or m].

    The range of a joint without limits is one revolution, to which its measured stretches are wrapped.

    Args:
        model: the model; a hybrid stores the stretches with which it was calibrated.
        q: measured joint values [rad or m], for models that store no ranges.
    """
    coverage = model.hybrid.coverage if model.hybrid else JointCoverage.from_joints(model.robot, q)
    result = []
    for j, limits in enumerate(map(tuple, model.robot.limits.tolist())):
        of_joint, rate = coverage.joint == j, float(coverage.angle_per_value[j])
        middle, half = coverage.middle[of_joint].tolist(), coverage.half[of_joint].tolist()
        ends = [((m - h) / rate, (m + h) / rate) for m, h in zip(middle, half, strict=True)]
        result.append(_in_range(ends, limits, 2 * math.pi / rate if coverage.is_periodic[j] else None))
    return result


def _in_range(ends: list[Stretch], limits: Stretch, turn: float | None) -> tuple[list[Stretch], Stretch]:
    """Return stretches wrapped to one revolution of a joint without limits, or clipped to the joint's limits."""
    low, high = limits
    if turn is not None and not high - low < turn - 1e-9:
        if any(b - a >= turn - 1e-9 for a, b in ends):
            return [(-turn / 2, turn / 2)], (-turn / 2, turn / 2)
        back = [turn * round((a + b) / (2 * turn)) for a, b in ends]
        return [(a - k, b - k) for (a, b), k in zip(ends, back, strict=True)], (-turn / 2, turn / 2)
    shifts = [0.0] if turn is None else [turn * k for k in range(-2, 3)]
    clipped = [(max(a + shift, low), min(b + shift, high)) for a, b in ends for shift in shifts]
    return sorted((a, b) for a, b in clipped if b > a), limits
