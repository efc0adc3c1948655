"""The card of a geometric calibration: the parameters, what the data do not tell, and how good it is."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pisigma.correction.calibrated_model import CalibratedModel
from pisigma.evaluation.calibration_figures import (
    CORRELATION_PNG,
    RESIDUALS_PNG,
    draw_correlations,
    draw_residuals,
)
from pisigma.evaluation.calibration_report import PARAMETERS_CSV, write_parameters
from pisigma.evaluation.card import CARD
from pisigma.evaluation.geometric_validation import GeometricValidation
from pisigma.evaluation.tables import figure_text, pose_table
from pisigma.identification.result import CalibrationResult


def write_calibration_card(
    model: CalibratedModel,
    result: CalibrationResult,
    validation: GeometricValidation | None,
    report: Mapping[str, Any],
    texts: Mapping[str, str],
    folder: Path,
) -> None:
    """Write the card, the parameter table and the figures into a model folder.

    Args:
        model: the model of the folder.
        result: the calibration.
        validation: its cross-validation, or None.
        report: from `report_calibration`.
        texts: "description", "command" and "not_validated".
        folder: where to write.
    """
    write_parameters(result, folder / PARAMETERS_CSV)
    held_out = (
        {} if validation is None else {"nominal": validation.nominal, "geometric": validation.geometric}
    )
    lengths = {name: errors.position.numpy() for name, errors in held_out.items()}
    if "position" in result.residuals:
        draw_residuals(np.asarray(result.residuals["position"]), lengths, folder / RESIDUALS_PNG)
    draw_correlations((result.pairwise.lengths, result.pairwise.angles), folder / CORRELATION_PNG)
    (folder / CARD).write_text(_text(model, result, report, texts), encoding="utf-8")


def parameter_table(report: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Rows of text: name, unit, nominal, estimated, change, standard error, remark."""
    return [
        (
            row["name"],
            row["unit"],
            *(
                "" if row[name] is None else figure_text(row[name])
                for name in ("nominal", "estimated", "change")
            ),
            "" if row["standard_error"] is None else figure_text(row["standard_error"]),
            row["remark"],
        )
        for row in report["parameters"]
    ]


PARAMETER_COLUMNS = ("parameter", "unit", "nominal", "estimated", "change", "std. error", "remark")


def _text(
    model: CalibratedModel, result: CalibrationResult, report: Mapping[str, Any], texts: Mapping[str, str]
) -> str:
    provenance = model.provenance
    parts = [
        f"# {model.name}",
        texts["description"].strip(),
        f"Made by `{texts['command']}`, on {provenance.rows} rows of {provenance.data_source}.",
    ]
    if "cross_validation" in report:
        figures = report["cross_validation"]
        parts += [
            "## Held-out pose errors",
            f"{figures['folds']}-fold cross-validation; nominal is the robot as drawn with base and tool fitted.",
            pose_table({name: figures[name] for name in ("nominal", "geometric")}),
        ]
    if "position" in result.residuals:
        parts.append(f"![residuals]({RESIDUALS_PNG})")
    parts += [
        "## Parameters",
        f"As [CSV]({PARAMETERS_CSV}); standard errors are of the estimate given the noise found.",
        _markdown(PARAMETER_COLUMNS, parameter_table(report)),
        "## What the data do not tell",
        not_identified_text(report),
        f"![correlations of the identification Jacobian's columns]({CORRELATION_PNG})",
        "## Quality",
        _quality_text(result, report),
        "## Not validated",
        texts["not_validated"].strip(),
        "## Provenance",
        f"Data sha256 `{provenance.data_sha256}`; "
        + ", ".join(f"{name} {value}" for name, value in provenance.versions.items()),
    ]
    return "\n\n".join(parts) + "\n"


def not_identified_text(report: Mapping[str, Any]) -> str:
    """What is not identified, in sentences, as a Markdown list."""
    redundancy = report["redundancy"]
    lines = [f"- {sentence}." for sentence in redundancy["dependencies"]]
    if redundancy["no_effect"]:
        lines.append(f"- {', '.join(redundancy['no_effect'])} change no measured value.")
    lines += [f"- {sentence.rstrip('.')}." for sentence in (*report["unseen"], *report["warnings"])]
    return "\n".join(lines) or "Every parameter is identified."


def _quality_text(result: CalibrationResult, report: Mapping[str, Any]) -> str:
    o = result.observability
    noise = "; ".join(
        ", ".join(
            f"{key.replace('_', ' ')} {value if isinstance(value, str) else f'{value:.4g}'}"
            for key, value in n.items()
        )
        for n in report["noise"]
    )
    return "\n".join(
        [
            f"- {result.status.value} after {result.iterations} iterations; rank {result.rank} of {len(result.redundancy.names)} "
            "parameters looked at",
            f"- noise: {noise}",
            f"- {len(result.outliers)} rows count for less than half (outliers)",
            f"- observability (mm, mrad): O1 {o.O1:.4g}, O2 {o.O2:.4g}, O3 {o.O3:.4g}, O4 {o.O4:.4g}, O5 {o.O5:.4g}; "
            f"condition number {result.condition_number:.4g}",
        ]
    )


def _markdown(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
