"""Tables and sentences of a calibration, for its card, the screen, report pages and CSV files."""

import csv
import math
from collections.abc import Sequence
from pathlib import Path

from pisigma.identification.identifiability.pairwise import CorrelationTable
from pisigma.judging.calibration_summary import (
    CalibrationSummary,
    HybridFigures,
    NoiseFigures,
    ParameterFigures,
)
from pisigma.judging.validation_figures import AbstractValidationFigures, LearningPoint, ValidationFigures
from pisigma.reporting.tables import Table, figure_text

PARAMETERS_CSV = "parameters.csv"
CORRELATION_CSV = "correlation.csv"
PARAMETER_COLUMNS = ("parameter", "unit", "nominal", "estimated", "change", "std. error", "remark")
TRIAL_COLUMNS = ("tried", "unknowns", "log evidence", "left-out error", "seconds", "kept")
_FIGURES = ("nominal", "estimated", "change", "standard_error")


def parameter_table(parameters: Sequence[ParameterFigures]) -> Table:
    """One row per parameter: its figures, and the remark in a few words."""
    rows = []
    for parameter in parameters:
        figures = (parameter.nominal, parameter.estimated, parameter.change, parameter.standard_error)
        texts = ("" if value is None else figure_text(value + 0.0) for value in figures)
        rows.append((parameter.name, parameter.unit, *texts, parameter.label))
    return Table(PARAMETER_COLUMNS, tuple(rows))


def undetermined_lines(summary: CalibrationSummary) -> list[str]:
    """What the data cannot determine, a sentence each."""
    redundancy = summary.redundancy
    lines = list(redundancy.dependencies)
    if redundancy.no_effect:
        lines.append(f"{', '.join(redundancy.no_effect)} change no measured value")
    lines += summary.weak_directions
    return [_sentence(line) for line in lines] or ["Nothing: every parameter is identified."]


def warning_lines(summary: CalibrationSummary) -> list[str]:
    """What to check or to measure next, a sentence each."""
    return [_sentence(line) for line in summary.warnings]


def trial_table(hybrid: HybridFigures) -> Table:
    """One row per joint correction that was tried, in order."""
    rows = [
        (
            trial.name,
            str(trial.unknowns),
            "" if trial.log_evidence is None else f"{trial.log_evidence:.1f}",
            f"{trial.left_out:.3f}",
            f"{trial.seconds:.1f}",
            "yes" if trial.kept else "no",
        )
        for trial in hybrid.trials
    ]
    return Table(TRIAL_COLUMNS, tuple(rows))


def learned_lines(hybrid: HybridFigures) -> list[str]:
    """What was learned beyond the geometry, in sentences."""
    lines, learned = [hybrid.verdict], hybrid.learned
    if learned is not None:
        lines.append(
            f"Geometry and correction have {learned.unknowns} unknowns, of which the data determine "
            f"{learned.effective_parameters:.0f}; beyond the measured joint values the correction is an extrapolation, "
            "whose predicted deviation says how good it is."
        )
    return lines


def coverage_line(figures: AbstractValidationFigures) -> str:
    """How often held-out coordinates are within the predicted intervals, in a sentence; "" where none are predicted."""
    if figures.coverage is None or figures.predicted_rms_mm is None:
        return ""
    return (
        f"{100 * figures.coverage:.1f} % of the held-out coordinates are within the 95 % intervals that the hybrid "
        f"predicts (RMS of a predicted position error: {figure_text(figures.predicted_rms_mm)} mm)."
    )


def curve_table(points: Sequence[LearningPoint]) -> Table:
    """RMS position errors of held-out rows [mm] per calibration, one row per number of training rows."""
    models = list(points[0].models)
    head = ["training rows", *(f"{name}, RMS [mm]" for name in models)]
    has_coverage = all(point.coverage is not None for point in points)
    head += ["coverage [%]"] if has_coverage else []
    rows = []
    for point in points:
        cells = [str(point.rows), *(figure_text(point.models[name].rms_mm or 0.0) for name in models)]
        cells += [f"{100 * (point.coverage or 0.0):.1f}"] if has_coverage else []
        rows.append(tuple(cells))
    return Table(tuple(head), tuple(rows))


def folds_text(figures: ValidationFigures) -> str:
    """How the rows of a validation were held out, such as "6 folds, 8 repeats"."""
    return "held out once" if (figures.folds or 1) == 1 else f"{figures.folds} folds{_repeats(figures)}"


