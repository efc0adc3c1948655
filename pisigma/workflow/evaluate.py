"""Evaluate models on measurements that they were not trained on, and accept them or not."""

import os
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch

from pisigma.files.errors import MeasurementError, ModelError
from pisigma.measurement.camera.corner_file import MeasurementFiles, read_rows
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.joint_range import row_warnings
from pisigma.measurement.sensors.socket import matching_sockets
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.folder.model_folder import load_model
from pisigma.model.model_source import HoldsModel, ModelSource, model_or_folder
from pisigma.model.stated_conditions import condition_warnings
from pisigma.model.training_rows import training_row_warnings
from pisigma.validation.checks.rows.other_sensors import missed_distances
from pisigma.validation.checks.rows.wrong_rows import without_wrong_rows
from pisigma.validation.gate import check_rows
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.held_out.frames.fitted_frames import FrameKind, fitted_remark
from pisigma.validation.held_out.frames.row_errors import places_remark
from pisigma.validation.held_out.model_comparison import ModelComparison, ModelFigures, compare_models
from pisigma.validation.held_out.pose_statistics import image_remark
from pisigma.validation.held_out.reference_models import geometric_model, nominal_model
from pisigma.validation.setup_faults.setup_faults import is_implausible, unexplained
from pisigma.workflow.settings.evaluation import EvaluationSettings

REFERENCES = ("nominal", "geometric")
"""Names of what a model is compared with: the robot as drawn, and the geometry under a hybrid. Neither has to meet
limits."""


@dataclass(frozen=True)
class EvaluatedModel:
    """What an evaluated model is, beside its figures.

    Attributes:
        model: its folder, or its name.
        kind: of model.
        trained_on: whether the rows are those that it was made of.
    """

    model: str
    kind: str
    trained_on: bool


@dataclass(frozen=True)
class Evaluation:
    """Models compared on the same rows.

    Attributes:
        data: file of the rows.
        rows: number of rows that were judged.
        settings: how.
        comparison: figures of every model, with confidence intervals and differences to the first.
        evaluated: by name in the comparison, what each model is; references are not among them.
        missed: limits that are missed, in sentences without their ends.
        diagnostics: why errors of a model are not those of a calibrated robot, where they are not.
        warnings: what else should be known, in sentences.
        seconds: that it took.
    """

    data: str
    rows: int
    settings: EvaluationSettings
    comparison: ModelComparison
    evaluated: Mapping[str, EvaluatedModel]
    missed: tuple[str, ...]
    diagnostics: tuple[Diagnostic, ...]
    warnings: tuple[str, ...]
    seconds: float

    @property
    def models(self) -> tuple[ModelFigures, ...]:
        """Figures of every model, in the order in which they were given."""
        return self.comparison.models

    @property
    def accepted(self) -> bool:
        """Whether every model meets every limit, and no errors are implausible."""
        return not self.missed and not self.diagnostics

    def to_json(self) -> dict[str, object]:
        """Return everything as plain values: the result of `pisigma evaluate --json`."""
        comparison = self.comparison.to_json()
        comparison["models"] = [
            model.to_json() | (asdict(self.evaluated[model.name]) if model.name in self.evaluated else {})
            for model in self.models
        ]
        values: dict[str, object] = {
            "data": self.data,
            "rows": self.rows,
            "frame_fitted": self.settings.fit_frame,
            "tool_fitted": self.settings.fit_tool,
            **comparison,
        }
        if stated := self.settings.limits.stated:
            values |= {"limits": stated, "accepted": self.accepted, "missed": list(self.missed)}
        values["diagnostics"] = [one.model_dump() for one in self.diagnostics]
        return values | self._single() | {"warnings": list(self.warnings), "seconds": self.seconds}

    def _single(self) -> dict[str, object]:
        """Repeat the figures of a single model beside nominal, so that programs need not search for them."""
        if len(self.models) != 2 or len(self.evaluated) != 1 or self.models[0].name != "nominal":
            return {}
        model, what = self.models[1], self.evaluated[self.models[1].name]
        nominal, corrected = (one.statistics_in_file_units for one in self.models)
        return {
            "model": what.model,
            "rows_not_predicted": model.rows_not_predicted,
            "trained_on": what.trained_on,
            "nominal": nominal,
            "corrected": corrected,
        }


