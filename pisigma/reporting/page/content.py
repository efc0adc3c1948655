"""Everything that a report says, as figures and sentences, before it is drawn and laid out."""

import functools
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from pisigma.files.model_files import CORRELATION_CSV, CORRELATION_PNG
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.reporting.calibration_tables import (
    coverage_line,
    learned_lines,
    undetermined_lines,
    warning_lines,
)
from pisigma.reporting.page.accuracy import Accuracy, JudgedJoint, Limit, accuracies, judged_joints, limit_of
from pisigma.reporting.page.advice import advice_for
from pisigma.reporting.page.corrections import (
    CorrectionCurve,
    ParameterFindings,
    correction_curves,
    parameter_findings,
)
from pisigma.reporting.page.dependence import (
    LEAST_ROWS,
    Dependence,
    NameErrors,
    by_name,
    dependences,
    error_lengths,
    root_mean_square,
)
from pisigma.reporting.page.error_map import ErrorMap, map_of_rows, map_of_workspace
from pisigma.reporting.rendering import sentences
from pisigma.validation.held_out.calibration_summary import CalibrationSummary
from pisigma.validation.held_out.held_out_rows import read_held_out
from pisigma.validation.held_out.judged_rows import JudgedRows, rows_of_file, rows_of_folder
from pisigma.validation.held_out.rank_tests import SIGNIFICANT, groups_differ

CELLS = 4
"""Cells of the measured space along every axis."""

_say = functools.partial(sentences, "report.txt.j2")


@dataclass(frozen=True)
class Verdict:
    """What there is to say first.

    Attributes:
        sentence: how accurate, how much better than nominal, where worst, what limits it.
        worst: where it is worst, in a sentence.
        limit: what limits it, in a sentence.
        held_out: whether the sentence rests on rows that the model was made without.
        joint: the worst joint of a network, where no pose was judged.
    """

    sentence: str
    worst: str
    limit: str
    held_out: bool
    joint: JudgedJoint | None = None


@dataclass(frozen=True)
class Region:
    """The cell of the measured space with the largest errors.

    Attributes:
        low: its corner [m].
        high: the opposite corner [m].
        rows: how many are in it.
        rms: of their errors.
        ratio: RMS over that of all rows.
        significant: whether errors there are larger than elsewhere more than by chance.
    """

    low: tuple[float, ...]
    high: tuple[float, ...]
    rows: int
    rms: float
    ratio: float
    significant: bool


def verdict_of(
    model: CalibratedModel,
    accuracies: tuple[Accuracy, ...],
    joints: tuple[JudgedJoint, ...],
    rows: JudgedRows | None,
    limit: Limit,
) -> Verdict:
    """Put the verdict together.

    Args:
        model: the model.
        accuracies: the first one counts.
        joints: errors of joints, which count where no pose was judged.
        rows: judged rows, or None.
        limit: what limits the accuracy.
    """
    if not accuracies:
        return _without_poses(model, joints)
    best = accuracies[0]
    clause, worst = _worst(model, rows)
    clauses = [*_say("how_accurate", model, best), *([clause] if clause else [])]
    clauses += [f"what limits it is {limit.clause}"] if best.unit == "mm" else []
    return Verdict(f"{'; '.join(clauses)}.", worst, limit.sentence, best.held_out)


def _without_poses(model: CalibratedModel, joints: tuple[JudgedJoint, ...]) -> Verdict:
    """Say what joint errors say where no pose was judged."""
    if not joints:
        advice = "Give a file with measurements that the model was not made of."
        return Verdict(_say("no_figures", model)[0], "", advice, held_out=False)
    of_kind = [one for one in joints if one.held_out == joints[0].held_out]
    worst = max(of_kind, key=lambda one: one.errors.after.values[0])
    advice = "Give a file with measured positions or poses to judge them."
    return Verdict(_say("how_accurate_joint", model, worst)[0], "", advice, worst.held_out, worst)


