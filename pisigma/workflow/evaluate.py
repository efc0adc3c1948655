"""Evaluate models on measurements on which they were not trained, and accept or reject them."""

import os
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch

from pisigma.files.errors import MeasurementError, ModelError, Place
from pisigma.measurement.camera.corner_file import MeasurementFiles, read_rows
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.exceeded_limits import row_warnings
from pisigma.measurement.sensors.socket import expand_socket_names
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.folder.model_folder import HasModel, ModelSource, load_model, model_or_folder
from pisigma.model.stated_conditions import condition_warnings
from pisigma.model.training_rows import training_row_warnings
from pisigma.validation.checks.other_sensors import distance_diagnostics
from pisigma.validation.checks.wrong_rows import without_wrong_rows
from pisigma.validation.gate import check_rows
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.held_out.frames.fitted_frames import FrameKind, fitted_remark
from pisigma.validation.held_out.frames.row_errors import fitted_points_remark
from pisigma.validation.held_out.model_comparison import ModelComparison, ModelFigures, compare_models
from pisigma.validation.held_out.pose_statistics import image_remark
from pisigma.validation.held_out.reference_models import geometric_model, nominal_model
from pisigma.validation.setup_faults.setup_faults import is_implausible, unexplained_diagnostic
from pisigma.workflow.settings.evaluation import EvaluationSettings

REFERENCES = ("nominal", "geometric")
"""Names of the models for comparison: the nominal robot, and the geometric part of a hybrid. Limits do not apply to
them."""


@dataclass(frozen=True)
class ModelDescription:
    """Description of an evaluated model, without its figures.

    Attributes:
        model: folder or name of the model.
        kind: kind of the model.
        trained_on: whether it was trained on the same rows.
    """

    model: str
    kind: str
    trained_on: bool


@dataclass(frozen=True)
class Evaluation:
    """Result of `evaluate`: models compared on the same rows.

    Attributes:
        data: file of the rows.
        rows: number of evaluated rows.
        settings: settings of the evaluation.
        comparison: figures of every model, with confidence intervals and differences from the first model.
        model_descriptions: descriptions of the models, without the references, by their names in the comparison.
        missed_limits: limits that are missed, as clauses without a full stop.
        diagnostics: reasons why errors of a model are too large for a calibrated robot; empty if they are plausible.
        warnings: sentences with other remarks.
        seconds: computing time [s].
    """

    data: str
    rows: int
    settings: EvaluationSettings
    comparison: ModelComparison
    model_descriptions: Mapping[str, ModelDescription]
    missed_limits: tuple[str, ...]
    diagnostics: tuple[Diagnostic, ...]
    warnings: tuple[str, ...]
    seconds: float

    @property
    def models(self) -> tuple[ModelFigures, ...]:
        """Figures of all models, in the order in which they were given."""
        return self.comparison.models

    @property
    def accepted(self) -> bool:
        """Whether every model meets every limit, and no errors are implausible."""
        return not self.missed_limits and not self.diagnostics

    def to_json(self) -> dict[str, object]:
        """Return all results as plain values: the result of `pisigma evaluate --json`."""
        comparison = self.comparison.to_json()
        comparison["models"] = [
            model.to_json()
            | (asdict(self.model_descriptions[model.name]) if model.name in self.model_descriptions else {})
            for model in self.models
        ]
        values: dict[str, object] = {
            "data": self.data,
            "rows": self.rows,
            "frame_fitted": self.settings.fit_frame,
            "tool_fitted": self.settings.fit_tool,
            **comparison,
        }
        if stated := self.settings.limits.stated_limits:
            values |= {"limits": stated, "accepted": self.accepted, "missed": list(self.missed_limits)}
        values["diagnostics"] = [one.model_dump(by_alias=True) for one in self.diagnostics]
        return values | self._single() | {"warnings": list(self.warnings), "seconds": self.seconds}

    def _single(self) -> dict[str, object]:
        """Repeat the figures of a single model and of the nominal robot at top level, where programs expect them."""
        if len(self.models) != 2 or len(self.model_descriptions) != 1 or self.models[0].name != "nominal":
            return {}
        model, what = self.models[1], self.model_descriptions[self.models[1].name]
        nominal, corrected = (one.statistics_in_file_units for one in self.models)
        return {
            "model": what.model,
            "rows_not_predicted": model.rows_not_predicted,
            "trained_on": what.trained_on,
            "nominal": nominal,
            "corrected": corrected,
        }