def evaluate(
    models: ModelSource | HoldsModel | Sequence[ModelSource | HoldsModel],
    data: Measurements | MeasurementFiles,
    settings: EvaluationSettings | None = None,
) -> Evaluation:
    """Compare models on measurements, with confidence intervals, and hold them against limits.

    Args:
        models: one or several folders or models, and the words "nominal" (the robot as drawn, base and tool fitted)
            and "geometric" (what a hybrid builds upon) of the first that has it. A single model is compared with
            nominal.
        data: measurements, or their files, in the frames that the models were fitted in. Where rows are marked, only
            those of the set "test" are judged.
        settings: how. None: no limits, 2000 resamples.

    Raises:
        ModelError: a folder cannot be used, or no model is given.
        MeasurementError: the rows cannot be used, or no row can be compared.
        PoseError: the joint values do not fit a robot.
    """
    settings, begin = settings or EvaluationSettings(), time.perf_counter()
    if isinstance(models, str | os.PathLike | CalibratedModel | HoldsModel):
        models = [models]
    sources = labelled(models)
    loaded = load_models(sources)
    everything = read_rows(data, next(iter(loaded.values())).robot, settings.cameras)
    rows = test_rows(everything)
    compared = with_references(list(sources), loaded, rows.rotation is not None)
    hashes = everything.content_hash(), rows.content_hash()
    distances = matching_sockets(settings.socket_distances, rows.socket or ())
    right = without_wrong_rows(loaded.values(), rows, settings.fitted)
    rows = right.rows
    comparison = compare_models(compared, rows, settings.bootstrap, settings.fitted, distances)
    evaluated = {
        label: EvaluatedModel(_text(sources[label]), model.kind, model.provenance.data_sha256 in hashes)
        for label, model in loaded.items()
    }
    judged = [figures for figures in comparison.models if figures.name in evaluated]
    return Evaluation(
        data=everything.source,
        rows=rows.rows,
        settings=settings,
        comparison=comparison,
        evaluated=evaluated,
        missed=tuple(sentence for figures in judged for sentence in settings.limits.missed_by(figures)),
        diagnostics=tuple(
            diagnostic
            for figures in judged
            for diagnostic in (
                *_diagnostics(loaded[figures.name], figures, rows, settings.fitted),
                *missed_distances(comparison, figures),
            )
        ),
        warnings=(
            *right.warnings,
            *fitted_remark(rows, settings.fitted),
            *places_remark(rows),
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
        seconds=time.perf_counter() - begin,
    )


def test_rows(measurements: Measurements) -> Measurements:
    """Select the rows that are marked as test; all where none is marked.

    Raises:
        MeasurementError: all rows are marked as train.
    """
    if measurements.split is None:
        return measurements
    test = torch.tensor([name == "test" for name in measurements.split])
    if not test.any():
        raise MeasurementError(
            f"{measurements.source}: column 'set' marks all rows as 'train'; mark some as 'test' or remove the column."
        )
    return measurements.select(test)


def _text(source: ModelSource) -> str:
    return source.name if isinstance(source, CalibratedModel) else os.fspath(source)


def labelled(stated: Sequence[ModelSource | HoldsModel]) -> dict[str, ModelSource]:
    """Name models for tables: by the folder's last name, or by all that was given where two have the same.

    Raises:
        ModelError: a model is given twice.
    """
    sources = [model_or_folder(source) for source in stated]
    texts = [_text(source) for source in sources]
    twice = next((text for text in texts if texts.count(text) > 1), None)
    if twice is not None:
        raise ModelError(f"{twice} is given twice; give every model once.")
    short = [text if text in REFERENCES else Path(text).resolve().name for text in texts]
    taken = [*short, *(name for name in REFERENCES if name not in texts)]
    labels = [name if taken.count(name) == 1 else text for name, text in zip(short, texts, strict=True)]
    return dict(zip(labels, sources, strict=True))


def load_models(sources: Mapping[str, ModelSource]) -> dict[str, CalibratedModel]:
    """Load all models but the references."""
    loaded = {
        label: source if isinstance(source, CalibratedModel) else load_model(source)
        for label, source in sources.items()
        if source not in REFERENCES
    }
    if not loaded:
        raise ModelError(
            f"'{' '.join(sources)}' is not enough, as it is derived from a model; give a model folder besides (a "
            f"folder of that name as ./{next(iter(sources), 'model')})."
        )
    return loaded


def with_references(
    labels: Sequence[str], loaded: Mapping[str, CalibratedModel], turned: bool
) -> dict[str, CalibratedModel]:
    """Add the references to the models, in the order in which they were given; nominal before a single one."""
    first = next(iter(loaded.values()))
    identified = next((model for model in loaded.values() if model.calibrated is not None), first)
    models = {}
    for label in ["nominal", *labels] if len(labels) == 1 else labels:
        model = loaded.get(label)
        if model is None:
            model = nominal_model(first, turned) if label == "nominal" else geometric_model(identified)
        models[label] = model
    return models


def _diagnostics(
    model: CalibratedModel, figures: ModelFigures, rows: Measurements, fitted: Sequence[FrameKind]
) -> Iterator[Diagnostic]:
    """Say why errors are too large to be those of a calibrated robot, or those of a base or a tool that has moved."""
    implausible = is_implausible(figures, model)
    nominal = nominal_model(model, rows.rotation is not None) if implausible else None
    found = check_rows(rows, model, fitted, nominal=nominal).implausible
    if implausible and not found:
        found = (Diagnostic(kind="implausible_errors", severity="implausible", sentence=unexplained(model)),)
    for one in found:
        yield one.model_copy(update={"sentence": f"{figures.name}: {one.sentence}"})


def _warnings(comparison: ModelComparison) -> list[str]:
    warnings = []
    if comparison.rows_without_position:
        warnings.append(
            f"{comparison.rows_without_position} rows hold no position, or are alone in their socket, and are not "
            "judged."
        )
    for model in comparison.models:
        if model.rows_not_predicted:
            warnings.append(
                f"{model.rows_not_predicted} rows lie so far outside the domain of {model.name} that it predicts "
                "nothing; they are left out for all models."
            )
    return warnings
