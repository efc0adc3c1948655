"""Figures of accuracy, before and after, of which rows they are, and what limits it."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch

from pisigma.model.calibrated_model import CalibratedModel
from pisigma.reporting.calibration_tables import cross_validation_text
from pisigma.reporting.rendering import sentences
from pisigma.validation.held_out.calibration_summary import CalibrationSummary
from pisigma.validation.held_out.judged_rows import JudgedRows
from pisigma.validation.held_out.pose_statistics import PoseErrors, error_statistics
from pisigma.validation.held_out.training_summary import BeforeAfter, TrainingSummary
from pisigma.validation.held_out.validation_figures import ErrorFigures

LABELS = {
    "nominal": "nominal",
    "geometric": "geometric",
    "hybrid": "hybrid",
    "corrected": "with the network",
    "full": "full solution",
    "distilled": "distilled",
}
"""Models, in the order of the tables, and what they are called there."""
_JOINT_ROWS = (("held_out", True), ("training", False))
MOSTLY = 0.8
"""Share of the squared error from which on scatter is what limits."""


@dataclass(frozen=True)
class Accuracy:
    """Errors of some rows under several models.

    Attributes:
        title: which rows, in a few words.
        how: which rows and which models, in a sentence.
        held_out: whether the models were made without the rows.
        rows: how many.
        models: by name; the last is the model of the report.
        reference: what the errors are from, where that is another model instead of a measurement.
    """

    title: str
    how: str
    held_out: bool
    rows: int
    models: Mapping[str, ErrorFigures]
    reference: str = ""

    @property
    def unit(self) -> str:
        """Unit of what counts first: "mm" of positions, else "deg" of orientations."""
        return "deg" if self.last.rms_mm is None else "mm"

    @property
    def last(self) -> ErrorFigures:
        """Figures of the model."""
        return list(self.models.values())[-1]

    def figure(self, statistic: str, model: str = "") -> float:
        """Give "rms", "mean", "p95" or "max" of what counts first, of the model or of another."""
        return float(getattr(self.models[model] if model else self.last, f"{statistic}_{self.unit}"))

    @property
    def factor(self) -> float | None:
        """How much larger the RMS error of the nominal robot is; None without one."""
        if "nominal" not in self.models or len(self.models) < 2 or not self.figure("rms") > 0:
            return None
        return self.figure("rms", "nominal") / self.figure("rms")


def accuracies(
    model: CalibratedModel, summary: CalibrationSummary | None, rows: JudgedRows | None
) -> tuple[Accuracy, ...]:
    """Gather all figures of a model's accuracy, those that say most first.

    Other rows of a file come before the model's own held-out rows, and rows that it was made of come last.
    """
    kept = _of_distilled(model) if model.kind == "distilled" else _of_metrics(model, summary)
    if rows is None or rows.origin == "held_out":
        return tuple(kept)
    of_rows = _of_rows(rows)
    return (of_rows, *kept) if of_rows.held_out else (*kept, of_rows)


def figures_of(errors: PoseErrors) -> ErrorFigures:
    """Compute statistics in mm and deg of those of the errors that there are."""
    figures: dict[str, float] = {}
    for values, unit, factor in ((errors.position, "mm", 1e3), (errors.rotation, "deg", 180 / torch.pi)):
        if values is not None and bool(torch.isfinite(values).any()):
            figures |= {f"{name}_{unit}": value * factor for name, value in error_statistics(values).items()}
    return ErrorFigures(**figures)


def _of_rows(rows: JudgedRows) -> Accuracy:
    title = "rows of the calibration" if rows.origin == "training" else "rows of the file"
    (how,) = sentences("report.txt.j2", "rows_of_file", rows)
    models = {name: figures_of(errors) for name, errors in rows.models.items()}
    return Accuracy(title, how, rows.origin != "training", rows.measurements.rows, models)


def _of_metrics(model: CalibratedModel, summary: CalibrationSummary | None) -> list[Accuracy]:
    """Read the figures of held-out rows that a model keeps."""
    kept = []
    for key, title in (
        ("test", "test set"),
        ("cross_validation", "held-out rows"),
        ("held_out", "held-out rows"),
    ):
        if models := _models(model.metrics.get(key)):
            rows = int(model.metrics[key].get("rows", model.provenance.rows))
            kept.append(Accuracy(title, _how(key, rows, summary), True, rows, models))
    return kept


def _of_distilled(model: CalibratedModel) -> list[Accuracy]:
    """Read the errors of a distilled model, which are from its parent's poses."""
    models, name = _models(model.metrics.get("held_out")), model.metrics["parent"]["name"]
    rows = int(model.metrics["poses"]["held_out"])
    how = f"{rows} poses that it was not fitted to; errors are from where the full model {name} has the tool."
    reference = f"the poses of the full model {name}, whose own errors come on top"
    return [Accuracy("held-out poses", how, True, rows, models, reference)] if models else []


