"""Accuracy before and after calibration on every set of rows with known errors, and the limits of the accuracy."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import torch

from pisigma.model.calibrated_model import CalibratedModel
from pisigma.validation.held_out.calibration_summary import CalibrationSummary
from pisigma.validation.held_out.judged_rows import JudgedRows
from pisigma.validation.held_out.pose_statistics import PoseErrors, error_statistics
from pisigma.validation.held_out.training_summary import BeforeAfter, TrainingSummary
from pisigma.validation.held_out.validation_figures import ErrorFigures, ValidationFigures

_MODELS = ("nominal", "geometric", "hybrid", "corrected", "full", "distilled")
"""Names of the models, in the order of the tables."""
DOMINANT_SHARE = 0.8
"""Share of the squared error above which measurement scatter limits the accuracy."""
_JOINT_ROWS = (("held_out", True), ("training", False))

RowOrigin = Literal["file", "training", "test", "cross_validation", "simulation", "poses"]
"""Origin of the rows to which errors belong. "file": rows of a file that was not used to calibrate the model.
"training": rows with which the model was calibrated. "test": rows that its file marks as test. "cross_validation": rows
held out in k-fold cross-validation, or once. "simulation": other rows of a simulation. "poses": poses of a region, on
which a distilled model was compared with its parent.
"""


@dataclass(frozen=True)
class Accuracy:
    """Errors of a set of rows under several models.

    Attributes:
        origin: origin of the rows.
        rows: number of rows.
        models: error figures by name of the model, "nominal" first and the model of the report last.
        source: file of the rows; for "poses", the name of the parent model, to whose poses the errors are relative.
        validation: figures of the cross-validation, with its folds and repeats; None for other rows.
    """

    origin: RowOrigin
    rows: int
    models: Mapping[str, ErrorFigures]
    source: str = ""
    validation: ValidationFigures | None = None

    @property
    def is_held_out(self) -> bool:
        """Whether the models were made without the rows."""
        return self.origin != "training"

    @property
    def unit(self) -> str:
        """Unit of the leading quantity: "mm" for positions, "deg" for orientations if no position was measured."""
        return "deg" if self.model_figures.rms_mm is None else "mm"

    @property
    def model_figures(self) -> ErrorFigures:
        """Error figures of the model of the report."""
        return list(self.models.values())[-1]

    def leading_statistic(self, statistic: str, model: str = "") -> float:
        """Return a statistic of the leading quantity [`unit`].

        Args:
            statistic: "rms", "mean", "p95" or "max".
            model: name of a model; "" for the model of the report.
        """
        return float(getattr(self.models[model] if model else self.model_figures, f"{statistic}_{self.unit}"))

    @property
    def improvement_factor(self) -> float | None:
        """Ratio of the RMS errors of the nominal robot and of the model; None without a nominal robot."""
        if "nominal" not in self.models or len(self.models) < 2 or not self.leading_statistic("rms") > 0:
            return None
        return self.leading_statistic("rms", "nominal") / self.leading_statistic("rms")


def accuracies(
    model: CalibratedModel, summary: CalibrationSummary | None, rows: JudgedRows | None
) -> tuple[Accuracy, ...]:
    """Return the error figures of a model, most meaningful first.

    Rows of another file come first, then the held-out rows of the model, and last the rows with which it was
    calibrated.
    """
    kept = _of_distilled(model) if model.kind == "distilled" else _of_metrics(model, summary)
    if rows is None or rows.row_role == "held_out":
        return tuple(kept)
    of_rows = _of_rows(rows)
    return (of_rows, *kept) if of_rows.is_held_out else (*kept, of_rows)


def figures_of(errors: PoseErrors) -> ErrorFigures:
    """Compute the statistics of position errors [mm] and orientation errors [deg], if there are any."""
    figures: dict[str, float] = {}
    for values, unit, factor in ((errors.position, "mm", 1e3), (errors.rotation, "deg", 180 / torch.pi)):
        if values is not None and bool(torch.isfinite(values).any()):
            figures |= {f"{name}_{unit}": value * factor for name, value in error_statistics(values).items()}
    return ErrorFigures(**figures)


def _of_rows(rows: JudgedRows) -> Accuracy:
    models = {name: figures_of(errors) for name, errors in rows.errors_by_model.items()}
    origin: RowOrigin = "training" if rows.row_role == "training" else "file"
    return Accuracy(origin, rows.measurements.rows, models, rows.measurements.source)


def _of_metrics(model: CalibratedModel, summary: CalibrationSummary | None) -> list[Accuracy]:
    """Return the figures of held-out rows that a model folder stores."""
    origins: dict[str, RowOrigin] = {
        "test": "test",
        "cross_validation": "cross_validation",
        "held_out": "simulation",
    }
    kept = []
    for key, origin in origins.items():
        if models := _models(model.metrics.get(key)):
            rows = int(model.metrics[key].get("rows", model.provenance.rows))
            folds = summary.cross_validation if summary and origin == "cross_validation" else None
            kept.append(Accuracy(origin, rows, models, model.provenance.data_source, folds))
    return kept


def _of_distilled(model: CalibratedModel) -> list[Accuracy]:
    """Return the errors of a distilled model relative to the poses of its parent."""
    models, parent = _models(model.metrics.get("held_out")), str(model.metrics["parent"]["name"])
    rows = int(model.metrics["poses"]["held_out"])
    return [Accuracy("poses", rows, models, parent)] if models else []


def _models(figures: object) -> dict[str, ErrorFigures]:
    if not isinstance(figures, Mapping):
        return {}
    kept = {name: figures[name] for name in _MODELS if isinstance(figures.get(name), Mapping)}
    return {name: ErrorFigures.model_validate(errors) for name, errors in kept.items()}


@dataclass(frozen=True)
class JudgedJoint:
    """Errors of a joint under a network on a set of rows.

    Attributes:
        name: name of the joint.
        is_held_out: whether the network was trained without the rows.
        errors: mean, standard deviation and maximum of the absolute errors before and after the correction.
    """

    name: str
    is_held_out: bool
    errors: BeforeAfter

    @property
    def unit(self) -> str:
        """Unit of the errors: "deg" or "mm"."""
        return self.errors.after.unit


def judged_joints(model: CalibratedModel) -> tuple[JudgedJoint, ...]:
    """Return the joint errors of a network, held-out rows first; empty for models without a network."""
    summary = TrainingSummary.read(model)
    joints = () if summary is None else summary.joints
    rows = ((joint.name, held_out, getattr(joint, key)) for joint in joints for key, held_out in _JOINT_ROWS)
    return tuple(JudgedJoint(name, held_out, errors) for name, held_out, errors in rows if errors is not None)


@dataclass(frozen=True)
class ScatterContribution:
    """Contribution of measurement scatter to the error.

    Attributes:
        scatter_mm: RMS length of the scatter of a measured position [mm]; None if unknown.
        scatter_source: source of `scatter_mm`: "repeats" of joint values in the rows, or the "hybrid" calibration.
        rms_error_mm: RMS length of the position error [mm]; 0 if no position was judged.
        residual_sigma_mm: standard deviation of the residuals of the geometric calibration per coordinate [mm]; None
            without one.
        is_approximation: whether the model approximates another model, whose errors add to its errors.
        limitations: limitations that such a model states, one sentence each.
    """

    scatter_mm: float | None = None
    scatter_source: Literal["repeats", "hybrid", ""] = ""
    rms_error_mm: float = 0.0
    residual_sigma_mm: float | None = None
    is_approximation: bool = False
    limitations: tuple[str, ...] = ()

    @property
    def scatter_share(self) -> float | None:
        """Share of the squared error that is scatter; None if it is unknown or the scatter exceeds the error."""
        return (
            None
            if self.scatter_mm is None or self.scatter_mm >= self.rms_error_mm
            else (self.scatter_mm / self.rms_error_mm) ** 2
        )

    @property
    def is_mostly_scatter(self) -> bool:
        """Whether scatter makes up most of the squared error."""
        return self.scatter_share is not None and self.scatter_share >= DOMINANT_SHARE


def scatter_contribution(
    model: CalibratedModel,
    summary: CalibrationSummary | None,
    accuracy: Accuracy | None,
    rows: JudgedRows | None,
) -> ScatterContribution:
    """Compare the error with the scatter of repeated rows, or with the noise that a hybrid calibration identified."""
    if accuracy is not None and accuracy.origin == "poses":
        return ScatterContribution(
            is_approximation=True, limitations=tuple(model.metrics.get("limitations", ()))
        )
    scatter = None if rows is None else rows.scatter_mm
    identified = identified_noise_sigma_mm(summary)
    noise = scatter if scatter is not None or identified is None else math.sqrt(3) * identified
    source: Literal["repeats", "hybrid"] = "hybrid" if scatter is None else "repeats"
    error = accuracy.leading_statistic("rms") if accuracy is not None and accuracy.unit == "mm" else 0.0
    sensors = () if summary is None else summary.noise
    # the noise of a corner is not the scatter of a position
    sigma = next(
        (one.sigma_mm for one in sensors if one.sigma_mm is not None and one.sensor != "corner"), None
    )
    if noise is None or not error > 0:
        return ScatterContribution(rms_error_mm=error, residual_sigma_mm=sigma)
    return ScatterContribution(noise, source, error, sigma)


def identified_noise_sigma_mm(summary: CalibrationSummary | None) -> float | None:
    """Return the standard deviation of a coordinate of measured positions that a hybrid identified [mm].

    None for a geometric calibration, whose residuals contain errors that geometry cannot express in addition to noise.
    """
    if summary is None or summary.hybrid is None or summary.hybrid.learned is None:
        return None
    of_points = [one.sigma_mm for one in summary.hybrid.learned.noise if one.sensor in ("position", "socket")]
    return of_points[0] if of_points else None
