"""What to measure next, as sentences with figures."""

import functools
import math

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.hybrid.arm import JointCoverage
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.stated_conditions import condition_warnings
from pisigma.reporting.calibration_tables import warning_lines
from pisigma.reporting.page.accuracy import MOSTLY, Accuracy, Limit
from pisigma.reporting.rendering import sentences
from pisigma.validation.held_out.calibration_summary import CalibrationSummary
from pisigma.validation.held_out.judged_rows import JudgedRows

_say = functools.partial(sentences, "report.txt.j2")

Stretch = tuple[float, float]
"""Lowest and highest joint value [rad or m]."""

COVERED = 0.98
"""Of a joint's range; less is a gap worth a sentence."""
NOT_MOVED = 1e-3
"""A joint that was measured over less of its range stood still."""
STILL_FALLING = 0.05
"""Relative gain of the last doubling of rows from which more rows are worth while."""
SURE = 2.0
"""A change of less than so many standard errors may be none."""
LITTLE_KG, LITTLE_C = 0.5, 3.0
"""Payload or temperature that differ by less say nothing of others."""
COVERAGE_OFF = 0.03
"""By how much the share within the 95 % intervals may be off."""


def advice_for(
    model: CalibratedModel,
    summary: CalibrationSummary | None,
    rows: JudgedRows | None,
    accuracies: tuple[Accuracy, ...],
    limit: Limit,
) -> tuple[str, ...]:
    """Say what to measure next and what to trust, the most useful first.

    Args:
        model: the model.
        summary: figures of its calibration; None of other models.
        rows: judged rows, or None.
        accuracies: figures of the accuracy.
        limit: what limits it.
    """
    held_out = [accuracy for accuracy in accuracies if accuracy.held_out]
    of_rows = (
        *_say("other_rows", model, held_out),
        *_say("joint_gaps", _joint_gaps(model, rows), model),
        *_outside(rows),
        *(() if rows is None else condition_warnings(model, rows.measurements)),
    )
    if summary is None:
        return (*of_rows, *_conditions(rows))
    return (
        *(line[:1].upper() + line[1:] for line in warning_lines(summary)),
        *of_rows,
        *_say("weak_parameters", summary.weak_directions, _unsure(summary), f"{SURE:.0f}"),
        *_more_rows(model, summary, limit),
        *_trust(summary),
        *_orientations(model, summary),
        *_conditions(rows),
        *_say("outliers", summary.outliers),
    )


def measured_stretches(
    model: CalibratedModel, q: Float64[Tensor, "rows dof"]
) -> list[tuple[list[Stretch], Stretch]]:
    """Give per joint the stretches of its range that were measured, and the range [rad or m].

    Joints that go all the way round have a range of one turn, and stretches that are the same a turn further.

    Args:
        model: a hybrid keeps its stretches.
        q: measured joint values, for others.
    """
    coverage = model.hybrid.coverage if model.hybrid else JointCoverage.of(model.robot, q)
    result = []
    for j, limits in enumerate(map(tuple, model.robot.limits.tolist())):
        of_joint, rate = coverage.joint == j, float(coverage.rate[j])
        middle, half = coverage.middle[of_joint].tolist(), coverage.half[of_joint].tolist()
        ends = [((m - h) / rate, (m + h) / rate) for m, h in zip(middle, half, strict=True)]
        result.append(_in_range(ends, limits, 2 * math.pi / rate if coverage.turning[j] else None))
    return result


def _in_range(ends: list[Stretch], limits: Stretch, turn: float | None) -> tuple[list[Stretch], Stretch]:
    """Stretches in one turn of a joint that goes all the way round, or within the limits of another."""
    low, high = limits
    if turn is not None and not high - low < turn - 1e-9:
        if any(b - a >= turn - 1e-9 for a, b in ends):
            return [(-turn / 2, turn / 2)], (-turn / 2, turn / 2)
        back = [turn * round((a + b) / (2 * turn)) for a, b in ends]
        return [(a - k, b - k) for (a, b), k in zip(ends, back, strict=True)], (-turn / 2, turn / 2)
    shifts = [0.0] if turn is None else [turn * k for k in range(-2, 3)]
    clipped = [(max(a + shift, low), min(b + shift, high)) for a, b in ends for shift in shifts]
    return sorted((a, b) for a, b in clipped if b > a), limits


