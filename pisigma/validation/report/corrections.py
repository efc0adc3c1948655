"""What a model knows of its joints: curves of the correction, unmeasured ranges, and correlations of parameters."""

import csv
import io
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from pisigma.calibration.hybrid.arm import JointCoverage
from pisigma.files.model_files import CORRELATION_CSV, read_model_file
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.tolerances import MEASURED_ROUNDING
from pisigma.validation.held_out.judged_rows import JudgedRows

_POINTS_PER_CURVE = 1_500
"""Number of points of a curve, which gives 13 points per period of the 110th harmonic over a revolution."""
_ROWS_PER_CHUNK = 4_096
"""Number of rows for which the correction is computed at a time, to limit the memory."""
_STRONG_CORRELATION = 0.9
"""Absolute correlation above which a pair of parameters is listed."""
_MAX_PAIRS = 12
"""Largest number of pairs that are listed."""
JOINT_UNITS = {
    "revolute": ("deg", math.degrees(1.0), "mdeg", math.degrees(1e3)),
    "prismatic": ("mm", 1e3, "µm", 1e6),
}
"""Units of a joint's value and of its correction, each followed by its factor from [rad] or [m]."""

Correlations = tuple[tuple[str, ...], Float64[np.ndarray, "_names _names"]]
"""Names of parameters, and the matrix of their correlations."""


@dataclass(frozen=True, eq=False)
class ParameterCorrelations:
    """Correlations of the columns of the identification Jacobian.

    Attributes:
        tables: names and matrix of lengths and of angles; empty if the folder does not store them.
        pairs: pairs of strongly correlated parameters with their correlation, strongest first.
    """

    tables: tuple[Correlations, ...]
    pairs: tuple[tuple[str, str, float], ...]


def parameter_correlations(folder: Path) -> ParameterCorrelations:
    """Return the correlations that a model folder stores."""
    tables = read_correlations(folder / CORRELATION_CSV)
    return ParameterCorrelations(tables, _pairs(tables))


def read_correlations(path: Path) -> tuple[Correlations, ...]:
    """Return the correlations of lengths and of angles; empty if the file is missing or has another form."""
    if not path.is_file():
        return ()
    kinds: dict[str, dict[tuple[str, str], float]] = {"lengths": {}, "angles": {}}
    tables = []
    try:
        text = read_model_file(path.parent, path.name).decode()
        for row in csv.DictReader(io.StringIO(text, newline="")):
            value = float(row["correlation"]) if row["correlation"] else np.nan
            kinds[row["of"]][row["parameter"], row["with"]] = value
        for cells in kinds.values():
            names = tuple(dict.fromkeys(name for name, _ in cells))
            values = np.array([[cells[a, b] for b in names] for a in names])
            tables.append((names, values.reshape(len(names), -1)))
    except (KeyError, ValueError, TypeError, OSError):
        return ()
    return tuple(tables)


def _pairs(tables: tuple[Correlations, ...]) -> tuple[tuple[str, str, float], ...]:
    """Return pairs of strongly correlated parameters, strongest first."""
    strong = [
        (name, names[k], float(values[i, k]))
        for names, values in tables
        for i, name in enumerate(names)
        for k in range(i)
        if abs(values[i, k]) >= _STRONG_CORRELATION
    ]
    return tuple(sorted(strong, key=lambda pair: -abs(pair[2]))[:_MAX_PAIRS])


@dataclass(frozen=True, eq=False)
class CorrectionCurve:
    """Learned correction of a joint against its value, with the other joints at the values of a measured row.

    Attributes:
        joint: name of the joint.
        unit: unit of the joint values, "deg" or "mm".
        correction_unit: unit of the correction, "mdeg" or "µm".
        values: joint values [`unit`].
        correction: correction at these values [`correction_unit`].
        measured: whether each value was measured for the calibration.
        row_corrections: corrections at the measured rows that the model stores [`correction_unit`].
        row_values: joint values of these rows [`unit`].
    """

    joint: str
    unit: str
    correction_unit: str
    values: Float64[np.ndarray, " points"]
    correction: Float64[np.ndarray, " points"]
    measured: Bool[np.ndarray, " points"]
    row_corrections: Float64[np.ndarray, " dots"]
    row_values: Float64[np.ndarray, " dots"]

    @property
    def rms(self) -> float:
        """RMS correction at the measured rows [`correction_unit`]."""
        return float(np.sqrt((self.row_corrections**2).mean()))

    @property
    def largest(self) -> float:
        """Largest absolute correction at the measured rows [`correction_unit`]."""
        return float(np.abs(self.row_corrections).max())

    @property
    def measured_range(self) -> tuple[float, float] | None:
        """Lowest and highest measured value [`unit`]; None if the whole curve, or none of it, was measured."""
        inside = self.values[self.measured]
        low, high = inside.min(initial=math.inf), inside.max(initial=-math.inf)
        return (float(low), float(high)) if not self.measured.all() and high > low else None