def cross_validation_text(figures: ValidationFigures) -> str:
    """The same as a sentence without its end: "6-fold cross-validation, 8 repeats: each of 720 rows is ..."."""
    return (
        f"{figures.folds}-fold cross-validation{_repeats(figures)}: each of {figures.rows} rows is judged by a "
        "calibration without it"
    )


def _repeats(figures: ValidationFigures) -> str:
    return "" if figures.repeats is None else f", {figures.repeats} repeats"


def simulations_text(figures: ValidationFigures) -> str:
    """Which simulated rows were held out, in a sentence."""
    text = f"{figures.rows} other simulated rows"
    if figures.mean_rms_mm is None:
        return f"{text}."
    means = ", ".join(f"{name} {figure_text(mean)} mm" for name, mean in figures.mean_rms_mm.items())
    return (
        f"{text} of {figures.folds} simulations that differ in all that is random (mean of their RMS position errors: "
        f"{means})."
    )


def held_out_lines(figures: ValidationFigures) -> list[str]:
    """What else is to be said of a validation: of its repeats, of sockets and frames that were held out whole."""
    lines = []
    if figures.rms_mm_of_repeats is not None:
        ranges = ", ".join(
            f"{name} {figure_text(min(rms))} to {figure_text(max(rms))} mm"
            for name, rms in figures.rms_mm_of_repeats.items()
        )
        lines.append(
            f"The RMS position errors of the {figures.repeats} repeats by themselves are {ranges}: so much depends on "
            "which joint values are held out together."
        )
    if figures.sockets_held_out:
        lines.append(
            f"{figures.sockets_held_out} sockets were held out whole; an error there is how far a row puts the ball "
            "from where the socket's rows put it on average."
        )
    if figures.socket_distance is not None:
        *others, (last, best) = figures.socket_distance.models.items()
        beside = "; ".join(
            f"{name} {figure_text(sizes.mean_mm)} and {figure_text(sizes.max_mm)} mm"
            for name, sizes in others
        )
        by = f" by the {last} calibration" if last != "geometric" else ""
        lines.append(
            f"The known distance of held-out sockets ({figures.socket_distance.count} of them) is met to "
            f"{figure_text(best.mean_mm)} mm on average, {figure_text(best.max_mm)} mm at worst{by} ({beside})."
        )
    if figures.rows_not_judged:
        lines.append(
            f"{figures.rows_not_judged} rows could not be judged: no row that was calibrated with had their target or "
            "anchor."
        )
    if figures.frames_fitted:
        lines.append(
            f"{figures.frames_fitted} frames were held out whole; where the base stands in them, and nothing else, "
            "was fitted to the held-out rows."
        )
    return lines


def noise_text(noise: NoiseFigures) -> str:
    """How much a sensor scatters, in a sentence."""
    if noise.factor_on_stated_sigma is not None:
        size = f"{noise.factor_on_stated_sigma:.4g} times the standard deviation that the rows state"
    else:
        sigma, unit = (noise.sigma_deg, "deg") if noise.sigma_mm is None else (noise.sigma_mm, "mm")
        size = f"{sigma:.4g} {unit} per value (one standard deviation)"
    return (
        f"Noise of {noise.sensor}, as the residuals show it: {size}, from {noise.values} values of which "
        f"the parameters use up {noise.used_by_parameters:.3g}."
    )


def _sentence(line: str) -> str:
    return f"{line.rstrip('.')}."


def write_parameters(parameters: Sequence[ParameterFigures], path: Path) -> None:
    """Write the parameter table in full digits; a cell is empty where there is no figure.

    Args:
        parameters: in mm and deg.
        path: the CSV to write.
    """
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["name", "unit", *_FIGURES, "remark"])
        for row in parameters:
            figures = (getattr(row, name) for name in _FIGURES)
            texts = ("" if value is None else repr(value) for value in figures)
            writer.writerow([row.name, row.unit, *texts, row.remark])


def write_correlations(tables: Sequence[CorrelationTable], path: Path) -> None:
    """Write the tables of lengths and of angles, a cell a line; an undefined correlation is an empty cell.

    Args:
        tables: of lengths and of angles.
        path: the CSV to write.
    """
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["of", "parameter", "with", "correlation"])
        for kind, table in zip(("lengths", "angles"), tables, strict=True):
            for name, values in zip(table.names, table.values.tolist(), strict=True):
                for other, value in zip(table.names, values, strict=True):
                    writer.writerow([kind, name, other, "" if math.isnan(value) else f"{value:.6f}"])