def _joint_gaps(model: CalibratedModel, rows: JudgedRows | None) -> list[str]:
    """Name joints whose range was measured in part only."""
    q = model.starts if rows is None or rows.origin == "other" else rows.measurements.q
    if not len(q):
        return []
    gaps = []
    for j, (stretches, (low, high)) in enumerate(measured_stretches(model, q)):
        name, turns = model.robot.joints[j].name, model.robot.revolute[j]
        share = sum(b - a for a, b in stretches) / (high - low) if high > low else 1.0
        if not math.isfinite(high - low) or share >= COVERED:
            continue
        factor, unit = (math.degrees(1.0), "deg") if turns else (1e3, "mm")
        if share < NOT_MOVED:
            gaps.append(f"{name} at {float(q[0, j]) * factor:.0f} {unit} only")
            continue
        ranges = " and ".join(f"{a * factor:.0f} to {b * factor:.0f}" for a, b in stretches)
        whole = f"{low * factor:.0f} to {high * factor:.0f}"
        whole = "a turn" if turns and high - low > 2 * math.pi - 1e-6 else whole
        gaps.append(f"{name} {ranges} {unit} ({100 * share:.0f} % of {whole})")
    return gaps


def _outside(rows: JudgedRows | None) -> tuple[str, ...]:
    if rows is None or bool(rows.inside.all()):
        return ()
    after = rows.after.position.numpy() * 1e3
    apart = [after[mask & np.isfinite(after)] for mask in (~rows.inside.numpy(), rows.inside.numpy())]
    rms = [float(np.sqrt((errors**2).mean())) if len(errors) else None for errors in apart]
    return _say("rows_outside", int((~rows.inside).sum()), rows.measurements.rows, *rms)


def _unsure(summary: CalibrationSummary) -> list[str]:
    """Names of the parameters whose change from nominal may be none."""
    return [
        row.name
        for row in summary.parameters
        if row.standard_error and row.change is not None and abs(row.change) < SURE * row.standard_error
    ]


def _more_rows(model: CalibratedModel, summary: CalibrationSummary, limit: Limit) -> tuple[str, ...]:
    points = summary.learning_curve or ()
    if len(points) > 1:
        before, last = ((point.rows, list(point.models.values())[-1].rms_mm or 0.0) for point in points[-2:])
        gain = 1 - last[1] / before[1]
        doublings = math.log2(last[0] / before[0])
        each = 1 - (1 - gain) ** (1 / doublings) if doublings > 0 and gain < 1 else 0.0
        return _say("more_rows", before, last, max(each, 0.0), each >= STILL_FALLING)
    if limit.share is None or limit.share >= MOSTLY:
        return ()
    return _say("little_scatter", limit.share, model.provenance.rows)


def _trust(summary: CalibrationSummary) -> tuple[str, ...]:
    coverage = None if summary.judged is None else summary.judged.coverage
    return () if coverage is None or abs(coverage - 0.95) < COVERAGE_OFF else _say("trust", coverage)


def _orientations(model: CalibratedModel, summary: CalibrationSummary) -> tuple[str, ...]:
    sensors = [noise.sensor for noise in summary.noise]
    return () if not sensors or "rotation" in sensors or len(model.tools) > 2 else _say("no_orientations")


def _conditions(rows: JudgedRows | None) -> list[str]:
    """Say which payload and temperature the figures hold for, where a file could have stated them."""
    if rows is None or (rows.origin == "held_out" and rows.measurements.position is None):
        return []
    lines: list[str] = []
    for values, name, unit, little in (
        (rows.measurements.payload, "payload", "kg", LITTLE_KG),
        (rows.measurements.temperature, "temperature", "°C", LITTLE_C),
    ):
        stated = torch.zeros(0) if values is None else values[torch.isfinite(values)]
        low, high = (float(stated.min()), float(stated.max())) if len(stated) else (None, None)
        if low is None or high is None or high - low < little:
            lines += _say("condition", name, unit, low, high)
    return lines
