"""Comparison of two models of one robot: parameters, tool positions, errors on rows, and programs."""

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pisigma.files.model_files import model_hash
from pisigma.files.output_file import check_page, write_atomically
from pisigma.lifetime.comparison.model_pair import Displacement, ModelPair
from pisigma.lifetime.comparison.parameter_differences import (
    ParameterDifference,
    ParameterDifferences,
    parameter_differences,
)
from pisigma.measurement.camera.corner_file import MeasurementFiles, read_rows
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.exceeded_limits import row_warnings
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.folder.model_folder import HasModel, ModelSource, model_or_folder
from pisigma.model.training_rows import training_row_warnings
from pisigma.planning.task import read_task
from pisigma.validation.checks.wrong_rows import without_wrong_rows
from pisigma.validation.gate import check_rows
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.held_out.frames.fitted_frames import fitted_kinds
from pisigma.validation.held_out.model_comparison import Difference, ModelComparison, compare_models
from pisigma.workflow.evaluate import REFERENCES, load_models, models_by_label, test_rows, with_references
from pisigma.workflow.settings.comparison import ComparisonSettings


@dataclass(frozen=True, eq=False)
class ComparedModels:
    """Result of `compare`: two models of one robot side by side.

    Attributes:
        models: the first and the second model by their names in tables.
        settings: settings of the comparison.
        parameters: all parameters side by side, and the parameters that differ.
        workspace_displacement: distances between the tool poses of both models over the workspace.
        row_comparison: errors of both models on the same rows; None if no rows are given.
        program_displacement: distances along a program that was taught with the first model; None without a program.
        diagnostics: reasons why the rows must not be trusted; see `pisigma.validation.gate`.
        warnings: sentences that warn of problems.
        seconds: computing time [s].
    """

    models: dict[str, CalibratedModel]
    settings: ComparisonSettings
    parameters: ParameterDifferences
    workspace_displacement: Displacement
    row_comparison: ModelComparison | None
    program_displacement: Displacement | None
    diagnostics: tuple[Diagnostic, ...]
    warnings: tuple[str, ...]
    seconds: float

    @property
    def better_model(self) -> str | None:
        """Name of the model that predicts the rows significantly better; None if there is none, or untrusted rows."""
        difference = self._difference
        interval = None if difference is None else difference.intervals["rms"]
        if interval is None or interval[0] <= 0.0 <= interval[1] or self.diagnostics:
            return None
        first, second = self.models
        return second if interval[1] < 0.0 else first

    @property
    def displacements(self) -> dict[str, Displacement]:
        """Return distances between the tools over the workspace and, if there is a program, along the program."""
        over, along = self.workspace_displacement, self.program_displacement
        return {f"over {over.source}": over} | ({} if along is None else {f"along {along.source}": along})

    @property
    def sentences(self) -> tuple[str, ...]:
        """Sentences that state the results of the comparison."""
        return (
            *_parameters_in_words(self.parameters, *self.models),
            *self._displacements_in_words(),
            *self._rows_in_words(),
        )

    def to_json(self) -> dict[str, Any]:
        """Return all results as plain values, in mm and deg: the result of `pisigma compare --json`."""
        differences, rows, (first, _) = self.parameters, self.row_comparison, self.models.values()
        return {
            "models": [{"name": name, "kind": model.kind} for name, model in self.models.items()],
            "robot": first.robot.name,
            "frames": self.settings.frames,
            "level": differences.significance_level,
            "differs": [one.to_json() for one in differences.significant_differences],
            "parameters": [_parameter_json(one) for one in differences.parameters],
            "frames_moved": [one.to_json() for one in differences.frame_movements],
            "remainder": None if differences.remainder is None else vars(differences.remainder),
            "workspace": self.workspace_displacement.to_json(first.robot),
            "rows": None if rows is None else {**rows.to_json(), "better": self.better_model},
            "diagnostics": [one.model_dump(by_alias=True) for one in self.diagnostics],
            "program": None
            if self.program_displacement is None
            else self.program_displacement.to_json(first.robot),
            "summary": list(self.sentences),
            "warnings": list(self.warnings),
            "seconds": round(self.seconds, 3),
        }

    def save_page(self, page: str | os.PathLike[str]) -> None:
        """Write the comparison as one HTML file.

        Raises:
            OutputError: the page is not an .html file, or cannot be written.
        """
        from pisigma.reporting.page.lifetime import comparison_page  # importing matplotlib takes a second

        check_page(Path(page))
        says = self.sentences, self.warnings
        text = comparison_page(self.models, self.parameters, self.displacements, self.row_comparison, says)
        write_atomically(Path(page), text)

    @property
    def _difference(self) -> Difference | None:
        return None if self.row_comparison is None else self.row_comparison.models[1].position.difference

    def _displacements_in_words(self) -> tuple[str, ...]:
        """Return a text on the distances between the tools over the workspace and along a program."""
        first, second = self.models
        figures = self.workspace_displacement.errors.figures.figures_by_name
        where = " with base and tool fitted" if self.settings.frames == "fitted" else ""
        lines = [
            f"Over the workspace, the tool positions of {second} and {first} differ by {figures['rms_mm']:.3f} mm (RMS)"
            f"{where}, at most by {figures['max_mm']:.3f} mm."
        ]
        if (program := self.program_displacement) is not None:
            figures, largest = program.errors.figures.figures_by_name, program.index_of_largest
            lines.append(
                f"The poses of {program.source}, taught with {first}, are off by {figures['rms_mm']:.3f} mm (RMS) "
                f"under {second}, at most by {figures['max_mm']:.3f} mm at pose {int(program.number[largest])}."
            )
        return tuple(lines)

    def _rows_in_words(self) -> tuple[str, ...]:
        """Return a text that states which model predicts the rows better."""
        difference, rows = self._difference, self.row_comparison
        if difference is None or rows is None:
            return ()
        errors = " and ".join(
            f"{one.position.statistics['rms']:.3f} mm under {one.name}" for one in rows.models
        )
        if self.diagnostics:
            doubts = " ".join(one.sentence for one in self.diagnostics)
            return (f"The RMS error of {rows.rows} rows is {errors}, which is not conclusive: {doubts}",)
        which = (
            f"{self.better_model} predicts them better"
            if self.better_model
            else "neither predicts them significantly better"
        )
        return (
            f"The RMS error of {rows.rows} rows is {errors}: {which} (Wilcoxon's p {difference.test.p:.2g}).",
        )


