"""The card of a calibration: the parameters, what the data do not tell, and how good it is."""

import re
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from pisigma.hybrid.result import HybridResult
from pisigma.identification.result import CalibrationResult
from pisigma.judging.calibration_validation import CalibrationValidation
from pisigma.judging.trained_calibrations import Result, geometric_result
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.reporting.calibration_figures import (
    CORRELATION_PNG,
    HELD_OUT_PNG,
    RESIDUALS_PNG,
    draw_correlations,
    draw_held_out,
    draw_residuals,
)
from pisigma.reporting.calibration_report import PARAMETERS_CSV, write_parameters
from pisigma.reporting.correlation_csv import CORRELATION_CSV, write_correlations
from pisigma.reporting.held_out_sentences import cross_validation_text, held_out_lines
from pisigma.reporting.hybrid_card import compared, hybrid_parts, write_hybrid_figures
from pisigma.reporting.markdown import CARD, markdown_table, use_text
from pisigma.reporting.tables import figure_text, pose_table


def write_calibration_card(
    model: CalibratedModel,
    found: Result,
    measurements: Measurements,
    validation: CalibrationValidation | None,
    report: Mapping[str, Any],
    texts: Mapping[str, str],
    folder: Path,
) -> None:
    """Write the card, the parameter table and the figures into a model folder.

    Args:
        model: the model of the folder.
        found: the calibration.
        measurements: its rows.
        validation: errors of held-out rows for the figures, or None.
        report: from `report_calibration`.
        texts: "description", "command" and "not_validated".
        folder: where to write.
    """
    result = geometric_result(found)
    write_parameters(result, folder / PARAMETERS_CSV)
    held_out = {} if validation is None else validation.all_errors
    lengths = {name: errors.position.numpy() for name, errors in held_out.items()}
    under = ", geometric" if isinstance(found, HybridResult) else ""
    draw_residuals(result.residuals, folder / RESIDUALS_PNG, under)
    if lengths:
        draw_held_out(lengths, folder / HELD_OUT_PNG)
    tables = (result.pairwise.lengths, result.pairwise.angles)
    draw_correlations(tables, folder / CORRELATION_PNG)
    write_correlations(tables, folder / CORRELATION_CSV)
    if isinstance(found, HybridResult):
        write_hybrid_figures(found, measurements, validation, report, folder)
    drawn = {entry.name for entry in folder.glob("*.png")}
    (folder / CARD).write_text(_text(model, result, report, texts, drawn), encoding="utf-8")


PARAMETER_COLUMNS = ("parameter", "unit", "nominal", "estimated", "change", "std. error", "remark")

_SHORT_REMARKS = (
    (r"^.* is identified, the single values are not", "in a sum, see below"),
    ("the data hardly see it, the prior holds it", "held by the prior"),
    (
        "identified at the solution, though redundant at the nominal geometry",
        "identified at the solution only",
    ),
    ("without effect on what was measured", "no effect"),
)


