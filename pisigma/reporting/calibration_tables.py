"""Tables and sentences of a calibration, for its card, the screen, report pages and CSV files."""

import csv
import functools
import math
from collections.abc import Sequence
from pathlib import Path

from pisigma.calibration.geometric.identifiability.pairwise import CorrelationTable
from pisigma.reporting.rendering import render_sentences
from pisigma.reporting.result_text import Table
from pisigma.reporting.tables import number_text
from pisigma.validation.held_out.calibration_summary import (
    CalibrationSummary,
    JointCorrectionFigures,
    NoiseFigures,
    ParameterFigures,
    ScaleFigures,
)
from pisigma.validation.held_out.validation_figures import (
    AbstractValidationFigures,
    LearningPoint,
    ValidationFigures,
)

_PARAMETER_COLUMNS = ("parameter", "unit", "nominal", "estimated", "change", "std. error", "remark")
TRIAL_COLUMNS = ("tried", "unknowns", "log evidence", "held-out error", "seconds", "kept")
_SIGNIFICANT = 2.0
"""Standard errors below which a change cannot be distinguished from 0."""
_UNCERTAIN = "not distinguishable from 0"
_FIGURES = ("nominal", "estimated", "change", "standard_error")

_say = functools.partial(render_sentences, "calibration.txt.j2")


def parameter_table(parameters: Sequence[ParameterFigures]) -> Table:
    """Return a table with one row per parameter: its figures and a short remark.

    Figures are rounded according to their standard errors. A change of less than two standard errors cannot be
    distinguished from 0.
    """
    return Table(_PARAMETER_COLUMNS, tuple(_parameter_row(one) for one in parameters))


def _parameter_row(parameter: ParameterFigures) -> tuple[str, ...]:
    error = parameter.standard_error
    digits = 4 if not error else min(max(1 - math.floor(math.log10(error)), 1), 6)
    figures = (parameter.nominal, parameter.estimated, parameter.change, error)
    texts = ("" if value is None else f"{round(value, digits) + 0.0:.{digits}f}" for value in figures)
    small = (
        error is not None and parameter.change is not None and abs(parameter.change) < _SIGNIFICANT * error
    )
    label = (
        ", ".join(
            [*(() if parameter.short_remark == "identified" else (parameter.short_remark,)), _UNCERTAIN]
        )
        if small
        else parameter.short_remark
    )
    return (parameter.name, parameter.unit, *texts, label)


def undetermined_lines(summary: CalibrationSummary) -> list[str]:
    """Return sentences on parameters that the data cannot determine."""
    redundancy = summary.redundancy
    lines = list(redundancy.dependencies)
    if redundancy.no_effect:
        lines.append(f"{', '.join(redundancy.no_effect)} have no effect on the measured values")
    lines += summary.weak_directions
    lines = lines or ["Every parameter is identifiable."]
    if summary.scale is not None:
        lines.append(_scale(summary.scale))
    return [_sentence(line) for line in lines]


def _scale(scale: ScaleFigures) -> str:
    """Return a sentence on the effect of a wrong scale of the sensor and the resulting error of positions."""
    return (
        f"links that are {scale.factor:.5f} times as long as nominal (standard deviation {scale.sigma:.2g}) cannot "
        "be distinguished from a sensor whose scale is off by that factor, because both give the same held-out "
        "errors. The "
        f"odds are {scale.odds:.2g} to 1 for one common factor rather than an error of each link; if the scale "
        f"is off, true positions are off by {scale.rms_mm_if_sensor_error:.2g} mm RMS in addition to all errors shown"
    )


def warning_lines(summary: CalibrationSummary) -> list[str]:
    """Return sentences that recommend checks and further measurements."""
    return [_sentence(line) for line in summary.warnings]


def implausible_lines(summary: CalibrationSummary) -> list[str]:
    """Return sentences on the reasons why the calibration is implausible."""
    return [one.sentence for one in summary.diagnostics if one.severity == "implausible"]


def trial_table(hybrid: JointCorrectionFigures) -> Table:
    """Return a table of the joint corrections that were tried, in order."""
    rows = [
        (
            trial.name,
            str(trial.unknowns),
            "" if trial.log_evidence is None else f"{trial.log_evidence:.1f}",
            f"{trial.held_out_ratio:.3f}",
            f"{trial.seconds:.1f}",
            "yes" if trial.is_improvement else "no",
        )
        for trial in hybrid.trials
    ]
    return Table(TRIAL_COLUMNS, tuple(rows))


def learned_lines(hybrid: JointCorrectionFigures) -> list[str]:
    """Return sentences on the learned joint correction."""
    return list(_say("learned", hybrid))


def coverage_line(figures: AbstractValidationFigures) -> str:
    """Return a sentence on how often held-out coordinates are within the predicted intervals; "" without intervals."""
    return "".join(_say("coverage", figures))


def curve_table(points: Sequence[LearningPoint]) -> Table:
    """Return a table of RMS position errors of held-out rows [mm] by number of training rows."""
    models = list(points[0].models)
    head = ["training rows", *(f"{name}, RMS [mm]" for name in models)]
    has_coverage = all(point.coverage is not None for point in points)
    head += ["coverage [%]"] if has_coverage else []
    rows = []
    for point in points:
        cells = [str(point.rows), *(number_text(point.models[name].rms_mm or 0.0) for name in models)]
        cells += [f"{100 * (point.coverage or 0.0):.1f}"] if has_coverage else []
        rows.append(tuple(cells))
    return Table(tuple(head), tuple(rows))


def cross_validation_text(figures: ValidationFigures) -> str:
    """Describe how rows were held out: "6-fold cross-validation, 8 repeats: each of 720 rows was ..."."""
    return _say("cross_validation", figures)[0]


def simulations_text(figures: ValidationFigures) -> str:
    """Return a text on the simulated rows that were held out."""
    return _say("simulations", figures)[0]


def held_out_lines(figures: ValidationFigures) -> list[str]:
    """Return sentences on repeats of a validation, and on sockets and frames that were held out."""
    return list(_say("held_out", figures))


def noise_text(noise: NoiseFigures) -> str:
    """Return a text on the scatter of a sensor."""
    return _say("noise", noise)[0]


def _sentence(line: str) -> str:
    """Capitalise a line that starts with a plain word, not a name such as "theta_1" or "a.csv", and end it."""
    is_word = line.partition(" ")[0].isalpha()
    return f"{line[:1].upper() if is_word else line[:1]}{line[1:].rstrip('.')}."


def write_parameters(parameters: Sequence[ParameterFigures], path: Path) -> None:
    """Write the parameter table as CSV with all digits; cells without a figure are empty.

    Args:
        parameters: parameters in mm and deg.
        path: CSV file to write.
    """
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["name", "unit", *_FIGURES, "remark"])
        for row in parameters:
            figures = (getattr(row, name) for name in _FIGURES)
            texts = ("" if value is None else repr(value) for value in figures)
            writer.writerow([row.name, row.unit, *texts, row.remark])


def write_correlations(tables: Sequence[CorrelationTable], path: Path) -> None:
    """Write the correlations of lengths and of angles as CSV, one pair per line; undefined correlations are empty.

    Args:
        tables: correlations of lengths and of angles.
        path: CSV file to write.
    """
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["of", "parameter", "with", "correlation"])
        for kind, table in zip(("lengths", "angles"), tables, strict=True):
            for name, values in zip(table.names, table.values.tolist(), strict=True):
                for other, value in zip(table.names, values, strict=True):
                    writer.writerow([kind, name, other, "" if math.isnan(value) else f"{value:.6f}"])
