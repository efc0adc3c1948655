"""Recalibrate a model with a few new rows."""

import datetime
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.calibration.hybrid.result import HybridResult
from pisigma.files.errors import IdentificationError, ModelError
from pisigma.files.model_files import model_hash
from pisigma.files.progress import Progress, with_stage
from pisigma.lifetime.recalibration.adaptation import Adaptation, adapt
from pisigma.lifetime.recalibration.candidates import (
    CLEAR_RATIO,
    KIND,
    CandidateChoice,
    choose_candidate,
    recalibrated_model,
    recalibration_diagnostics,
)
from pisigma.lifetime.recalibration.movement import Movement, movements_text, significant_movements
from pisigma.lifetime.recalibration.recalibration_problem import FrameKey, frame_keys, recalibration_problem
from pisigma.lifetime.recalibration.relocated_frames import relocated_frames
from pisigma.lifetime.recalibration.summary import HeldOutFigures, RecalibrationSummary
from pisigma.measurement.camera.corner_file import MeasurementFiles, read_rows
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.exceeded_limits import row_warnings
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.folder.model_folder import HasModel, ModelSource, loaded_model
from pisigma.model.geometric_model import model_of_hybrid
from pisigma.model.model_posterior import FLEET_PRIOR, ModelPosterior, check_fleet_prior
from pisigma.model.stated_conditions import condition_warnings
from pisigma.model.training_rows import with_wide_limits, without_known_rows
from pisigma.reporting.derived_cards import write_recalibration_card
from pisigma.robot.description import Robot
from pisigma.robot.robot_class import plausible_error_per_reach
from pisigma.validation.checks.check import MOVES, Move
from pisigma.validation.checks.wrong_rows import FilteredRows, without_wrong_rows
from pisigma.validation.gate import check_rows
from pisigma.validation.held_out.contradicting_row import ContradictingRowFigures, contradicting_rows
from pisigma.validation.held_out.distillation_summary import ParentFigures
from pisigma.validation.held_out.few_rows import fit_if_better
from pisigma.validation.held_out.frames.fitted_frames import fitted_kinds
from pisigma.validation.held_out.trained_calibrations import fit
from pisigma.workflow.result import AbstractModelResult
from pisigma.workflow.settings.recalibration import RecalibrationSettings

if TYPE_CHECKING:
    from pisigma.lifetime.fleet.prior import FleetConsistency

_MIN_ROWS = 5
"""Number of held-out rows below which a warning is given."""
_UNBELIEVABLE = "What has moved is unknown: the recalibrated model does not predict held-out rows."
NOT_TRUSTED = "What has moved is unknown: these rows must not be trusted."


