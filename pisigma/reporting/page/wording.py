"""Findings of a report and advice as titles and sentences, whose wording is in the template `report.txt.j2`."""

import functools
import math

import torch

from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.stated_conditions import condition_warnings
from pisigma.reporting.calibration_tables import cross_validation_text, warning_lines
from pisigma.reporting.rendering import render_sentences
from pisigma.reporting.result_text import Table
from pisigma.validation.held_out.calibration_summary import CalibrationSummary, has_orientation
from pisigma.validation.held_out.judged_rows import JudgedRows
from pisigma.validation.report.accuracy import DOMINANT_SHARE, Accuracy, RowOrigin, ScatterContribution
from pisigma.validation.report.arm_in_images import ArmInImages
from pisigma.validation.report.corrections import CorrectionCurve, outside_errors, partly_measured_joints
from pisigma.validation.report.dependence import Dependence, ErrorsByFrameOrTarget
from pisigma.validation.report.error_map import ErrorMap, Layer, Quantity

MODEL_LABELS = {
    "nominal": "nominal",
    "geometric": "geometric",
    "hybrid": "hybrid",
    "corrected": "with the network",
    "full": "full solution",
    "distilled": "distilled",
}
"""Column headings by the name of the model."""
TITLES: dict[RowOrigin, str] = {
    "file": "rows of the file",
    "training": "rows of the calibration",
    "test": "test set",
    "cross_validation": "held-out rows",
    "simulation": "held-out rows",
    "poses": "held-out poses",
}
"""Titles of the tables of errors by the origin of the rows."""
LAYER_LABELS: dict[Quantity, str] = {
    "before": "before (nominal)",
    "after": "after calibration",
    "predicted": "predicted accuracy",
    "before_deg": "orientation, before",
    "after_deg": "orientation, after",
    "correction": "correction",
    "distance": "distance",
    "turn": "rotation",
}
"""Labels of the values that an error map shows, by layer."""

say = functools.partial(render_sentences, "report.txt.j2")
"""Fill in a macro of `report.txt.j2`; see `sentences`."""


def rows_text(accuracy: Accuracy) -> str:
    """Return a text on the rows to which the errors belong and the models that predicted them."""
    figures = accuracy.validation
    folds = cross_validation_text(figures) if figures is not None and (figures.folds or 1) > 1 else ""
    return say("judged_rows", accuracy, folds)[0]


def dependence_text(dependence: Dependence) -> str:
    """Return sentences on whether errors depend on a quantity."""
    return " ".join(say("dependence", dependence, dependence.test))


def frame_or_target_text(errors: ErrorsByFrameOrTarget) -> str:
    """Return a sentence on whether errors differ between frames or targets."""
    return say("by_name", errors)[0]


def map_text(error_map: ErrorMap) -> str:
    """Return a text on the points that an error map shows."""
    return say("map", error_map)[0]


def layer_text(layer: Layer, error_map: ErrorMap) -> str:
    """Return a text on the values of a layer of an error map."""
    return say("layer", layer.key, error_map.row_role)[0]


def curve_text(curve: CorrectionCurve) -> str:
    """Return a text on the size of the correction of a joint and its measured range."""
    return say("curve", curve)[0]


def zeros_table(arm: ArmInImages) -> Table:
    """Return a table of the zeros of the joints."""
    rows = [
        (one.joint, "", "", "not found: base and tool have the same effect")
        if one.standard_error_deg is None
        else (one.joint, f"{one.zero_shift_deg:+.2f}", f"{one.standard_error_deg:.2f}", "found")
        for one in arm.zeros
    ]
    return Table(("joint", "error of the zero [deg]", "std. error [deg]", "remark"), tuple(rows))


def arm_sentence(arm: ArmInImages) -> str:
    """Return a sentence on the errors of both arms in the images."""
    before, after = arm.nominal_rms * 1e3, arm.calibrated_rms * 1e3
    times = f"{before / after:.1f} times smaller: it is halved {arm.error_halvings:.1f} times"
    change = times if after < before else "not smaller"
    fitted = (
        "these images" if arm.training_images == len(arm.images) else f"{arm.training_images} of these images"
    )
    remark = f" The calibrated arm was fitted to {fitted}; errors in new images are larger."
    return (
        f"In {len(arm.images)} images, the board is {before:.3g} mm RMS from where the nominal arm predicts it (base "
        f"and tool fitted), and {after:.3g} mm from where the calibrated arm predicts it; the error is {change}."
        f"{remark if arm.training_images else ''}"
    )


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
    limit: ScatterContribution,
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
    held_out = [accuracy for accuracy in accuracies if accuracy.is_held_out]
    of_rows = (
        *say("other_rows", model, held_out),
        *say("joint_gaps", partly_measured_joints(model, rows), model),
        *say("rows_outside", outside_errors(rows)),
        *(() if rows is None or _are_stored(rows) else condition_warnings(model, rows.measurements)),
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


def _more_rows(
    model: CalibratedModel, summary: CalibrationSummary, limit: ScatterContribution
) -> tuple[str, ...]:
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
    return (
        () if not summary.noise or has_orientation(model) or len(model.tools) > 2 else say("no_orientations")
    )


def _conditions(rows: JudgedRows | None) -> list[str]:
    """Return sentences on the payload and the temperature for which the figures are valid."""
    if rows is None or _are_stored(rows):
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


def _are_stored(rows: JudgedRows) -> bool:
    """Return whether the rows are those that a model folder stores, which does not store their conditions."""
    return rows.row_role == "held_out" and rows.measurements.position is None
