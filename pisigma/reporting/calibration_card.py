"""The card of a calibration, with its figures: accuracy first, then what was learned, parameters and provenance."""

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

from pisigma.hybrid.result import HybridResult
from pisigma.identification.result import CalibrationResult
from pisigma.judging.calibration_summary import CalibrationSummary
from pisigma.judging.calibration_validation import CalibrationValidation
from pisigma.judging.trained_calibrations import Result, geometric_result
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.reporting import calibration_figures as figures
from pisigma.reporting import calibration_tables as tables
from pisigma.reporting.tables import CARD, markdown_table, pose_table, use_text


@dataclass(frozen=True)
class CardTexts:
    """What a card says in words of its own: what the model is, and what nobody checked."""

    description: str
    not_validated: str


def write_calibration_card(
    model: CalibratedModel,
    result: Result,
    rows: Measurements,
    validation: CalibrationValidation | None,
    summary: CalibrationSummary,
    texts: CardTexts,
    folder: Path,
) -> None:
    """Write the card, its CSV files and its figures into a model folder.

    Args:
        model: the model of the folder.
        result: the calibration.
        rows: the rows it was calibrated with.
        validation: errors of held-out rows for the figures, or None.
        summary: all figures of the calibration.
        texts: description, and what was not validated.
        folder: where to write.
    """
    tables.write_parameters(summary.parameters, folder / tables.PARAMETERS_CSV)
    geometric = geometric_result(result)
    correlations = (geometric.pairwise.lengths, geometric.pairwise.angles)
    tables.write_correlations(correlations, folder / tables.CORRELATION_CSV)
    figures.draw_correlations(correlations, folder / figures.CORRELATION_PNG)
    figures.draw_residuals(
        geometric.residuals,
        folder / figures.RESIDUALS_PNG,
        ", geometric" if isinstance(result, HybridResult) else "",
    )
    if validation is not None:
        lengths = {name: errors.position.numpy() for name, errors in validation.all_errors.items()}
        figures.draw_held_out(lengths, folder / figures.HELD_OUT_PNG)
        spread = validation.all_spread
        if spread is not None and spread.values:
            figures.draw_spread(spread, folder / figures.SPREAD_PNG)
    if isinstance(result, HybridResult) and result.learned is not None:
        figures.draw_corrections(result.learned.correction, rows, folder / figures.CORRECTIONS_PNG)
    if summary.learning_curve is not None:
        figures.draw_learning_curve(summary.learning_curve, folder / figures.CURVE_PNG)
    drawn = {entry.name for entry in folder.glob("*.png")}
    (folder / CARD).write_text(_text(model, geometric, summary, texts, drawn), encoding="utf-8")


def _text(
    model: CalibratedModel,
    result: CalibrationResult,
    summary: CalibrationSummary,
    texts: CardTexts,
    drawn: Collection[str],
) -> str:
    source = model.provenance.data_source
    source = f"`{source}`" if "." in source else f"a {source}"
    sections = [
        f"# {model.name}",
        texts.description.strip(),
        f"Made by `{summary.command}`, on {model.provenance.rows} rows of {source}.",
        *_accuracy_sections(summary),
    ]
    if "position" in result.residuals:
        under = " under the geometric calibration" if summary.hybrid is not None else ""
        if figures.HELD_OUT_PNG in drawn:
            sections.append(f"![errors of rows that the calibration did not see]({figures.HELD_OUT_PNG})")
        sections.append(f"![residuals of the calibration rows{under}]({figures.RESIDUALS_PNG})")
    sections += [
        *_hybrid_sections(summary),
        *_parameter_sections(summary),
        "## Quality",
        _quality_text(result, summary),
        "## Not validated",
        texts.not_validated.strip(),
        "## Use",
        "Joint values that reach a pose on the identified geometry:",
        use_text(model.name),
        "## Provenance",
        _provenance_text(model),
    ]
    return "\n\n".join(sections) + "\n"


def _accuracy_sections(summary: CalibrationSummary) -> list[str]:
    """Headings, sentences and tables of errors on rows that were not calibrated with."""
    nominal = "nominal is the robot as drawn, with base and tool fitted to those other rows"
    sections: list[str] = []
    if (judged := summary.cross_validation) is not None:
        how = (
            tables.cross_validation_text(judged)
            if (judged.folds or 1) > 1
            else f"Judged on {judged.rows} rows by a calibration on the others"
        )
        table = pose_table(judged.models)
        sections += ["## Held-out pose errors", f"{how}; {nominal}.", table, *tables.held_out_lines(judged)]
    if (judged := summary.test) is not None:
        how = f"The {judged.rows} rows that the file marks as test, with which nothing was calibrated"
        table = pose_table(judged.models)
        sections += ["## Pose errors of the test set", f"{how}; {nominal}.", table]
    if (judged := summary.held_out) is not None:
        table = pose_table(judged.models)
        sections += ["## Held-out pose errors", tables.simulations_text(judged), table]
    return sections