def _worst(model: CalibratedModel, rows: JudgedRows | None) -> tuple[str, str]:
    """Say where errors are largest: a clause for the verdict and a sentence; both empty without rows."""
    if rows is None:
        return "", ""
    _, after, unit = error_lengths(rows)
    finite = np.isfinite(after)
    if not finite.any():
        return "", ""
    place, errors = rows.place.numpy()[finite], after[finite]
    region, worst = worst_region(place, errors), int(errors.argmax())
    number = int(np.flatnonzero(finite)[worst])
    joints = [
        f"{np.degrees(value):.1f} deg" if turns else f"{value * 1e3:.1f} mm"
        for value, turns in zip(rows.measurements.q.numpy()[number], model.robot.revolute, strict=True)
    ]
    at = [round(value * 1e3) for value in place[worst].tolist()]
    (row,) = _say("worst_row", rows, number, float(errors[worst]), unit, at, joints)
    if region is None:
        return "", row
    where = ", ".join(
        f"{axis} {round(low * 1e3)} to {round(high * 1e3)}"
        for axis, low, high in zip("xyz", region.low, region.high, strict=True)
    )
    clause, sentence = _say("worst_region", region, where, unit, rows.origin)
    return clause, f"{sentence} {row}"


def worst_region(place: Float64[np.ndarray, "rows 3"], errors: Float64[np.ndarray, " rows"]) -> Region | None:
    """Find the cell of a grid over the measured space whose errors are surely the largest.

    Args:
        place: position of every row [m].
        errors: their lengths, all finite.

    Returns:
        None where there are too few rows, or all are in one cell.
    """
    low, high = (place.min(0), place.max(0)) if len(place) else (np.zeros(3), np.zeros(3))
    width = np.where(high > low, (high - low) / CELLS, 1.0)
    cell = np.clip(((place - low) / width).astype(int), 0, CELLS - 1)
    number = (cell * [CELLS * CELLS, CELLS, 1]).sum(1)
    least = max(LEAST_ROWS, len(errors) // 100)
    cells = [(int(k), errors[number == k]) for k in np.unique(number)]
    cells = [(k, inside) for k, inside in cells if len(inside) >= least]
    if len(cells) < 2:
        return None
    # one standard error less, so that a cell of few rows is not the worst by luck
    worst, _ = max(cells, key=lambda one: root_mean_square(one[1]) * (1 - 1 / math.sqrt(len(one[1]))))
    inside = number == worst
    _, chance = groups_differ(inside.astype(int), errors)
    corner = low + width * cell[inside][0]
    rms = root_mean_square(errors[inside])
    return Region(
        low=tuple(corner.tolist()),
        high=tuple((corner + width).tolist()),
        rows=int(inside.sum()),
        rms=rms,
        ratio=rms / root_mean_square(errors),
        significant=chance < SIGNIFICANT / len(cells),
    )


@dataclass(frozen=True, eq=False)
class ReportContent:
    """What a report says.

    Attributes:
        model: the model.
        summary: figures of its calibration; None of other models.
        verdict: what there is to say first.
        accuracies: the first one is that of the verdict.
        limit: what limits the accuracy.
        rows: judged rows, or None.
        remarks: what a reader should know of these rows, a sentence each.
        map: points in space.
        dependences: errors over joint values, order, payload and temperature.
        frames: errors per frame, and a sentence; empty where there is one.
        targets: the same per target.
        parameters: what is known of the parameters.
        curves: of the learned correction.
        learned: of the learned correction, in sentences.
        not_identified: parameters that the data cannot determine, in sentences.
        advice: what to measure next.
        provenance: name and value.
        joints: errors of joints that a network was judged by; empty for other models.
        missing: what could not be said and why.
        correlation_png: figure of the folder, where it does not keep the correlations as numbers.
    """

    model: CalibratedModel
    summary: CalibrationSummary | None
    verdict: Verdict
    accuracies: tuple[Accuracy, ...]
    limit: Limit
    rows: JudgedRows | None
    remarks: tuple[str, ...]
    map: ErrorMap
    dependences: tuple[Dependence, ...]
    frames: tuple[tuple[NameErrors, ...], str]
    targets: tuple[tuple[NameErrors, ...], str]
    parameters: ParameterFindings
    curves: tuple[CorrectionCurve, ...]
    learned: tuple[str, ...]
    not_identified: tuple[str, ...]
    advice: tuple[str, ...]
    provenance: tuple[tuple[str, str], ...]
    joints: tuple[JudgedJoint, ...]
    missing: tuple[str, ...]
    correlation_png: bytes = b""

    def to_json(self) -> dict[str, Any]:
        """Return figures and sentences as plain values, without single rows; what is no number is None."""
        rows = self.rows
        values = {
            "model": self.model.name,
            "verdict": self.verdict.sentence,
            "held_out": self.verdict.held_out,
            "worst": self.verdict.worst,
            "limit": {
                "noise_rms_mm": self.limit.noise,
                "share": self.limit.share,
                "says": self.limit.sentence,
            },
            "accuracy": [
                {
                    "of": one.title,
                    "how": one.how,
                    "held_out": one.held_out,
                    "rows": one.rows,
                    "models": {name: figures.by_name for name, figures in one.models.items()},
                }
                for one in self.accuracies
            ],
            "rows": None
            if rows is None
            else {"count": rows.measurements.rows, "origin": rows.origin, "remarks": list(self.remarks)},
            "residuals": [{"over": one.title, "says": one.sentence} for one in self.dependences],
            "frames": [asdict(one) for one in self.frames[0]],
            "targets": [asdict(one) for one in self.targets[0]],
            "not_identified": list(self.not_identified),
            "observability": {} if self.summary is None else self.summary.observability.model_dump(),
            "correlated": [list(pair) for pair in self.parameters.pairs],
            "advice": list(self.advice),
            "missing": list(self.missing),
            "provenance": dict(self.provenance),
        }
        plain: dict[str, Any] = _finite(values)
        return plain


def report_content(
    model: CalibratedModel,
    folder: Path,
    measurements: Measurements | None = None,
    doubts: tuple[str, ...] = (),
) -> ReportContent:
    """Work out everything that a report says.

    Args:
        model: the model.
        folder: its folder.
        measurements: rows to judge it on, or None.
        doubts: why nothing is to be concluded from these rows, a sentence each.

    Raises:
        MeasurementError: the rows cannot be judged.
        ModelError: files of the folder are missing or were changed.
    """
    summary, held_out = CalibrationSummary.read(model), read_held_out(folder, model)
    rows = None if held_out is None else rows_of_folder(model, held_out)
    if measurements is not None:
        rows = rows_of_file(model, measurements, held_out)
    remarks = () if rows is None else (*doubts, *sentences("report.txt.j2", "remarks_on_rows", rows))
    figures, joints = accuracies(model, summary, rows), judged_joints(model)
    limit = limit_of(model, summary, figures[0] if figures else None, rows)
    return ReportContent(
        model=model,
        summary=summary,
        verdict=verdict_of(model, figures, joints, rows, limit),
        accuracies=figures,
        limit=limit,
        rows=rows,
        remarks=remarks,
        map=map_of_workspace(model) if rows is None else map_of_rows(model, rows),
        dependences=() if rows is None else dependences(rows, model.robot),
        frames=((), "") if rows is None else by_name(rows, rows.measurements.frame),
        targets=((), "") if rows is None else by_name(rows, rows.measurements.target),
        parameters=parameter_findings(model, summary, folder),
        curves=correction_curves(model),
        learned=_learned(summary),
        not_identified=() if summary is None else (*undetermined_lines(summary), *warning_lines(summary)),
        advice=advice_for(model, summary, rows, figures, limit),
        provenance=_provenance(model, rows),
        joints=joints,
        missing=sentences("report.txt.j2", "missing", rows, model),
        correlation_png=_correlation_png(folder),
    )


def _learned(summary: CalibrationSummary | None) -> tuple[str, ...]:
    if summary is None:
        return ()
    lines = learned_lines(summary.hybrid) if summary.hybrid is not None else []
    coverage = "" if summary.judged is None else coverage_line(summary.judged)
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
