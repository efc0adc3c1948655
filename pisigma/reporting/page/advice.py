"""Advice on further measurements and on the trust in a model, as sentences with figures."""

import math

import torch

from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.stated_conditions import condition_warnings
from pisigma.reporting.calibration_tables import warning_lines
from pisigma.reporting.page.wording import say
from pisigma.validation.held_out.calibration_summary import CalibrationSummary
from pisigma.validation.held_out.judged_rows import JudgedRows
from pisigma.validation.report.accuracy import DOMINANT_SHARE, Accuracy, AccuracyLimit
from pisigma.validation.report.joint_gaps import joint_gaps, outside_errors

_MIN_GAIN_PER_DOUBLING = 0.05
"""Relative gain of the last doubling of rows above which more rows are recommended."""
_SIGNIFICANT_ERRORS = 2.0
"""Standard errors below which a change from nominal is not significant."""
_SMALL_RANGE_KG, _SMALL_RANGE_C = 0.5, 3.0
"""Ranges of payload [kg] and temperature [°C] below which rows do not show the effect of other values."""
_COVERAGE_TOLERANCE = 0.03
"""Largest deviation from 0.95 of the share within 95 % intervals that is not reported."""


def advice_for(
    model: CalibratedModel,
    summary: CalibrationSummary | None,
    rows: JudgedRows | None,
    accuracies: tuple[Accuracy, ...],
    limit: AccuracyLimit,
    causes: tuple[str, ...] = (),
) -> tuple[str, ...]:
    """Return recommendations for measuring and for the use of a model, the most useful one first.

    Args:
        model: the model.
        summary: figures of its calibration; None for other models.
        rows: evaluated rows, or None.
        accuracies: figures of the errors.
        limit: contribution of measurement scatter to the error.
        causes: diagnosed causes of the errors with their remedies; these sentences come first.
    """
    held_out = [accuracy for accuracy in accuracies if accuracy.held_out]
    of_rows = (
        *say("other_rows", model, held_out),
        *say("joint_gaps", joint_gaps(model, rows), model),
        *say("rows_outside", outside_errors(rows)),
        *(() if rows is None else condition_warnings(model, rows.measurements)),
    )
    if summary is None:
        return _once(*causes, *of_rows, *_conditions(rows))
    unsure = _unsure(summary)
    return _once(
        *causes,
        *warning_lines(summary),
        *of_rows,
        *say("weak_parameters", summary.weak_directions, unsure, f"{_SIGNIFICANT_ERRORS:.0f}"),
        *_more_rows(model, summary, limit),
        *_trust(summary),
        *_orientations(model, summary),
        *_conditions(rows),
        *say("outliers", summary.outliers),
    )


def _once(*lines: str) -> tuple[str, ...]:
    """Return the lines without repetitions, in order."""
    return tuple(dict.fromkeys(lines))


def _unsure(summary: CalibrationSummary) -> list[str]:
    """Return the names of the parameters whose change from nominal is not significant."""
    return [
        row.name
        for row in summary.parameters
        if row.standard_error
        and row.change is not None
        and abs(row.change) < _SIGNIFICANT_ERRORS * row.standard_error
    ]


def _more_rows(model: CalibratedModel, summary: CalibrationSummary, limit: AccuracyLimit) -> tuple[str, ...]:
    points = summary.learning_curve or ()
    if len(points) > 1:
        before, last = ((point.rows, list(point.models.values())[-1].rms_mm or 0.0) for point in points[-2:])
        gain = 1 - last[1] / before[1]
        doublings = math.log2(last[0] / before[0])
        each = 1 - (1 - gain) ** (1 / doublings) if doublings > 0 and gain < 1 else 0.0
        return say("more_rows", before, last, max(each, 0.0), each >= _MIN_GAIN_PER_DOUBLING)
    if limit.scatter_share is None or limit.scatter_share >= DOMINANT_SHARE:
        return ()
    return say("little_scatter", limit.scatter_share, model.provenance.rows)


def _trust(summary: CalibrationSummary) -> tuple[str, ...]:
    coverage = None if summary.validation_errors is None else summary.validation_errors.coverage
    return () if coverage is None or abs(coverage - 0.95) < _COVERAGE_TOLERANCE else say("trust", coverage)


def _orientations(model: CalibratedModel, summary: CalibrationSummary) -> tuple[str, ...]:
    sensors = [noise.sensor for noise in summary.noise]
    return () if not sensors or "rotation" in sensors or len(model.tools) > 2 else say("no_orientations")


def _conditions(rows: JudgedRows | None) -> list[str]:
    """Return sentences on the payload and the temperature for which the figures are valid."""
    if rows is None or (rows.origin == "held_out" and rows.measurements.position is None):
        return []
    lines: list[str] = []
    for values, name, unit, little in (
        (rows.measurements.payload, "payload", "kg", _SMALL_RANGE_KG),
        (rows.measurements.temperature, "temperature", "°C", _SMALL_RANGE_C),
    ):
        stated = torch.zeros(0) if values is None else values[torch.isfinite(values)]
        low, high = (float(stated.min()), float(stated.max())) if len(stated) else (None, None)
        if low is None or high is None or high - low < little:
            lines += say("condition", name, unit, low, high)
    return lines
