"""What a card says of a hybrid calibration beyond the geometric one: what was tried and learned, and how sure it is."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pisigma.hybrid.result import HybridResult
from pisigma.judging.calibration_validation import CalibrationValidation
from pisigma.measurement.dataset import Measurements
from pisigma.reporting.hybrid_figures import (
    CORRECTIONS_PNG,
    CURVE_PNG,
    SPREAD_PNG,
    draw_corrections,
    draw_learning_curve,
    draw_spread,
)
from pisigma.reporting.hybrid_report import TRIAL_COLUMNS, coverage_line, learned_lines, trial_rows
from pisigma.reporting.markdown import markdown_table
from pisigma.reporting.tables import figure_text

MODELS = ("nominal", "geometric", "hybrid")
"""Models that are compared, in the order of the tables."""


def write_hybrid_figures(
    result: HybridResult,
    measurements: Measurements,
    validation: CalibrationValidation | None,
    report: Mapping[str, Any],
    folder: Path,
) -> None:
    """Draw corrections, predicted deviations and learning curve, those of them that there are.

    Args:
        result: the calibration.
        measurements: its rows.
        validation: of held-out rows, or None.
        report: with the figures; "learning_curve" may be in it.
        folder: where to write.
    """
    if result.learned is not None:
        draw_corrections(result.learned.correction, measurements, folder / CORRECTIONS_PNG)
    spread = None if validation is None else validation.all_spread
    if spread is not None and spread.values:
        draw_spread(spread, folder / SPREAD_PNG)
    if "learning_curve" in report:
        points = report["learning_curve"]
        models = {
            name: [point[name]["rms_mm"] for point in points] for name in MODELS[1:] if name in points[0]
        }
        draw_learning_curve([point["rows"] for point in points], models, folder / CURVE_PNG)


def compared(figures: Mapping[str, Any]) -> dict[str, Mapping[str, float]]:
    """The models among the figures of a validation."""
    return {name: figures[name] for name in MODELS if name in figures}


def curve_rows(points: Sequence[Mapping[str, Any]]) -> tuple[list[str], list[tuple[str, ...]]]:
    """Names of the columns and the rows of a learning curve: RMS of the position errors [mm] per model."""
    models = [name for name in MODELS if name in points[0]]
    head = ["training rows", *(f"{name}, RMS [mm]" for name in models)]
    has_coverage = all("coverage" in point for point in points)
    head += ["coverage [%]"] if has_coverage else []
    rows = []
    for point in points:
        cells = [str(point["rows"]), *(figure_text(point[name]["rms_mm"]) for name in models)]
        cells += [f"{100 * point['coverage']:.1f}"] if has_coverage else []
        rows.append(tuple(cells))
    return head, rows


def hybrid_parts(report: Mapping[str, Any]) -> list[str]:
    """Headings, sentences, tables and figures; nothing of a geometric calibration.

    Args:
        report: from `report_calibration`, and "learning_curve" where there is one.
    """
    if "hybrid" not in report:
        return []
    hybrid = report["hybrid"]
    parts = [
        "## What was learned",
        " ".join(learned_lines(hybrid)),
        "What was tried, in order. The left-out error is the RMS of training rows that were left out of the fit, in "
        "units of the geometric calibration's:",
        markdown_table(TRIAL_COLUMNS, trial_rows(hybrid)),
    ]
    if hybrid["learned"] is not None:
        parts.append(f"![correction of every joint over its own value]({CORRECTIONS_PNG})")
    judged: Mapping[str, Any] = next(
        (report[key] for key in ("cross_validation", "held_out", "test") if key in report), {}
    )
    if "coverage" in judged:
        parts += ["## How sure it is", coverage_line(judged)]
        parts.append(f"![errors of held-out rows over what was predicted of them]({SPREAD_PNG})")
    if "learning_curve" in report:
        head, rows = curve_rows(report["learning_curve"])
        parts += ["## How many rows it takes", markdown_table(head, rows)]
        parts.append(f"![error on held-out rows over the number of training rows]({CURVE_PNG})")
    return parts
