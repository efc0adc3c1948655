"""Everything that a report says, as figures and sentences, before it is drawn and laid out."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pisigma.judging.calibration_summary import read_summary
from pisigma.judging.held_out_rows import read_held_out
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.reporting.calibration_figures import CORRELATION_PNG
from pisigma.reporting.calibration_files import CORRELATION_CSV
from pisigma.reporting.calibration_tables import coverage_line, learned_lines
from pisigma.reporting.page.accuracy import Accuracy, accuracies
from pisigma.reporting.page.advice import advice_for
from pisigma.reporting.page.corrections import CorrectionCurve, correction_curves
from pisigma.reporting.page.dependence import Dependence, NameErrors, by_name, dependences
from pisigma.reporting.page.error_map import ErrorMap, map_of_rows, map_of_workspace
from pisigma.reporting.page.judged_rows import JudgedRows, rows_of_file, rows_of_folder
from pisigma.reporting.page.limits import Limit, limit_of
from pisigma.reporting.page.parameters import ParameterFindings, parameter_findings
from pisigma.reporting.page.verdict import Verdict, verdict_of
from pisigma.reporting.tables import CARD

KINDS = {
    "hybrid_calibration": "Hybrid calibration: geometry, and a learned correction of the joints",
    "geometric_calibration": "Geometric calibration",
    "distilled": "Network that stands for the full solution of another model",
    "inverse_calibration": "Network that corrects the nominal joint values",
}


@dataclass(frozen=True, eq=False)
class ReportContent:
    """What a report says.

    Attributes:
        model: the model.
        kind: what it is, in words.
        verdict: what there is to say first.
        accuracies: the first one is that of the verdict.
        limit: what limits the accuracy.
        rows: judged rows, or None.
        map: points in space.
        dependences: errors over joint values, order, payload and temperature.
        frames: errors per frame, and a sentence; empty where there is one.
        targets: the same per target.
        parameters: what is known of the parameters.
        curves: of the learned correction.
        learned: of the learned correction, in sentences.
        learning_curve: points; empty where there is none.
        advice: what to measure next.
        provenance: name and value.
        joints: errors of joints that a network was judged by; empty for other models.
        missing: what could not be said and why.
        correlation_png: figure of the folder, where it does not keep the correlations as numbers.
    """

    model: CalibratedModel
    kind: str
    verdict: Verdict
    accuracies: tuple[Accuracy, ...]
    limit: Limit
    rows: JudgedRows | None
    map: ErrorMap
    dependences: tuple[Dependence, ...]
    frames: tuple[tuple[NameErrors, ...], str]
    targets: tuple[tuple[NameErrors, ...], str]
    parameters: ParameterFindings
    curves: tuple[CorrectionCurve, ...]
    learned: tuple[str, ...]
    learning_curve: tuple[dict[str, Any], ...]
    advice: tuple[str, ...]
    provenance: tuple[tuple[str, str], ...]
    joints: tuple[dict[str, Any], ...]
    missing: tuple[str, ...]
    correlation_png: bytes = b""


def report_content(
    model: CalibratedModel, folder: Path, measurements: Measurements | None = None
) -> ReportContent:
    """Work out everything that a report says.

    Args:
        model: the model.
        folder: its folder.
        measurements: rows to judge it on, or None.

    Raises:
        MeasurementError: the rows cannot be judged.
        ModelError: files of the folder are missing or were changed.
    """
    held_out = read_held_out(folder, model)
    rows = None
    if measurements is not None:
        rows = rows_of_file(model, measurements, held_out)
    elif held_out is not None:
        rows = rows_of_folder(model, held_out)
    found = accuracies(model, rows)
    limit = limit_of(model, found[0] if found else None, rows)
    return ReportContent(
        model=model,
        kind=KINDS.get(model.kind, model.kind.replace("_", " ")),
        verdict=verdict_of(model, found, rows, limit),
        accuracies=found,
        limit=limit,
        rows=rows,
        map=map_of_workspace(model) if rows is None else map_of_rows(model, rows),
        dependences=() if rows is None else dependences(rows, model.robot),
        frames=((), "") if rows is None else by_name(rows, rows.measurements.frame),
        targets=((), "") if rows is None else by_name(rows, rows.measurements.target),
        parameters=parameter_findings(model, folder),
        curves=correction_curves(model),
        learned=_learned(model),
        learning_curve=tuple(model.metrics.get("learning_curve") or ()),
        advice=advice_for(model, rows, found, limit),
        provenance=_provenance(model, folder, rows),
        joints=tuple(joint for joint in model.metrics.get("joints") or () if "training" in joint),
        missing=_missing(model, rows),
        correlation_png=_correlation_png(folder),
    )


def _learned(model: CalibratedModel) -> tuple[str, ...]:
    summary = read_summary(model)
    if summary is None:
        return ()
    lines = learned_lines(summary.hybrid) if summary.hybrid is not None else []
    judged = "" if summary.judged is None else coverage_line(summary.judged)
    return (*lines, *([judged] if judged else []))


def _provenance(model: CalibratedModel, folder: Path, rows: JudgedRows | None) -> tuple[tuple[str, str], ...]:
    known = model.provenance
    recipe = f"{known.recipe}, sha256 {known.recipe_sha256}" if known.recipe else ""
    left_out = f", {known.rows_left_out} left out ({known.rule})" if known.rows_left_out else ""
    found = [
        ("model", f"{model.name}, {model.kind.replace('_', ' ')}"),
        ("robot", f"{model.robot.name} ({model.robot.maker})"),
        ("made by", str(model.metrics.get("command") or _command(folder))),
        ("recipe", recipe),
        ("made of", f"{known.rows} rows of {known.data_source}{left_out}"),
        ("sha256 of these rows", known.data_sha256),
        ("seed", str(known.seed)),
        ("versions", ", ".join(f"{name} {value}" for name, value in known.versions.items())),
    ]
    if rows is not None and rows.measurements.position is not None:
        found.append(("judged here", f"{rows.measurements.rows} rows of {rows.measurements.source}"))
        found.append(("sha256 of those rows", rows.measurements.content_hash()))
    return tuple((name, value) for name, value in found if value)


def _command(folder: Path) -> str:
    """The command that made the model, as its card says."""
    try:
        text = (folder / CARD).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return ""
    found = re.search(r"^Made by `([^`\n]+)`", text, re.MULTILINE)
    return found[1] if found else ""


def _correlation_png(folder: Path) -> bytes:
    path = folder / CORRELATION_PNG
    return path.read_bytes() if path.is_file() and not (folder / CORRELATION_CSV).is_file() else b""


def _missing(model: CalibratedModel, rows: JudgedRows | None) -> tuple[str, ...]:
    lines = []
    if rows is None:
        lines.append(
            "No measured rows: errors over the workspace, joint values, frames and time need them. Give a CSV file, or "
            "calibrate again: the folder then keeps the errors of its held-out rows."
        )
    elif rows.origin == "held_out" and rows.measurements.position is None:
        lines.append(
            "The rows are the model's own held-out ones as its folder keeps them, without payload and temperature; "
            "give the CSV file to see these."
        )
    elif rows.origin == "training":
        lines.append(
            "Errors of single rows are of rows that the model was made of: the folder does not keep those of held-out "
            "rows. Calibrate again to have them."
        )
    if rows is not None and {"touch", "distance"} & rows.measurements.kinds:
        lines.append(
            "Touches and distances are not judged row by row: a model folder does not keep the anchors and zeros that "
            "they are measured from. The figures of its held-out rows include them."
        )
    if model.uncertainty is None:
        lines.append("The model holds no uncertainty, so no accuracy is predicted (hybrid calibrations do).")
    return tuple(lines)