def correction_curves(model: CalibratedModel) -> tuple[CorrectionCurve, ...]:
    """Compute the curves of all corrected joints; empty for a model without a learned correction.

    The other joints have their values in the stored row that is nearest to the median of all rows.
    """
    robot, hybrid, q = model.robot, model.hybrid, model.starts
    if (hybrid is None and model.network is None) or not len(q):
        return ()
    at_rows, middle = correction_at(model, q), _middle_row(q)
    curves = []
    for j in range(robot.dof):
        at = middle.repeat(_POINTS_PER_CURVE, 1)
        at[:, j] = torch.linspace(*_range(robot, q, j), _POINTS_PER_CURVE, dtype=torch.float64)
        measured = torch.ones(_POINTS_PER_CURVE, dtype=torch.bool)
        if hybrid is not None:
            measured = hybrid.coverage.distance_outside(at)[:, j] <= MEASURED_ROUNDING
        curve = correction_at(model, at)[:, j]
        if not (bool((curve != 0).any()) or bool((at_rows[:, j] != 0).any())):
            continue
        unit, factor, correction_unit, small = JOINT_UNITS[robot.joints[j].type]
        curves.append(
            CorrectionCurve(
                joint=robot.joints[j].name,
                unit=unit,
                correction_unit=correction_unit,
                values=at[:, j].numpy() * factor,
                correction=curve.numpy() * small,
                measured=measured.numpy(),
                row_corrections=at_rows[:, j].numpy() * small,
                row_values=q[:, j].numpy() * factor,
            )
        )
    return tuple(curves)


def correction_at(model: CalibratedModel, q: Float64[Tensor, "rows dof"]) -> Float64[Tensor, "rows dof"]:
    """Compute the learned correction [rad or m] at joint values [rad or m]."""
    hybrid, chunks = model.hybrid, torch.split(q, _ROWS_PER_CHUNK)
    with torch.no_grad():
        if hybrid is not None:
            return torch.cat([hybrid.correction(chunk) for chunk in chunks])
        return torch.cat(
            [model.correction(forward_kinematics(model.robot, chunk), chunk) for chunk in chunks]
        )


def _middle_row(q: Float64[Tensor, "rows dof"]) -> Float64[Tensor, " dof"]:
    spread = (q.amax(0) - q.amin(0)).clamp(min=1e-9)
    off = ((q - q.median(0).values) / spread).square().sum(-1)
    return q[int(off.argmin())]


def _range(robot: Robot, q: Float64[Tensor, "rows dof"], joint: int) -> tuple[float, float]:
    """Return the measured range of a joint, widened by a fifth on either side, within its limits [rad or m]."""
    low, high = float(q[:, joint].min()), float(q[:, joint].max())
    more = max((high - low) / 5, math.radians(20) if robot.revolute[joint] else 0.02)
    lower, upper = robot.limits[joint]
    return max(low - more, float(lower)), min(high + more, float(upper))


Stretch = tuple[float, float]
"""Lowest and highest joint value [rad or m]."""

_COVERED = 0.98
"""Share of a joint's range above which no gap is reported."""
_NOT_MOVED = 1e-3
"""Share of a joint's range below which the joint is treated as not moved."""


@dataclass(frozen=True)
class PartlyMeasuredJoint:
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
        rows_outside: number of rows beyond the calibrated joint values.
        rows: number of all rows.
        rms_outside_mm: RMS position error of these rows [mm]; None if unknown.
        rms_inside_mm: RMS position error of the other rows [mm]; None if unknown.
    """

    rows_outside: int
    rows: int
    rms_outside_mm: float | None
    rms_inside_mm: float | None


def partly_measured_joints(
    model: CalibratedModel, rows: JudgedRows | None
) -> tuple[PartlyMeasuredJoint, ...]:
    """Return the joints whose range was only partially measured.

    Args:
        model: the model.
        rows: evaluated rows, whose joint values are used unless they belong to another file; None for the joint values
            that the model stores.
    """
    q = model.starts if rows is None or rows.row_role == "other" else rows.measurements.q
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
            PartlyMeasuredJoint(
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
    if rows is None or bool(rows.is_inside_range.all()):
        return None
    after = rows.model_errors.position.numpy() * 1e3
    apart = [
        after[mask & np.isfinite(after)]
        for mask in (~rows.is_inside_range.numpy(), rows.is_inside_range.numpy())
    ]
    rms = [float(np.sqrt((errors**2).mean())) if len(errors) else None for errors in apart]
    return OutsideErrors(int((~rows.is_inside_range).sum()), rows.measurements.rows, rms[0], rms[1])


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
        middle, half = coverage.middle[of_joint].tolist(), coverage.half_width[of_joint].tolist()
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