def evaluate(
    models: ModelSource | HasModel | Sequence[ModelSource | HasModel],
    data: Measurements | MeasurementFiles,
    settings: EvaluationSettings | None = None,
) -> Evaluation:
    """Compare models on measurements, with confidence intervals, and check acceptance limits.

    Args:
        models: one or several models or their folders, or the words "nominal" (the nominal robot with base and tool
            fitted) and "geometric" (the geometric part of the first hybrid). A single model is compared with the
            nominal robot.
        data: measurements, or their files, in the frames in which the models were fitted. If rows are marked, only
            those of the set "test" are used.
        settings: see `EvaluationSettings`; None for no limits and 2000 resamples.

    Raises:
        ModelError: a folder cannot be used, or no model is given.
        MeasurementError: the rows cannot be used, or no row can be compared.
        PoseError: the joint values do not fit a robot.
    """
    settings, started = settings or EvaluationSettings(), time.perf_counter()
    if isinstance(models, str | os.PathLike | CalibratedModel | HasModel):
        models = [models]
    sources = models_by_label(models)
    loaded = load_models(sources)
    everything = read_rows(data, next(iter(loaded.values())).robot, settings.cameras)
    rows = test_rows(everything)
    compared = with_references(list(sources), loaded, rows.rotation is not None)
    hashes = everything.content_hash(), rows.content_hash()
    distances = expand_socket_names(settings.socket_distances, rows.socket or ())
    right = without_wrong_rows(loaded.values(), rows, settings.fitted_kinds)
    rows = right.rows
    comparison = compare_models(compared, rows, settings.bootstrap, settings.fitted_kinds, distances)
    evaluated = {
        label: ModelDescription(_text(sources[label]), model.kind, model.provenance.data_sha256 in hashes)
        for label, model in loaded.items()
    }
    judged = [figures for figures in comparison.models if figures.name in evaluated]
    return Evaluation(
        data=everything.source,
        rows=rows.rows,
        settings=settings,
        comparison=comparison,
        model_descriptions=evaluated,
        missed_limits=tuple(
            sentence for figures in judged for sentence in settings.limits.missed_by(figures)
        ),
        diagnostics=tuple(
            diagnostic
            for figures in judged
            for diagnostic in (
                *_diagnostics(loaded[figures.name], figures, rows, settings.fitted_kinds),
                *distance_diagnostics(comparison, figures),
            )
        ),
        warnings=(
            *right.warnings,
            *fitted_remark(rows, settings.fitted_kinds),
            *fitted_points_remark(rows),
            *image_remark(rows),
            *_warnings(comparison),
            *(
                one
                for label, model in loaded.items()
                for one in training_row_warnings(replace(model, name=label), rows, everything)
            ),
            *(one for model in loaded.values() for one in condition_warnings(model, rows)),
            *row_warnings(next(iter(loaded.values())).robot, rows),
        ),
        seconds=time.perf_counter() - started,
    )


def test_rows(measurements: Measurements) -> Measurements:
    """Return the rows of the set "test", or all rows if there are no sets.

    Raises:
        MeasurementError: all rows are marked as "train".
    """
    if measurements.split is None:
        return measurements
    test = torch.tensor([name == "test" for name in measurements.split])
    if not test.any():
        raise MeasurementError(
            "all rows are marked as 'train'",
            value="train",
            at=Place(measurements.source, column="set"),
            remedy="mark some as 'test', or remove the column",
        )
    return measurements.select(test)


def _text(source: ModelSource) -> str:
    return source.name if isinstance(source, CalibratedModel) else os.fspath(source)


def models_by_label(models: Sequence[ModelSource | HasModel]) -> dict[str, ModelSource]:
    """Return the models by their names in tables: the last part of the folder, or the whole path if two are equal.

    Raises:
        ModelError: a model is given twice.
    """
    sources = [model_or_folder(source) for source in models]
    texts = [_text(source) for source in sources]
    twice = next((text for text in texts if texts.count(text) > 1), None)
    if twice is not None:
        raise ModelError(f"model '{twice}' is given twice", value=twice, remedy="give every model once")
    short = [text if text in REFERENCES else Path(text).resolve().name for text in texts]
    taken = [*short, *(name for name in REFERENCES if name not in texts)]
    labels = [name if taken.count(name) == 1 else text for name, text in zip(short, texts, strict=True)]
    return dict(zip(labels, sources, strict=True))


def load_models(sources: Mapping[str, ModelSource]) -> dict[str, CalibratedModel]:
    """Load all models except the references.

    Raises:
        ModelError: a folder cannot be used, or there are only references.
    """
    loaded = {
        label: source if isinstance(source, CalibratedModel) else load_model(source)
        for label, source in sources.items()
        if source not in REFERENCES
    }
    if not loaded:
        only = " ".join(sources)
        raise ModelError(
            f"expected a model folder in addition to '{only}', which is computed from a model",
            expected="a model folder",
            value=only,
            remedy=f"add one (write ./{next(iter(sources), 'model')} if your folder has that name)",
        )
    return loaded


def with_references(
    labels: Sequence[str], loaded_models: Mapping[str, CalibratedModel], with_orientation: bool
) -> dict[str, CalibratedModel]:
    """Add the references to the models, in the given order; "nominal" comes before a single model.

    Args:
        labels: names of models and references.
        loaded_models: the models without the references.
        with_orientation: whether orientations were measured, so that the nominal robot's tool is fitted to them.
    """
    first = next(iter(loaded_models.values()))
    identified = next((model for model in loaded_models.values() if model.calibrated is not None), first)
    models = {}
    for label in ["nominal", *labels] if len(labels) == 1 else labels:
        model = loaded_models.get(label)
        if model is None:
            is_nominal = label == "nominal"
            model = nominal_model(first, with_orientation) if is_nominal else geometric_model(identified)
        models[label] = model
    return models


def _diagnostics(
    model: CalibratedModel, figures: ModelFigures, rows: Measurements, fitted: Sequence[FrameKind]
) -> Iterator[Diagnostic]:
    """Return reasons why errors are too large for a calibrated robot, or whether a moved base or tool explains them."""
    implausible = is_implausible(figures, model)
    nominal = nominal_model(model, rows.rotation is not None) if implausible else None
    found = check_rows(rows, model, fitted, nominal=nominal).implausible_findings
    if implausible and not found:
        found = (unexplained_diagnostic(model),)
    for one in found:
        yield one.model_copy(update={"sentence": f"{figures.name}: {one.sentence}"})


def _warnings(comparison: ModelComparison) -> list[str]:
    warnings = []
    if comparison.rows_without_position:
        warnings.append(
            f"{comparison.rows_without_position} rows were not evaluated, because they have no position or are alone "
            "in their socket."
        )
    for model in comparison.models:
        if model.rows_not_predicted:
            warnings.append(
                f"{model.rows_not_predicted} rows are so far outside the domain of {model.name} that it cannot predict "
                "them; they are left out for all models."
            )
    return warnings