@dataclass(frozen=True, eq=False)
class Recalibration(AbstractModelResult):
    """Result of `recalibrate`: the candidate that predicts held-out rows best.

    Attributes:
        model: the recalibrated model, with all figures as its metrics, as `pisigma.load` would read it.
        parent: the model to which the rows were added.
        adaptation: adaptation of the parent to all rows.
        candidate_choice: errors of held-out rows under every candidate.
        movements: parts that have moved significantly.
        summary: all figures.
        seconds: computing time [s].
    """

    model: CalibratedModel
    parent: CalibratedModel
    adaptation: Adaptation
    candidate_choice: CandidateChoice
    movements: tuple[Movement, ...]
    summary: RecalibrationSummary
    seconds: float

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return warnings, one sentence each."""
        return self.summary.warnings

    @property
    def held_out_p95_and_best_known_rms_mm(self) -> tuple[float | None, float | None]:
        """95 % quantile and RMS of the position errors of held-out rows [mm]; see `AbstractModelResult`."""
        p95 = self.candidate_choice.p95.get(self.candidate_choice.kept)
        return None if p95 is None else p95 * 1e3, self.summary.cross_validation[
            self.summary.kept_candidate
        ].rms_mm

    def _describe(self, model: CalibratedModel, summary: RecalibrationSummary, folder: Path) -> None:
        write_recalibration_card(model, summary, folder)


def recalibrate(
    model: ModelSource | HasModel,
    data: Measurements | MeasurementFiles,
    settings: RecalibrationSettings = RecalibrationSettings(),
    progress: Progress = lambda what: None,
    nominal: Robot | None = None,
) -> Recalibration:
    """Update a model with new rows, and choose the candidate that predicts held-out rows best.

    The candidates are the old model, the model updated with the rows, and a calibration from scratch.

    Args:
        model: model of `pisigma calibrate`, `pisigma recalibrate` or `pisigma fleet prior`, an object that contains
            such a model (a `CorrectedIK`, a `Calibration`), or its folder.
        data: new rows of any sensors, or CSV files of them. Rows of the set "test" are not used.
        settings: see `RecalibrationSettings`.
        progress: called with the current step.
        nominal: nominal robot; the model must then be the prior of its fleet. None for any model.

    Returns:
        The chosen model with its figures; `save` writes it as a model folder.

    Raises:
        ModelError: the folder is not that of a model, or the model belongs to another robot, has no posterior, or is
            not the prior of a fleet although `nominal` is given.
        MeasurementError: the data cannot be read.
        IdentificationError: the rows do not determine a base or a tool.
        PoseError: the joint values do not fit the robot.
    """
    started = time.perf_counter()
    parent, folder = loaded_model(model)
    sha256 = "" if folder is None else model_hash(folder)
    if nominal is not None:
        check_fleet_prior(parent)
    posterior = ModelPosterior.from_model(parent)
    if nominal is not None and not np.array_equal(nominal.dh, posterior.space.robot.dh):
        raise ModelError(
            f"expected a model of robot '{nominal.name}', got model '{parent.name}' of robot "
            f"'{posterior.space.robot.name}'",
            value=parent.name,
            remedy="choose a model of this robot",
        )
    nominal = posterior.space.robot
    measurements = read_rows(data, nominal, settings.cameras)
    rows, again = without_known_rows(parent, posterior.with_model_names(measurements.split_sets()[0]))
    progress("checking the rows")
    right = FilteredRows(rows) if parent.kind == FLEET_PRIOR else filtered_rows(settings, parent, rows)
    verdict = check_rows(right.rows, parent, settings.fitted_kinds, allowed_moves(settings))
    progress("what has moved")
    elsewhere = _moved_frames(parent, posterior, rows, settings)
    every = rows
    rows, adaptation, outliers = _adapted(parent, posterior, every, elsewhere, right.wrong_row_indices)
    consistency = _fleet_consistency(parent, rows)
    if consistency is not None and consistency.class_covariance_factor > 0:
        # The narrow prior may have rejected rows that are right for a robot unlike its fleet.
        wide = consistency.widened(posterior)
        rows, adaptation, outliers = _adapted(parent, wide, every, elsewhere, right.wrong_row_indices)
    calibrator = HybridCalibrator(nominal)
    choice = choose_candidate(
        parent, adaptation, elsewhere, rows, calibrator, with_stage(progress, "cross-validation")
    )
    odd = consistency is not None and consistency.is_inconsistent
    from_scratch = with_stage(progress, "from scratch")
    choice, kept = _kept(choice, odd, parent, adaptation, rows, calibrator, from_scratch)
    moved = (
        significant_movements(adaptation) if consistency is None and _believable(choice, nominal) else None
    )
    wrong = [one.row for one in outliers]
    diagnostics = verdict.implausible_findings or recalibration_diagnostics(
        parent, choice, every, adaptation, wrong, moved or ()
    )
    moved = None if diagnostics else moved
    summary = _summary(parent, rows, adaptation, choice, moved)
    summary = summary.with_figures(
        diagnostics=diagnostics,
        warnings=(*again, *summary.warnings),
        parent=ParentFigures(name=parent.name, kind=parent.kind, sha256=sha256),
        outliers=outliers,
        relocated_frames=tuple(" ".join(owner).strip() for owner in sorted(elsewhere)),
    )
    if diagnostics:
        summary = summary.with_figures(change_sentence=NOT_TRUSTED)
    if consistency is not None:
        summary = summary.with_figures(change_sentence=consistency.sentence)
    kept = with_wide_limits(replace(kept, metrics=summary.to_json()), rows)
    return Recalibration(
        kept, parent, adaptation, choice, moved or (), summary, seconds=time.perf_counter() - started
    )


def _adapted(
    parent: CalibratedModel,
    posterior: ModelPosterior,
    rows: Measurements,
    elsewhere: frozenset[FrameKey],
    far: Sequence[int],
) -> tuple[Measurements, Adaptation, tuple[ContradictingRowFigures, ...]]:
    """Return the rows that are not wrong, the model adapted to them, and the wrong rows including `far`."""
    left = [row for row in range(rows.rows) if row not in far]
    right = rows.select(torch.tensor(left)) if far else rows
    adaptation = adapt(recalibration_problem(parent, posterior, right, elsewhere))
    wrong = [left[row] for row in adaptation.wrong_rows]
    if wrong:  # wrong rows have biased the first adaptation
        right = rows.select(torch.tensor([row for row in left if row not in wrong]))
        adaptation = adapt(recalibration_problem(parent, posterior, right, elsewhere))
    return right, adaptation, contradicting_rows(adaptation, rows, sorted((*far, *wrong)))


def _kept(
    choice: CandidateChoice,
    odd: bool,
    parent: CalibratedModel,
    adaptation: Adaptation,
    rows: Measurements,
    calibrator: HybridCalibrator,
    progress: Progress,
) -> tuple[CandidateChoice, CalibratedModel]:
    """Return the name of the chosen candidate, and its model.

    A robot that is unlike its fleet keeps the calibration from scratch, if it has enough rows for one.
    """
    if odd:
        alone = replace(choice, kept="scratch")
        try:
            return alone, _kept_model(alone, parent, adaptation, rows, calibrator, progress)
        except IdentificationError:  # too few rows
            choice = choice.smallest_error_choice
    return choice, _kept_model(choice, parent, adaptation, rows, calibrator, progress)


def _kept_model(
    choice: CandidateChoice,
    parent: CalibratedModel,
    adaptation: Adaptation,
    rows: Measurements,
    calibrator: HybridCalibrator,
    progress: Progress,
) -> CalibratedModel:
    """Return the model of the chosen candidate."""
    if choice.kept == "scratch":
        fitted = fit_if_better if choice.rms["scratch"] is None else fit
        result = fitted(calibrator, rows, progress)
        assert isinstance(result, HybridResult)
        return replace(
            model_of_hybrid(parent.name, calibrator.geometric_calibrator.robot, result, rows), kind=KIND
        )
    if choice.kept == "old":
        adaptation = adapt(adaptation.problem.with_fixed_arm(), adaptation.drift.noise)
    return recalibrated_model(parent, adaptation, rows)


def _believable(choice: CandidateChoice, robot: Robot) -> bool:
    """Return whether the recalibrated model predicts held-out rows well enough for its changes to be credible."""
    error, kept = choice.rms["recalibrated"], choice.rms[choice.kept]
    if error is None or kept is None:
        return not choice.held_out_row_count
    return error <= min(plausible_error_per_reach(robot) * robot.reach, CLEAR_RATIO * kept)


def _summary(
    parent: CalibratedModel,
    rows: Measurements,
    adaptation: Adaptation,
    choice: CandidateChoice,
    moved: tuple[Movement, ...] | None,
) -> RecalibrationSummary:
    """Return all figures; `moved` is None if it is unknown."""
    return RecalibrationSummary(
        command=f"pisigma.recalibrate({parent.name!r}, {rows.file_names!r})",
        parent=ParentFigures(name=parent.name, kind=parent.kind, sha256=""),
        date=datetime.date.today().isoformat(),
        rows=rows.rows,
        kept_candidate=choice.kept,
        verdict=choice.sentence,
        held_out_row_count=choice.held_out_row_count,
        cross_validation={
            name: HeldOutFigures(rms_mm=None if rms is None else rms * 1e3)
            for name, rms in choice.rms.items()
        },
        change_sentence=_UNBELIEVABLE if moved is None else movements_text(moved),
        movements=moved or (),
        relocated_frames=(),
        effective_parameters=adaptation.effective_unknowns,
        noise=dict(adaptation.noise.value),
        warnings=_warnings(parent, choice, rows),
    )


def _fleet_consistency(model: CalibratedModel, rows: Measurements) -> "FleetConsistency | None":
    """Return how similar the robot of the rows is to its fleet; None if the model is not the prior of a fleet."""
    if model.kind != FLEET_PRIOR:
        return None
    from pisigma.lifetime.fleet.prior import (
        FleetConsistency,
    )  # this imports statistics, which takes half a second

    return FleetConsistency.from_rows(model, rows)


def _moved_frames(
    model: CalibratedModel, posterior: ModelPosterior, rows: Measurements, settings: RecalibrationSettings
) -> frozenset[FrameKey]:
    """Return the bases and tools that have moved, as stated or else as the evidence shows.

    With the prior of a fleet, all bases and tools are returned, because they differ between robots.
    """
    if model.kind == FLEET_PRIOR:
        return frame_keys(rows, ("base", "tool"))
    if settings.moved is None:
        return relocated_frames(model, posterior, rows)
    return frame_keys(rows, settings.moved)


def _warnings(model: CalibratedModel, choice: CandidateChoice, rows: Measurements) -> tuple[str, ...]:
    """Return warnings, one sentence each."""
    warnings = [*row_warnings(model.robot, rows), *condition_warnings(model, rows)]
    if choice.held_out_row_count < _MIN_ROWS:
        warnings.append(
            f"Only {choice.held_out_row_count} of {rows.rows} rows could be held out and predicted, too few to compare "
            f"the candidates; measure {2 * _MIN_ROWS} poses or more."
        )
    return tuple(warnings)


def allowed_moves(settings: RecalibrationSettings) -> frozenset[Move]:
    """Return what may move although the settings do not state it: a joint zero; base and tool if `moved` is None."""
    return MOVES if settings.moved is None else frozenset({"joint_zero"})


def filtered_rows(
    settings: RecalibrationSettings, model: CalibratedModel, rows: Measurements
) -> FilteredRows:
    """Return the rows without single wrong rows, with base and tool fitted if these may have moved."""
    right = without_wrong_rows([model], rows, settings.fitted_kinds)
    if right.warnings or settings.moved is not None:
        return right
    return without_wrong_rows([model], rows, fitted_kinds(fit_frame=True, fit_tool=True))