def compare(
    first: ModelSource | HasModel,
    second: ModelSource | HasModel,
    rows: MeasurementFiles | Measurements | None = None,
    program: str | os.PathLike[str] | None = None,
    settings: ComparisonSettings = ComparisonSettings(),
) -> ComparedModels:
    """Compare the parameters of two models of one robot, and the effect of their differences on the tool.

    Args:
        first: a model or its folder, or "nominal" (the nominal robot) or "geometric" (the geometric part of a hybrid)
            of the other model.
        second: the model to compare with, given in the same way.
        rows: measurements, or their file, on which both models are compared. If rows are marked, only those of the set
            "test" are used.
        program: file of joint values, or of poses in the frame of the measurements, that was taught with the first
            model.
        settings: see `ComparisonSettings`.

    Raises:
        ModelError: a folder cannot be used, or the models belong to different robots.
        MeasurementError: rows or program cannot be used.
        PlanningError: the first model does not reach a pose of the program.
        PoseError: the joint values do not fit the robot.
    """
    started, first, second = time.perf_counter(), model_or_folder(first), model_or_folder(second)
    if (
        isinstance(first, CalibratedModel)
        and isinstance(second, CalibratedModel)
        and first.name == second.name
    ):
        second = replace(second, name=f"{second.name}-2")
    sources = models_by_label([first, second])
    loaded = load_models(sources)
    models = with_references(list(sources), loaded, with_orientation=True)
    one, other = models.values()
    pair = ModelPair.from_models(one, other, settings.frames)
    compared, warnings = None, _warnings(pair, list(sources.values()))
    diagnostics: tuple[Diagnostic, ...] = ()
    if rows is not None:
        data = read_rows(rows, pair.first.robot, settings.cameras)
        warnings += row_warnings(pair.first.robot, data)
        for label, model in loaded.items():
            warnings += training_row_warnings(replace(model, name=label), test_rows(data), data)
        free = settings.frames == "fitted"
        fitted = fitted_kinds(free, free)
        right = without_wrong_rows(loaded.values(), test_rows(data), fitted)
        warnings += right.warnings
        compared = compare_models(models, right.rows, settings.bootstrap, fitted)
        found = [
            check_rows(right.rows, model, fitted, {"joint_zero"}).implausible_findings
            for model in loaded.values()
        ]
        diagnostics = (
            found[0] if all(found) else ()
        )  # rows that one of the models predicts belong to this robot
    return ComparedModels(
        models=models,
        settings=settings,
        parameters=parameter_differences(pair, settings.level),
        workspace_displacement=Displacement.from_pair(pair, pair.workspace_joints, "the workspace"),
        row_comparison=compared,
        program_displacement=None
        if program is None
        else Displacement.from_pair(pair, read_task(program, pair.first), Path(program).name),
        diagnostics=diagnostics,
        warnings=warnings,
        seconds=time.perf_counter() - started,
    )


