"""Models of a cell: entries in the history, changes of the model in use, and comparison on new rows."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from pisigma.files.model_files import is_unchanged, model_hash
from pisigma.files.progress import Progress
from pisigma.lifetime.cell.events import Event, EventKind
from pisigma.lifetime.cell.history import Check, History, InUse, ModelEntry, SessionEntry, now
from pisigma.lifetime.cell.layout import MODELS, checked_model
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.folder.model_folder import load_model
from pisigma.robot.description import Robot
from pisigma.validation.report.accuracy import identified_noise_sigma_mm
from pisigma.workflow.calibrate import Calibration, calibrate
from pisigma.workflow.cell.sessions import Sessions
from pisigma.workflow.cell.setup_names import RowsWithModelNames, newest_day, setup_name
from pisigma.workflow.evaluate import evaluate
from pisigma.workflow.monitor import MonitoringResult
from pisigma.workflow.recalibrate import Recalibration, recalibrate
from pisigma.workflow.result import AbstractModelResult
from pisigma.workflow.settings.calibration import WITH_PRIOR, CalibrationSettings
from pisigma.workflow.settings.evaluation import EvaluationSettings
from pisigma.workflow.settings.recalibration import RecalibrationSettings

_MIN_ROWS = 10
"""Minimum number of rows of the newest session, which is held out."""
Value = TypeVar("Value")
Result = TypeVar("Result", bound=Calibration | Recalibration)


def is_better(
    cell_sessions: Sessions,
    model_in_use: ModelEntry,
    sessions: Sequence[SessionEntry],
    settings: CalibrationSettings,
    progress: Progress,
) -> tuple[bool, str]:
    """Return whether a calibration from some sessions is better than the model in use, and the reason.

    The calibration is repeated without the newest session, on which both are then compared. It is better if the
    confidence interval of the difference of the mean position errors is below 0.

    Args:
        cell_sessions: the sessions of the cell.
        model_in_use: the model in use.
        sessions: sessions to which the new calibration was fitted, in the order of their days.
        settings: settings of the calibration.
        progress: called with the name of each step.
    """
    newest, older, folder = (
        sessions[-1],
        list(sessions[:-1]),
        cell_sessions.folder.parent / MODELS / model_in_use.name,
    )
    if not is_unchanged(folder, model_in_use.sha256):
        return False, f"model '{model_in_use.name}', which is in use, was changed or removed"
    if newest.name in model_in_use.made_of or newest.rows < _MIN_ROWS or not older:
        return (
            False,
            f"there is no session of {_MIN_ROWS} rows or more to compare it with '{model_in_use.name}'",
        )
    progress("calibration without the newest session")
    alone = replace(settings, cameras=None, folds=0, hold_out=None)
    without = calibrate(cell_sessions.robot, cell_sessions.rows_of(older), alone)
    events, day = cell_sessions.history.events(), older[-1].day
    entry = replace(
        model_in_use,
        day=day,
        frame_day=newest_day(events, "instrument", day),
        target_day=newest_day(events, "tool", day),
    )
    rows = cell_sessions.rows_of_file(newest)
    seen = [cell_sessions.rows_with_model_names(one, rows, newest.day) for one in (model_in_use, entry)]
    old = load_model(folder)
    judged = evaluate(
        [
            replace(old, name="in use"),
            replace(with_setup_names_of(without.model, entry, model_in_use), name="new"),
        ],
        seen[0].rows,
        EvaluationSettings(
            fit_frame=any(one.fit_frame for one in seen), fit_tool=any(one.fit_tool for one in seen)
        ),
    )
    difference = judged.models[-1].position.difference
    interval = None if difference is None else difference.intervals["mean"]
    means = [f"{one.position.statistics['mean']:.3f} mm ({one.name})" for one in judged.models]
    figures = f"mean errors of session '{newest.name}', to which neither was fitted: {' and '.join(means)}"
    return interval is not None and interval[1] < 0, figures


def with_setup_names_of(model: CalibratedModel, entry: ModelEntry, other: ModelEntry) -> CalibratedModel:
    """Return a model whose newest frame and tool have the names of frame and tool of another model."""

    def with_day(values: Mapping[str, Value], day: str, other_day: str) -> dict[str, Value]:
        newest = {setup_name(name, other_day): value for name, value in _of_day(values, day).items()}
        return newest | {name: value for name, value in values.items() if name not in newest}

    frame, tool = (entry.frame_day, other.frame_day), (entry.target_day, other.target_day)
    return replace(
        model,
        bases=with_day(model.bases, *frame),
        hybrid_bases=with_day(model.hybrid_bases, *frame),
        tools=with_day(model.tools, *tool),
        hybrid_tools=with_day(model.hybrid_tools, *tool),
    )


def _of_day(values: Mapping[str, Value], day: str) -> dict[str, Value]:
    """Return the frames or tools that were set up on a day, by their names in files of rows."""
    ending = setup_name("", day)
    if not day:
        return {name: value for name, value in values.items() if " since " not in f" {name}"}
    return {
        name.removesuffix(ending).rstrip(): value for name, value in values.items() if name.endswith(ending)
    }


def monitoring_check_entry(
    monitoring: MonitoringResult,
    entry: ModelEntry,
    session: SessionEntry,
    rows: RowsWithModelNames,
    settings: RecalibrationSettings,
) -> Check:
    """Return the history entry of a session's monitoring result.

    A recalibration is due if something moved, or if the recalibrated model predicts held-out rows better.

    Args:
        monitoring: result of the session.
        entry: the model with which the session was compared.
        session: the session.
        rows: rows of the session with the names of the model.
        settings: settings of the recalibration.
    """
    check = Check("monitor", entry.name, session.name, "implausible", "", None, False, now())
    if monitoring.untrusted_sessions:
        return replace(check, summary=monitoring.untrusted_sessions[0].sentence)
    judged = monitoring.sessions_of_call[-1].session
    check = replace(check, verdict=judged.verdict, summary=judged.sentence, rms_mm=judged.rms * 1e3)
    if judged.recalibrate or judged.verdict == "moved":
        return replace(check, recalibrate=True)
    if session.rows < _MIN_ROWS:
        return check
    tried = recalibrate(monitoring.model, rows.rows, rows.settings_to_recalibrate(settings))
    if not (tried.trusted and tried.candidate_choice.updates_model):
        return check
    return replace(check, recalibrate=True, summary=f"{judged.sentence} {tried.candidate_choice.sentence}")


def unrecorded_changes(
    result: Recalibration, session: SessionEntry, recorded: Collection[str], valid: Sequence[SessionEntry]
) -> list[Event]:
    """Return the unrecorded changes of instrument and tool that a recalibration found.

    None is returned if another session was measured on the same day, possibly before the change.

    Args:
        result: the recalibration.
        session: session of the recalibration.
        recorded: "base" or "tool" or both, if events since the parent record that they were changed.
        valid: all valid sessions.
    """
    if [one.day for one in valid].count(session.day) > 1:
        return []
    moved = {
        one.split()[0]
        for one in (*result.summary.relocated_frames, *(part.what for part in result.movements))
    }
    kinds: dict[str, EventKind] = {"base": "instrument", "tool": "tool"}
    note = f"found by the recalibration with session '{session.name}'"
    return [
        Event(session.day, kind, note, now())
        for what, kind in kinds.items()
        if what in moved and what not in recorded
    ]


def calibrate_rows(
    robot: Robot, rows: Measurements, settings: CalibrationSettings, prior: Path | None, progress: Progress
) -> Calibration | Recalibration:
    """Calibrate a robot with given rows, from scratch or from the prior of a fleet.

    A calibration from scratch without a validation is stored without figures, which take longer than the calibration.
    """
    if prior is None:
        result = calibrate(robot, rows, replace(settings, cameras=None), progress)
        return replace(result, has_drawn_figures=result.summary.validation_errors is not None)
    settings.check_unused(WITH_PRIOR)
    return recalibrate(prior, rows, RecalibrationSettings(), progress, robot)


def model_entry(
    events: Sequence[Event],
    read_at: str,
    path: Path,
    sessions: Sequence[SessionEntry],
    remark: str,
    result: AbstractModelResult,
    parent: ModelEntry | None = None,
) -> ModelEntry:
    """Return the history entry of a new model.

    Args:
        events: events that were recorded when the rows were read; a recalibrated model has the names of its parent.
        read_at: time at which the rows were read (ISO 8601, UTC).
        path: folder of the model.
        sessions: sessions to which the model was fitted.
        remark: reason why the model is or is not in use.
        result: calibration or recalibration that made the model.
        parent: model that was recalibrated; None for a calibration.
    """
    day = max(one.day for one in sessions)
    entry = ModelEntry(
        name=path.name,
        sha256=model_hash(path),
        made=read_at,
        sessions=",".join(one.name for one in sessions),
        day=day,
        frame_day=newest_day(events, "instrument", day),
        target_day=newest_day(events, "tool", day),
        p95_mm=result.held_out_p95_and_best_known_rms_mm[0],
        remark=remark,
        scatter_mm=identified_noise_sigma_mm(result.summary) if isinstance(result, Calibration) else None,
        has_posterior=result.model.uncertainty is not None,
    )
    if parent is None:
        return entry
    return replace(
        entry,
        sessions=",".join((*parent.made_of, entry.sessions)),
        day=max(parent.day, day),
        frame_day=parent.frame_day,
        target_day=parent.target_day,
        parent=parent.name,
        scatter_mm=parent.scatter_mm,
    )


def put_into_use(history: History, model: str, reason: str, undo: bool = False) -> None:
    """Record that a model is in use from now on.

    Args:
        history: history of the cell.
        model: name of a model of the cell; empty if no model is in use from now on.
        reason: reason to record.
        undo: whether this undoes the last change.

    Raises:
        ModelError: the folder of the model was changed or removed.
    """
    if model:
        checked_model(history.path.parent, history.model(model))
    history.add(InUse(model, now(), reason, undo))


def with_warnings(result: Result, warnings: tuple[str, ...]) -> Result:
    """Return a calibration or a recalibration with additional warnings, which its card also states."""
    if not warnings:
        return result
    summary = result.summary.model_copy(update={"warnings": (*warnings, *result.summary.warnings)})
    return replace(result, summary=summary)  # type: ignore[arg-type]  # that of the same class