def parameter_table(report: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Rows of text: name, unit, nominal, estimated, change, standard error, remark in a few words."""
    rows = []
    for row in report["parameters"]:
        figures = (row[name] for name in ("nominal", "estimated", "change", "standard_error"))
        remark = row["remark"]
        for long, short in _SHORT_REMARKS:
            remark = re.sub(long, short, remark)
        texts = ("" if value is None else figure_text(value + 0.0) for value in figures)
        rows.append((row["name"], row["unit"], *texts, remark))
    return rows


def not_identified_lines(report: Mapping[str, Any]) -> list[str]:
    """What is not identified, and what to measure next, in sentences."""
    redundancy = report["redundancy"]
    lines = list(redundancy["dependencies"])
    if redundancy["no_effect"]:
        lines.append(f"{', '.join(redundancy['no_effect'])} change no measured value")
    lines += [*report["weak_directions"], *report["warnings"]]
    return [f"{line.rstrip('.')}." for line in lines] or ["Nothing: every parameter is identified."]


def _text(
    model: CalibratedModel,
    result: CalibrationResult,
    report: Mapping[str, Any],
    texts: Mapping[str, str],
    figures: Collection[str],
) -> str:
    provenance = model.provenance
    source = f"`{provenance.data_source}`" if "." in provenance.data_source else f"a {provenance.data_source}"
    parts = [
        f"# {model.name}",
        texts["description"].strip(),
        f"Made by `{texts['command']}`, on {provenance.rows} rows of {source}.",
        *_held_out_parts(report),
    ]
    if "position" in result.residuals:
        under = " under the geometric calibration" if "hybrid" in report else ""
        if HELD_OUT_PNG in figures:
            parts.append(f"![errors of rows that the calibration did not see]({HELD_OUT_PNG})")
        parts.append(f"![residuals of the calibration rows{under}]({RESIDUALS_PNG})")
    parts += hybrid_parts(report)
    parts += [
        "## Parameters",
        *_whose_parameters(report),
        "DH rows `RotZ(theta) · Trans(a, 0, d) · RotX(alpha) · RotY(beta)`; base and tool "
        "`Trans(x, y, z) · RotZ(roll) · RotY(pitch) · RotX(yaw)`. A standard error is what the noise that was "
        "found makes of the estimate; a parameter without one was left at its nominal value. "
        f"In full digits and with full remarks: [{PARAMETERS_CSV}]({PARAMETERS_CSV}).",
        markdown_table(PARAMETER_COLUMNS, parameter_table(report)),
        "## What the data do not tell",
        "\n".join(f"- {line}" for line in not_identified_lines(report)),
        "How alike the columns of the identification Jacobian are, lengths and angles apart "
        "(Pearson correlation; only pairs show here, the sentences above count larger sets too):",
        f"![correlations of the identification Jacobian's columns]({CORRELATION_PNG})",
        "## Quality",
        _quality_text(result, report),
        "## Not validated",
        texts["not_validated"].strip(),
        "## Use",
        "Joint values that reach a pose on the identified geometry:",
        use_text(model.name),
        "## Provenance",
        _provenance_text(model),
    ]
    return "\n\n".join(parts) + "\n"


def _whose_parameters(report: Mapping[str, Any]) -> list[str]:
    """What the table of parameters does not show of a hybrid."""
    if report.get("hybrid", {}).get("learned") is None:
        return []
    return [
        "Of the geometric calibration, which holds where no joint values were measured. The geometry that goes with "
        "the joint correction is in `model.yaml`; it differs, because it need not make up for what the correction does."
    ]


def _held_out_parts(report: Mapping[str, Any]) -> list[str]:
    """Headings, sentences and tables of errors on rows that were not calibrated with."""
    nominal = "nominal is the robot as drawn, with base and tool fitted to those other rows"
    parts: list[str] = []
    if "cross_validation" in report:
        found = report["cross_validation"]
        how = (
            cross_validation_text(found)
            if found["folds"] > 1
            else f"Judged on {found['rows']} rows by a calibration on the others"
        )
        models = compared(found)
        parts += ["## Held-out pose errors", f"{how}; {nominal}.", pose_table(models), *held_out_lines(found)]
    if "test" in report:
        found = report["test"]
        models = compared(found)
        how = f"The {found['rows']} rows that the file marks as test, with which nothing was calibrated"
        parts += ["## Pose errors of the test set", f"{how}; {nominal}.", pose_table(models)]
    if "held_out" in report:
        found = report["held_out"]
        models = compared(found) or {"geometric": {name: found[name] for name in found if name != "rows"}}
        how = f"{found['rows']} other simulated rows{_repeats_text(found)}."
        parts += ["## Held-out pose errors", how, pose_table(models)]
    return parts


def _repeats_text(found: Mapping[str, Any]) -> str:
    if found.get("folds", 1) == 1:
        return ""
    means = ", ".join(f"{name} {figure_text(mean)} mm" for name, mean in found["mean_rms_mm"].items())
    return (
        f" of {found['folds']} simulations that differ in all that is random (mean of their RMS position errors: "
        f"{means})"
    )


def _quality_text(result: CalibrationResult, report: Mapping[str, Any]) -> str:
    o = result.observability
    count = len(result.outliers)
    return "\n".join(
        [
            f"- The search {result.status.value}, after {result.iterations} iterations.",
            f"- {len(result.redundancy.names)} parameters were looked at; the data see {result.rank} independent "
            f"combinations of them (rank), and {len(result.free)} were estimated.",
            *(f"- {_noise_text(noise)}" for noise in report["noise"]),
            f"- {count or 'No'} row{'s' if count != 1 else ''} counted for less than half as outliers.",
            f"- Condition number {result.condition_number:.4g}; observability indices O1 {o.O1:.4g}, O2 {o.O2:.4g}, "
            f"O3 {o.O3:.4g}, O4 {o.O4:.4g}, O5 {o.O5:.4g} (columns per mm and mrad, rows in mm and mrad).",
        ]
    )


def _noise_text(noise: Mapping[str, Any]) -> str:
    if "factor_on_given_sigma" in noise:
        found = f"{noise['factor_on_given_sigma']:.4g} times the standard deviation that the rows state"
    else:
        name = next(name for name in noise if name.startswith("sigma_"))
        found = f"{noise[name]:.4g} {name.removeprefix('sigma_')} per value (one standard deviation)"
    return (
        f"Noise of {noise['sensor']}, as the residuals show it: {found}, from {noise['values']} values of which "
        f"the parameters use up {noise['used_by_parameters']:.3g}."
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