def _parameters_in_words(differences: ParameterDifferences, first: str, second: str) -> tuple[str, ...]:
    """Return a text on the parameters that differ, and on whether the remaining differences are significant."""
    if differences.remainder is None:
        return (
            "A model has no posterior of its parameters, so the significance of their differences is unknown; "
            "make it with `pisigma calibrate`.",
        )
    level = f"at a significance level of {differences.significance_level:.2g} for all parameters together"
    lines = [f"No parameter of {second} differs from {first} beyond its uncertainty, {level}."]
    if differences.significant_differences:
        shifts = "; ".join(one.sentence for one in differences.significant_differences)
        lines = [
            f"{second} differs from {first} in {shifts}. No other parameter differs beyond its uncertainty, {level}."
        ]
    if differences.remainder.significant:
        lines.append(
            "The remaining differences are significant: the joint corrections or several parameters differ."
        )
    pairs = zip(differences.frame_movements[::2], differences.frame_movements[1::2], strict=True)
    clauses = [
        f"in the {length.what} by {length.shift_text} and {angle.shift_text}" for length, angle in pairs
    ]
    return (*lines, *((f"{second} differs from {first} {' and '.join(clauses)}.",) if clauses else ()))


def _parameter_json(one: ParameterDifference) -> dict[str, Any]:
    """Return a parameter as plain values, with the unit in the names of its figures."""
    figures = {
        "first": one.first,
        "second": one.second,
        "difference": one.difference,
        "first_deviation": one.sigmas[0],
        "second_deviation": one.sigmas[1],
        "shift": one.shift,
        "shift_deviation": one.sigma,
    }
    with_unit = {f"{name}_{one.unit}": value for name, value in figures.items()}
    return {"name": one.name, **with_unit, "p": one.p_value, "equivalent": list(one.equivalent_parameters)}


def _warnings(pair: ModelPair, sources: Sequence[ModelSource]) -> tuple[str, ...]:
    """Return warnings about models that share information."""
    warnings = []
    models = (pair.first, pair.second)
    for child, parent, source in zip(models, models[::-1], reversed(sources), strict=True):
        if isinstance(source, CalibratedModel) or source in REFERENCES:
            continue
        if (child.metrics.get("parent") or {}).get("sha256") == model_hash(source):
            warnings.append(
                f"{child.name} was made from {parent.name}, so their errors are partly the same: differences are "
                "more certain than stated."
            )
    data = [model.provenance.data_sha256 for model in models]
    if data[0] and data[0] == data[1]:
        warnings.append(
            "Both models were made from the same rows, so their errors are partly the same: differences are more "
            "certain than stated."
        )
    return tuple(warnings)
