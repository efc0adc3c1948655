"""Figures of accuracy, before and after, and of which rows they are."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch

from pisigma.judging.pose_statistics import PoseErrors, error_statistics
from pisigma.judging.validation_figures import ValidationFigures
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.reporting.calibration_tables import cross_validation_text
from pisigma.reporting.page.judged_rows import JudgedRows

STATISTICS = (("mean", "mean"), ("rms", "RMS"), ("p95", "95 %"), ("max", "maximum"))
LABELS = {
    "nominal": "nominal",
    "geometric": "geometric",
    "hybrid": "hybrid",
    "corrected": "with the network",
    "full": "full solution",
    "distilled": "distilled",
}
"""Models, in the order of the tables, and what they are called there."""


@dataclass(frozen=True)
class Accuracy:
    """Errors of some rows under several models.

    Attributes:
        title: which rows, in a few words.
        how: which rows and which models, in a sentence.
        held_out: whether the models never saw the rows.
        rows: how many.
        models: per model, figures such as "rms_mm" and "max_deg".
        reference: what the errors are from, where that is another model instead of a measurement.
    """

    title: str
    how: str
    held_out: bool
    rows: int
    models: Mapping[str, Mapping[str, float]]
    reference: str = ""

    @property
    def quantity(self) -> tuple[str, str]:
        """Unit of what counts first, and what it is the error of."""
        first = next(iter(self.models.values()))
        return ("mm", "position") if "rms_mm" in first else ("deg", "orientation")

    @property
    def last(self) -> Mapping[str, float]:
        """Figures of the model."""
        return list(self.models.values())[-1]

    @property
    def factor(self) -> float | None:
        """How much larger the RMS error of the nominal robot is; None without one."""
        key = f"rms_{self.quantity[0]}"
        if "nominal" not in self.models or len(self.models) < 2 or not self.last[key] > 0:
            return None
        return self.models["nominal"][key] / self.last[key]


def accuracies(model: CalibratedModel, rows: JudgedRows | None) -> tuple[Accuracy, ...]:
    """All that is known of a model's accuracy, the figures that say most first.

    Unseen rows of a file come before the model's own held-out rows, and rows that it was made of come last.
    """
    found = _of_metrics(model)
    if rows is None or rows.origin == "held_out":
        return tuple(found)
    own = _of_rows(rows)
    return (own, *found) if own.held_out else (*found, own)


def figures_of(errors: PoseErrors) -> dict[str, float]:
    """Statistics in mm and deg of those of the errors that there are."""
    figures: dict[str, float] = {}
    for values, unit, factor in ((errors.position, "mm", 1e3), (errors.rotation, "deg", 180 / torch.pi)):
        if values is not None and bool(torch.isfinite(values).any()):
            figures |= {f"{name}_{unit}": value * factor for name, value in error_statistics(values).items()}
    return figures


def _of_rows(rows: JudgedRows) -> Accuracy:
    models = {name: figures_of(errors) for name, errors in rows.models.items()}
    source, count = rows.measurements.source, rows.measurements.rows
    if rows.origin == "training":
        how = (
            f"The {count} rows of {source} are the very rows that the model was made of (their hash is the one in the "
            "model), so these figures say how well it fits, not how well it predicts."
        )
        return Accuracy("rows of the calibration", how, False, count, models)
    how = f"The {count} rows of {source}, which the model was not made of (their hash is another)."
    return Accuracy("rows of the file", how, True, count, models)


def _of_metrics(model: CalibratedModel) -> list[Accuracy]:
    found = []
    for key, title in (
        ("test", "test set"),
        ("cross_validation", "held-out rows"),
        ("held_out", "held-out rows"),
    ):
        figures = model.metrics.get(key)
        if isinstance(figures, Mapping) and (models := _models(figures)):
            if "distilled" in models:
                found.append(_of_distilled(model, models))
                continue
            rows = int(figures.get("rows", model.provenance.rows))
            found.append(Accuracy(title, _how(key, figures, rows), True, rows, models))
    return found


def _of_distilled(model: CalibratedModel, models: Mapping[str, Mapping[str, float]]) -> Accuracy:
    """Errors of a distilled model, which are from its parent's poses."""
    parent, poses = model.metrics.get("parent", {}), model.metrics.get("poses", {})
    rows, name = int(poses.get("held_out", 0)), str(parent.get("name", "its parent"))
    how = f"{rows} poses that it was not fitted to; errors are from where the full model {name} has the tool."
    return Accuracy(
        "held-out poses",
        how,
        True,
        rows,
        models,
        f"the poses of the full model {name}, whose own errors come on top",
    )


def _models(figures: Mapping[str, Any]) -> dict[str, Mapping[str, float]]:
    models = {name: figures[name] for name in LABELS if isinstance(figures.get(name), Mapping)}
    if not models and "rms_mm" in figures:
        models = {
            "geometric": {name: value for name, value in figures.items() if name[-3:] in ("_mm", "deg")}
        }
    return models


def _how(key: str, figures: Mapping[str, Any], rows: int) -> str:
    nominal = "nominal is the robot as drawn, with base and tool fitted to those other rows."
    if key == "test":
        return f"{rows} rows that the file marked as test, with which nothing was calibrated."
    if key == "held_out":
        return f"{rows} other rows of the simulation, which the model never saw."
    if figures.get("folds", 1) > 1:
        return f"{cross_validation_text(ValidationFigures.model_validate(figures))}; {nominal}"
    return f"{rows} rows that were held out once, judged by a calibration on the others; {nominal}"
