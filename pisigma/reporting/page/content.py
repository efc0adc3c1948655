"""Content of a calibration report: findings of `pisigma.validation.report`, and the sentences about them."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pisigma.files.model_files import CORRELATION_CSV, CORRELATION_PNG
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.reporting.calibration_tables import (
    coverage_line,
    learned_lines,
    undetermined_lines,
    warning_lines,
)
from pisigma.reporting.page.wording import TITLES, advice_for, dependence_text, rows_text, say
from pisigma.validation.held_out.calibration_summary import CalibrationSummary
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.held_out.held_out_rows import read_held_out
from pisigma.validation.held_out.judged_rows import JudgedRows, judged_rows_of_file, judged_rows_of_folder
from pisigma.validation.report.accuracy import (
    Accuracy,
    JudgedJoint,
    ScatterContribution,
    accuracies,
    judged_joints,
    scatter_contribution,
)
from pisigma.validation.report.arm_in_images import ArmInImages
from pisigma.validation.report.corrections import (
    CorrectionCurve,
    ParameterCorrelations,
    correction_curves,
    parameter_correlations,
)
from pisigma.validation.report.dependence import (
    Dependence,
    ErrorsByFrameOrTarget,
    dependences,
    group_errors_by_name,
)
from pisigma.validation.report.error_map import ErrorMap, largest_errors, map_of_rows, map_of_workspace

_WITHOUT_CAUSE = ("few_rows", "search", "camera", "stated_noise", "temperature", "payload")
"""Kinds of warnings that name no cause of the errors."""


@dataclass(frozen=True)
class Verdict:
    """The first statements of a report.

    Attributes:
        sentence: accuracy of the model, improvement over nominal, place of the largest errors, and cause that limits
            the accuracy.
        worst_place: sentence on the place of the largest errors.
        limiting_cause: sentence on the cause that limits the accuracy: the first diagnosed cause, otherwise scatter or
            model.
        is_held_out: whether the sentence refers to rows that were not used to make the model.
        worst_joint: the worst joint of a network, if no pose was evaluated.
    """

    sentence: str
    worst_place: str
    limiting_cause: str
    is_held_out: bool
    worst_joint: JudgedJoint | None = None


def verdict_of(
    model: CalibratedModel,
    accuracies: tuple[Accuracy, ...],
    joints: tuple[JudgedJoint, ...],
    rows: JudgedRows | None,
    limit: ScatterContribution,
    causes: tuple[str, ...] = (),
) -> Verdict:
    """Compose the verdict.

    Args:
        model: the model.
        accuracies: figures of the errors; the verdict uses the first ones.
        joints: errors of joints, which are used if no pose was evaluated.
        rows: evaluated rows, or None.
        limit: contribution of measurement scatter to the error.
        causes: diagnosed causes of the errors; the first one is the cause that limits the accuracy.
    """
    if not accuracies:
        return _without_poses(model, joints)
    best = accuracies[0]
    clause, worst = _worst(model, rows)
    clauses = [*say("how_accurate", model, best), *([clause] if clause else [])]
    if best.unit == "mm" and not causes:
        clauses.append(f"what limits it is {say('limit_clause', limit)[0]}")
    sentence = causes[0] if causes else say("limit", limit)[0]
    return Verdict(f"{'; '.join(clauses)}.", worst, sentence, best.is_held_out)


def causes_of(summary: CalibrationSummary | None, diagnostics: Sequence[Diagnostic]) -> tuple[str, ...]:
    """Return sentences on the diagnosed causes of the errors of the evaluated rows, or otherwise of the calibration.

    Args:
        summary: figures of the calibration; None for other models.
        diagnostics: reasons why the evaluated rows are implausible.
    """
    found = diagnostics or (() if summary is None else summary.diagnostics)
    named = (one for one in found if one.severity == "implausible" or one.kind not in _WITHOUT_CAUSE)
    return tuple(one.sentence for one in named)


def _without_poses(model: CalibratedModel, joints: tuple[JudgedJoint, ...]) -> Verdict:
    """Return the verdict from joint errors if no pose was evaluated."""
    if not joints:
        advice = "Give a file with measurements that the model was not calibrated with."
        return Verdict(say("no_figures", model)[0], "", advice, is_held_out=False)
    of_kind = [one for one in joints if one.is_held_out == joints[0].is_held_out]
    worst = max(of_kind, key=lambda one: one.errors.after.values[0])
    advice = "Give a file with measured positions or poses to judge them."
    return Verdict(say("how_accurate_joint", model, worst)[0], "", advice, worst.is_held_out, worst)


def _worst(model: CalibratedModel, rows: JudgedRows | None) -> tuple[str, str]:
    """Return a clause and a sentence on the place of the largest errors; both are empty without rows."""
    largest = None if rows is None else largest_errors(rows)
    if rows is None or largest is None:
        return "", ""
    joints = [
        f"{value:.1f} {axis.file_unit}"
        for value, axis in zip(
            model.robot.in_file_units(rows.measurements.q[largest.row]), model.robot.axes, strict=True
        )
    ]
    at = [round(value * 1e3) for value in largest.position]
    (row,) = say("worst_row", rows, largest, at, joints)
    region = largest.region
    if region is None:
        return "", row
    where = ", ".join(
        f"{axis} {round(low * 1e3)} to {round(high * 1e3)}"
        for axis, low, high in zip("xyz", region.low, region.high, strict=True)
    )
    clause, sentence = say("worst_region", region, where, largest.unit, rows.row_role)
    return clause, f"{sentence} {row}"


@dataclass(frozen=True, eq=False)
class ReportContent:
    """Findings of a report, and the sentences about them.

    Attributes:
        model: the model.
        summary: figures of its calibration; None for other models.
        verdict: the first statements.
        accuracies: figures of the errors; the verdict uses the first ones.
        limit: contribution of measurement scatter to the error.
        rows: evaluated rows, or None.
        remarks: sentences about these rows.
        map: points of the error map.
        dependences: errors against joint values, order, payload and temperature.
        frames: errors per frame; empty if there is only one frame.
        targets: errors per target; empty if there is only one target.
        correlations: correlations of the parameters.
        curves: curves of the learned correction.
        correction_sentences: sentences on the learned correction.
        unidentified_parameters: sentences on parameters that the data cannot determine.
        advice: sentences that recommend further measurements.
        provenance: names and values.
        joints: errors of the joints of a network; empty for other models.
        missing_figures: sentences on figures that the report cannot state, with the reasons.
        missing_parameter_figures: sentences on figures of parameters that the folder does not store.
        correlation_png: figure in the folder, if the folder does not store the correlations as numbers.
        images: the nominal and the calibrated arm in images; None without images.
    """

    model: CalibratedModel
    summary: CalibrationSummary | None
    verdict: Verdict
    accuracies: tuple[Accuracy, ...]
    limit: ScatterContribution
    rows: JudgedRows | None
    remarks: tuple[str, ...]
    map: ErrorMap
    dependences: tuple[Dependence, ...]
    frames: ErrorsByFrameOrTarget
    targets: ErrorsByFrameOrTarget
    correlations: ParameterCorrelations
    curves: tuple[CorrectionCurve, ...]
    correction_sentences: tuple[str, ...]
    unidentified_parameters: tuple[str, ...]
    advice: tuple[str, ...]
    provenance: tuple[tuple[str, str], ...]
    joints: tuple[JudgedJoint, ...]
    missing_figures: tuple[str, ...]
    missing_parameter_figures: tuple[str, ...]
    correlation_png: bytes = b""
    images: ArmInImages | None = None

    def to_json(self) -> dict[str, Any]:
        """Return figures and sentences as plain values, without single rows; NaN and infinity become None."""
        rows = self.rows
        values = {
            "model": self.model.name,
            "verdict": self.verdict.sentence,
            "held_out": self.verdict.is_held_out,
            "worst": self.verdict.worst_place,
            "limit": {
                "noise_rms_mm": self.limit.scatter_mm,
                "share": self.limit.scatter_share,
                "summary": self.verdict.limiting_cause if self.accuracies else say("limit", self.limit)[0],
            },
            "accuracy": [
                {
                    "title": TITLES[one.origin],
                    "summary": rows_text(one),
                    "held_out": one.is_held_out,
                    "rows": one.rows,
                    "models": {name: figures.figures_by_name for name, figures in one.models.items()},
                }
                for one in self.accuracies
            ],
            "rows": None
            if rows is None
            else {"count": rows.measurements.rows, "origin": rows.row_role, "remarks": list(self.remarks)},
            "residuals": [
                {"variable": one.title, "summary": dependence_text(one)} for one in self.dependences
            ],
            "frames": self.frames.to_json(),
            "targets": self.targets.to_json(),
            "not_identified": list(self.unidentified_parameters),
            "observability": {} if self.summary is None else asdict(self.summary.observability),
            "correlated": [list(pair) for pair in self.correlations.pairs],
            "advice": list(self.advice),
            "limitations": list(self.missing_figures),
            "provenance": dict(self.provenance),
        }
        if self.images is not None:
            values["images"] = self.images.to_json()
        plain: dict[str, Any] = _finite(values)
        return plain


def report_content(
    model: CalibratedModel,
    folder: Path,
    measurements: Measurements | None = None,
    remarks: tuple[str, ...] = (),
    diagnostics: tuple[Diagnostic, ...] = (),
    images: ArmInImages | None = None,
) -> ReportContent:
    """Collect the findings of a report and write the sentences about them.

    Args:
        model: the model.
        folder: folder of the model.
        measurements: rows with which to evaluate the model, or None for the held-out rows that the folder stores.
        remarks: sentences about these rows.
        diagnostics: reasons why these rows are implausible.
        images: the arm in images.

    Raises:
        MeasurementError: the model cannot be evaluated with the rows.
        ModelError: files of the folder are missing or were changed.
    """
    summary, held_out = CalibrationSummary.read(model), read_held_out(folder, model)
    rows = None if held_out is None else judged_rows_of_folder(model, held_out)
    if measurements is not None:
        rows = judged_rows_of_file(model, measurements, held_out)
    causes = causes_of(summary, diagnostics)
    if rows is not None:
        remarks = (*(one.sentence for one in diagnostics), *remarks, *say("remarks_on_rows", rows))
    figures, joints = accuracies(model, summary, rows), judged_joints(model)
    limit = scatter_contribution(model, summary, figures[0] if figures else None, rows)
    correlations = parameter_correlations(folder)
    return ReportContent(
        model=model,
        summary=summary,
        verdict=verdict_of(model, figures, joints, rows, limit, causes),
        accuracies=figures,
        limit=limit,
        rows=rows,
        remarks=remarks,
        map=map_of_workspace(model) if rows is None else map_of_rows(model, rows),
        dependences=() if rows is None else dependences(rows, model.robot),
        frames=ErrorsByFrameOrTarget()
        if rows is None
        else group_errors_by_name(rows, rows.measurements.frame),
        targets=ErrorsByFrameOrTarget()
        if rows is None
        else group_errors_by_name(rows, rows.measurements.target),
        correlations=correlations,
        curves=correction_curves(model),
        correction_sentences=_learned(summary),
        unidentified_parameters=()
        if summary is None
        else (*undetermined_lines(summary), *warning_lines(summary)),
        advice=advice_for(model, summary, rows, figures, limit, causes),
        provenance=_provenance(model, rows),
        joints=joints,
        missing_figures=say("missing", rows, model),
        missing_parameter_figures=_missing_parameters(model, summary, correlations),
        correlation_png=_correlation_png(folder),
        images=images,
    )


def _missing_parameters(
    model: CalibratedModel, summary: CalibrationSummary | None, correlations: ParameterCorrelations
) -> tuple[str, ...]:
    """Return sentences on figures of parameters that the folder does not store."""
    if summary is not None:
        text = "The model folder does not store the correlations as numbers; calibrate again to store them."
        return () if correlations.tables else (text,)
    if model.calibrated is None:
        return ("This model has no identified parameters: its geometry is the nominal one.",)
    return ("The model folder does not store the figures of its parameters; calibrate again to store them.",)


def _learned(summary: CalibrationSummary | None) -> tuple[str, ...]:
    if summary is None:
        return ()
    lines = learned_lines(summary.hybrid) if summary.hybrid is not None else []
    coverage = "" if summary.validation_errors is None else coverage_line(summary.validation_errors)
    return (*lines, *([coverage] if coverage else []))


def _provenance(model: CalibratedModel, rows: JudgedRows | None) -> tuple[tuple[str, str], ...]:
    made = model.provenance
    recipe = f"{made.recipe}, sha256 {made.recipe_sha256}" if made.recipe else ""
    left_out = f", {made.rows_left_out} left out ({made.rule})" if made.rows_left_out else ""
    lines = [
        ("model", f"{model.name}, {model.kind.replace('_', ' ')}"),
        ("robot", f"{model.robot.name} ({model.robot.maker})"),
        ("made by", str(model.metrics.get("command", ""))),
        ("recipe", recipe),
        ("made of", f"{made.rows} rows of {made.data_source}{left_out}"),
        ("sha256 of these rows", made.data_sha256),
        ("seed", str(made.seed)),
        ("versions", ", ".join(f"{name} {value}" for name, value in made.versions.items())),
    ]
    if rows is not None and rows.measurements.position is not None:
        lines.append(("judged here", f"{rows.measurements.rows} rows of {rows.measurements.source}"))
        lines.append(("sha256 of those rows", rows.measurements.content_hash()))
    return tuple((name, value) for name, value in lines if value)


def _correlation_png(folder: Path) -> bytes:
    path = folder / CORRELATION_PNG
    return path.read_bytes() if path.is_file() and not (folder / CORRELATION_CSV).is_file() else b""


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _finite(inner) for name, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