def _models(figures: object) -> dict[str, ErrorFigures]:
    if not isinstance(figures, Mapping):
        return {}
    kept = {name: figures[name] for name in LABELS if isinstance(figures.get(name), Mapping)}
    return {name: ErrorFigures.model_validate(errors) for name, errors in kept.items()}


def _how(key: str, rows: int, summary: CalibrationSummary | None) -> str:
    figures = None if summary is None else summary.cross_validation
    folds = cross_validation_text(figures) if figures is not None and (figures.folds or 1) > 1 else ""
    return sentences("report.txt.j2", "rows_of_metrics", key, rows, folds)[0]


@dataclass(frozen=True)
class JudgedJoint:
    """Errors of one joint of a network on some rows.

    Attributes:
        name: of the joint.
        held_out: whether the network was made without the rows.
        errors: average, deviation and maximum of their sizes without and with the network.
    """

    name: str
    held_out: bool
    errors: BeforeAfter

    @property
    def unit(self) -> str:
        """Unit of the errors: "deg" or "mm"."""
        return self.errors.after.unit


def judged_joints(model: CalibratedModel) -> tuple[JudgedJoint, ...]:
    """Read the errors of joints that a network was judged by, held-out rows first; none of other models."""
    summary = TrainingSummary.read(model)
    joints = () if summary is None else summary.joints
    rows = ((joint.name, held_out, getattr(joint, key)) for joint in joints for key, held_out in _JOINT_ROWS)
    return tuple(JudgedJoint(name, held_out, errors) for name, held_out, errors in rows if errors is not None)


@dataclass(frozen=True)
class Limit:
    """What limits the accuracy.

    Attributes:
        clause: to go on "what limits it is ...".
        sentence: the same with figures.
        noise: RMS length of the scatter of a measured position [mm]; None where it is not known.
        share: of the squared error that it makes up; None where it is not known or the scatter exceeds the error.
        source: where the figure of the noise is from.
    """

    clause: str
    sentence: str
    noise: float | None = None
    share: float | None = None
    source: str = ""


def limit_of(
    model: CalibratedModel,
    summary: CalibrationSummary | None,
    accuracy: Accuracy | None,
    rows: JudgedRows | None,
) -> Limit:
    """Compare the error with the scatter of repeated rows, or with the noise that a hybrid identified."""
    if accuracy is not None and accuracy.reference:
        sentence = " ".join(model.metrics.get("limitations", ()))
        return Limit(
            "the full model that it stands for", sentence or "Ask the full model for its own accuracy."
        )
    noise, source = None if rows is None else rows.scatter, "rows that were measured more than once"
    if noise is None:
        noise, source = _identified_noise(summary), "the noise that the calibration identified"
    error = accuracy.figure("rms") if accuracy is not None and accuracy.unit == "mm" else 0.0
    if noise is None or not error > 0:
        noise = None
    share = None if noise is None or noise >= error else (noise / error) ** 2
    mostly = share is not None and share >= MOSTLY
    others = () if summary is None else summary.noise
    rest = next((one.sigma_mm for one in others if one.sigma_mm is not None), None)
    (clause,) = sentences("report.txt.j2", "limit_clause", noise, share, mostly)
    (sentence,) = sentences("report.txt.j2", "limit", noise, share, mostly, error, source, rest)
    return Limit(clause, sentence, noise, share, source if noise is not None else "")


def _identified_noise(summary: CalibrationSummary | None) -> float | None:
    """Give the RMS length of a position's noise that a hybrid identified [mm]; of geometry alone it is no noise."""
    if summary is None or summary.hybrid is None or summary.hybrid.learned is None:
        return None
    of_points = [one.sigma_mm for one in summary.hybrid.learned.noise if one.sensor in ("position", "socket")]
    return None if not of_points or of_points[0] is None else math.sqrt(3) * of_points[0]