def _hybrid_sections(summary: CalibrationSummary) -> list[str]:
    """Headings, sentences, tables and figures of what was learned; nothing of a geometric calibration."""
    if (hybrid := summary.hybrid) is None:
        return []
    sections = [
        "## What was learned",
        " ".join(tables.learned_lines(hybrid)),
        "What was tried, in order. The left-out error is the RMS of training rows that were left out of the fit, in "
        "units of the geometric calibration's:",
        markdown_table(*tables.trial_table(hybrid)),
    ]
    if hybrid.learned is not None:
        sections.append(f"![correction of every joint over its own value]({figures.CORRECTIONS_PNG})")
    if summary.judged is not None and (line := tables.coverage_line(summary.judged)):
        figure = f"![errors of held-out rows over what was predicted of them]({figures.SPREAD_PNG})"
        sections += ["## How sure it is", line, figure]
    if summary.learning_curve is not None:
        figure = f"![error on held-out rows over the number of training rows]({figures.CURVE_PNG})"
        sections += [
            "## How many rows it takes",
            markdown_table(*tables.curve_table(summary.learning_curve)),
            figure,
        ]
    return sections


def _parameter_sections(summary: CalibrationSummary) -> list[str]:
    """Headings, sentences and tables of the parameters, and of what the data cannot determine."""
    whose = [
        "Of the geometric calibration, which holds where no joint values were measured. The geometry that goes with "
        "the joint correction is in `model.yaml`; it differs, because it need not make up for what the correction does."
    ]
    learned = summary.hybrid is not None and summary.hybrid.learned is not None
    return [
        "## Parameters",
        *(whose if learned else []),
        "DH rows `RotZ(theta) · Trans(a, 0, d) · RotX(alpha) · RotY(beta)`; base and tool "
        "`Trans(x, y, z) · RotZ(roll) · RotY(pitch) · RotX(yaw)`. A standard error is what the measurement noise "
        "makes of the estimate; a parameter without one was left at its nominal value. "
        f"In full digits and with full remarks: [{tables.PARAMETERS_CSV}]({tables.PARAMETERS_CSV}).",
        markdown_table(*tables.parameter_table(summary.parameters)),
        "## What these data cannot determine",
        "\n".join(
            f"- {line}" for line in [*tables.undetermined_lines(summary), *tables.warning_lines(summary)]
        ),
        "How alike the columns of the identification Jacobian are, lengths and angles apart "
        "(Pearson correlation; only pairs show here, the sentences above count larger sets too):",
        f"![correlations of the identification Jacobian's columns]({figures.CORRELATION_PNG})",
    ]


def _quality_text(result: CalibrationResult, summary: CalibrationSummary) -> str:
    o = summary.observability
    count = len(summary.outliers)
    return "\n".join(
        [
            f"- The search {summary.status}, after {summary.iterations} iterations.",
            f"- Of {len(result.redundancy.names)} parameters the data determine {summary.rank} independent "
            f"combinations (rank), and {len(result.free)} were estimated.",
            *(f"- {tables.noise_text(noise)}" for noise in summary.noise),
            f"- {count or 'No'} row{'s' if count != 1 else ''} counted for less than half as outliers.",
            f"- Condition number {result.condition_number:.4g}; observability indices O1 {o.O1:.4g}, O2 {o.O2:.4g}, "
            f"O3 {o.O3:.4g}, O4 {o.O4:.4g}, O5 {o.O5:.4g} (columns per mm and mrad, rows in mm and mrad).",
        ]
    )


def _provenance_text(model: CalibratedModel) -> str:
    provenance = model.provenance
    versions = ", ".join(f"{name} {value}" for name, value in provenance.versions.items())
    lines = [
        f"- data `{provenance.data_source}`, sha256 of the values `{provenance.data_sha256}`",
        f"- {versions}",
    ]
    if provenance.recipe:
        lines.insert(0, f"- recipe `{provenance.recipe}`, sha256 `{provenance.recipe_sha256}`")
    return "\n".join(lines)
