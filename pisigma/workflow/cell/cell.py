"""One robot on its mount: every step of its calibration, with rows and settings from its folder.

`Cell.open` reads a folder that `Cell.create` made. Each step calls the function of the same name in
`pisigma.workflow`, records the results in the history, and decides which model is in use.
"""

import datetime
import os
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

from pisigma.files.errors import ModelError, Place
from pisigma.files.model_files import is_model
from pisigma.files.progress import Progress
from pisigma.lifetime.cell.controller import findings
from pisigma.lifetime.cell.facts import settings_hash
from pisigma.lifetime.cell.history import HISTORY, Check, Entry, History, InUse, ModelEntry, SessionEntry, now
from pisigma.lifetime.cell.layout import MODELS, PLANS, model_folder
from pisigma.lifetime.cell.status import CellStatus, status_of
from pisigma.measurement.camera.camera_files import CameraFiles
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.folder.model_folder import load_model
from pisigma.robot.description import Robot
from pisigma.workflow.calibrate import Calibration
from pisigma.workflow.cell.cell_file import CellFile
from pisigma.workflow.cell.model_choice import (
    calibrate_rows,
    is_better,
    model_entry,
    monitoring_check_entry,
    put_into_use,
    unrecorded_changes,
    with_warnings,
)
from pisigma.workflow.cell.new_cell import NewCell
from pisigma.workflow.cell.new_files import free_path, save_under_new_name
from pisigma.workflow.cell.sessions import Sessions
from pisigma.workflow.cell.setup_names import RowsWithModelNames
from pisigma.workflow.evaluate import Evaluation, evaluate
from pisigma.workflow.monitor import MonitoringResult, monitor
from pisigma.workflow.plan import Plan, plan
from pisigma.workflow.recalibrate import Recalibration, recalibrate
from pisigma.workflow.settings.calibration import CalibrationSettings
from pisigma.workflow.verify import Verification, verify


class Cell:
    """A cell: one robot on its mount, with its settings, sessions, models and history in one folder.

    Attributes:
        folder: folder of the cell.
        file: the `cell.yaml` of the cell.
        history: history of the sessions, events, models and checks.
    """

    def __init__(self, folder: Path, file: CellFile) -> None:
        self.folder, self.file = folder, file
        self.history = History(folder / HISTORY)
        self._settings_sha256 = settings_hash(folder)  # hash of the file that was read

    @staticmethod
    def open(folder: str | os.PathLike[str]) -> "Cell":
        """Open a cell.

        Args:
            folder: folder that contains a `cell.yaml`.

        Raises:
            PlanningError: there is no `cell.yaml`, or it is not valid.
        """
        return Cell(Path(folder), CellFile.read(Path(folder)))

    @staticmethod
    def create(
        folder: str | os.PathLike[str],
        robot: str | os.PathLike[str],
        sensor: str = "tracker",
        limit_mm: float | None = None,
        base: str | None = None,
        tip: str | None = None,
        cameras: CameraFiles | None = None,
    ) -> "Cell":
        """Write the folder of a new cell.

        Args:
            folder: folder to write; it must not exist, or must be empty.
            robot: catalogue name, or a robot file (YAML or URDF), which is copied into the cell.
            sensor: "tracker", "camera", "sockets", "draw-wire" or "touch".
            limit_mm: limit on the 95 % quantile of the position errors [mm]; None for no limit.
            base: base link of the URDF file; poses are in its frame. None for the root link.
            tip: tool link of the URDF file; None for the only end link.
            cameras: cameras and boards, whose files are copied into the cell.

        Raises:
            OutputError: the folder already exists and is not empty, or cannot be written.
            RobotError: the robot is unknown.
            PlanningError: a value is not valid.
        """
        NewCell(os.fspath(robot), sensor, limit_mm, base, tip, cameras).write(Path(folder))
        return Cell.open(folder)

    @property
    def robot(self) -> Robot:
        """The nominal robot."""
        document = self.file.document
        return Robot.load(self.file.robot, document.base, document.tip)

    @property
    def cameras(self) -> CameraFiles | None:
        """Cameras and boards that measure the robot; None if there are none."""
        settings: CalibrationSettings = self.file.settings_of_step("calibrate")
        return settings.cameras

    @property
    def model(self) -> CalibratedModel | None:
        """The model in use; None if there is none."""
        entry = self.history.in_use
        return None if entry is None else load_model(self.model_folder(entry.name))

    def model_folder(self, name: str | None = None) -> Path:
        """Return the folder of a model.

        Args:
            name: name of the model; None for the model in use.

        Raises:
            ModelError: there is no model with this name, or no model is in use.
        """
        if name is None:
            return model_folder(self.folder)
        if not is_model(self.folder / MODELS / name):
            self.history.model(name)
        return self.folder / MODELS / name

    def plan(
        self, progress: Progress = lambda what: None, programs: Sequence[Path] = (), **overrides: Any
    ) -> tuple[Plan, Path]:
        """Plan the poses to measure; every plan of a cell has different poses.

        Without a model, the poses are for a calibration; with a model, they verify, monitor or improve the model.

        Args:
            progress: called with the name of each step.
            programs: files of robot programs that are also written.
            **overrides: options of `pisigma plan` that override `cell.yaml`, by its keys.

        Returns:
            The plan, and its CSV file in `plans/`.
        """
        facts = self.status().facts
        entry, settings = facts.in_use or facts.newest_model, self.file.plan_settings(facts, **overrides)
        subject = self.model_folder(entry.name) if entry is not None and entry.has_posterior else self.robot
        planned = plan(subject, settings, self.file.document.surroundings, progress)
        with self.history.database.transaction():  # reserved, so that no other process chooses the same name
            path = free_path(self.folder / PLANS, datetime.date.today().isoformat(), ".csv")
            planned.save(path, programs)
        made = f"plan '{path.stem}' of {planned.calibration_pose_count + planned.test_pose_count} poses"
        of = "" if entry is None else entry.name
        self.history.add(Check("plan", of, "", "planned", made, None, False, now()))
        return planned, path

    @cached_property
    def sessions(self) -> Sessions:
        """The sessions of the cell."""
        return Sessions(self.folder, self.robot, self.cameras, self.history)

    def add_session(
        self, file: str | os.PathLike[str] | Measurements, accept_implausible: bool = False, day: str = ""
    ) -> SessionEntry:
        """Add a session of measured rows to the cell; see `Sessions.add_session`."""
        return self.sessions.add_session(file, accept_implausible, day)

    def calibrate(
        self,
        progress: Progress = lambda what: None,
        accept_implausible: bool = False,
        prior: Path | None = None,
        **overrides: Any,
    ) -> tuple[Calibration | Recalibration, ModelEntry | None]:
        """Calibrate with all rows since the last event that changed the arm, and store the model.

        The first model is put into use by `verify`. A later model is put into use if it is better on held-out rows:
        the newest session, if it has ten rows or more, is held out, and the calibration without this session is
        compared with the model in use.

        Args:
            progress: called with the name of each step.
            accept_implausible: store the model even if it must not be trusted; such a model is not put into use.
            prior: model folder of `pisigma fleet prior` to start from; None for none.
            **overrides: options of `pisigma calibrate` that override `cell.yaml`, by its keys.

        Returns:
            The calibration and the entry of its model; the entry is None if an untrusted model was not stored.

        Raises:
            MeasurementError: there are no valid sessions.
        """
        sessions, started, events = self.sessions.valid_sessions(), now(), self.history.events()
        warnings, stated = self.controller_warnings("calibrate", None), self._settings_sha256
        settings: CalibrationSettings = self.file.settings_of_step("calibrate", **overrides)
        result = calibrate_rows(
            self.robot, self.sessions.rows_of(sessions, events), settings, prior, progress
        )
        result = with_warnings(result, (*warnings, *self.file.measured_joints_warnings()))
        doubt = "" if result.trusted else result.diagnostics[0].sentence
        if doubt and not accept_implausible:
            refused = ("calibrate", "", "", "not_trusted", doubt)
            self.history.add(Check(*refused, None, False, started, settings_sha256=stated))
            return result, None
        remark, better = doubt or "not verified yet", False
        if not doubt and prior is None and (in_use := self.history.in_use) is not None:
            better, remark = is_better(self.sessions, in_use, sessions, settings, progress)
        path = self._saved(result, accept_implausible)
        p95, rms = result.held_out_p95_and_best_known_rms_mm
        entry = model_entry(events, started, path, sessions, remark, result)
        verdict = "accepted_implausible" if doubt else "trusted"
        check = Check("calibrate", entry.name, "", verdict, doubt, p95, False, started, rms, stated)
        self.history.add(entry, check, *([InUse(entry.name, now(), remark)] if better else []))
        return result, entry

    def verify(
        self, session: str | None = None, model: str | None = None, **overrides: Any
    ) -> tuple[Verification, ModelEntry]:
        """Verify a model with a session to which it was not fitted; put it into use if it passes and is newer.

        Args:
            session: name of the session; None for the newest session to which the model was not fitted.
            model: name of the model; None for the model in use or, if there is none, the newest.
            **overrides: options of `pisigma verify` that override `cell.yaml`, by its keys.

        Returns:
            The verification and the entry of the model.

        Raises:
            ModelError: there is no model.
            MeasurementError: there is no session with this name, or none to which the model was not fitted.
        """
        entry, chosen, seen = self._new_rows("verify", model, session)
        settings = seen.settings_to_fit(self.file.settings_of_step("verify", **overrides))
        found = verify(self.model_folder(entry.name), seen.rows, settings)
        errors, moved = found.comparison.models[-1].position.statistics, found.verdict == "moved"
        found_by = ("verify", entry.name, chosen.name, found.verdict, found.sentence)
        self.history.add(Check(*found_by, errors["p95"], moved, now(), errors["rms"]))
        in_use = self.history.in_use
        if found.accepted and (in_use is None or in_use.made < entry.made):
            self.history.add(InUse(entry.name, now(), f"verified with session '{chosen.name}'"))
        return found, entry

    def monitor(self, progress: Progress = lambda what: None, **overrides: Any) -> MonitoringResult:
        """Compare every session newer than the model in use with this model, to detect moved parts.

        Args:
            progress: called with the name of each step.
            **overrides: options of `pisigma monitor` that override `cell.yaml`, by its keys.

        Returns:
            The result for the newest session; the history contains a check for every session.

        Raises:
            ModelError: no model is in use.
            MeasurementError: no session is newer than the model.
        """
        entry = self._candidate(None)
        warnings, sessions = self.controller_warnings("monitor", entry), self.sessions.sessions_new_to(entry)
        found: MonitoringResult | None = None
        for one in sessions:
            seen = self.sessions.rows_with_model_names(entry, self.sessions.rows_of_file(one), one.day)
            moved = {"moved": ",".join(seen.changed_frames)} if seen.changed_frames else {}
            settings = replace(
                self.file.settings_of_step("monitor", **(moved | overrides)), cameras=None, dates=(one.day,)
            )
            rows = replace(seen.rows, date=None)
            found = monitor(self.model_folder(entry.name), [rows], settings, progress)
            stated = self.file.settings_of_step("recalibrate")
            self.history.add(monitoring_check_entry(found, entry, one, seen, stated))
        assert found is not None  # there is a session
        return replace(found, warnings=(*warnings, *found.warnings))

    def evaluate(self, **overrides: Any) -> Evaluation:
        """Compare the model in use with the nominal robot on the newest session to which it was not fitted.

        Args:
            **overrides: options of `pisigma evaluate` that override `cell.yaml`, by its keys.

        Raises:
            ModelError: there is no model.
            MeasurementError: there is no session to which the model was not fitted.
        """
        entry, _, seen = self._new_rows("evaluate", None, None)
        settings = seen.settings_to_fit(self.file.settings_of_step("evaluate", **overrides))
        return evaluate(self.model_folder(entry.name), seen.rows, settings)

    def recalibrate(
        self,
        session: str | None = None,
        progress: Progress = lambda what: None,
        accept_implausible: bool = False,
        **overrides: Any,
    ) -> tuple[Recalibration, ModelEntry | None]:
        """Recalibrate the model in use with the newest session; put the result into use if it can be trusted.

        An unrecorded move of the instrument or the tool that is found becomes an event on the day of the session.

        Args:
            session: name of the session; None for the newest session to which the model was not fitted.
            progress: called with the name of each step.
            accept_implausible: store the model even if it must not be trusted; such a model is not put into use.
            **overrides: options of `pisigma recalibrate` that override `cell.yaml`, by its keys.

        Returns:
            The recalibration and the entry of its model; the entry is None if an untrusted model was not stored.

        Raises:
            ModelError: there is no model.
            MeasurementError: there is no session with this name, or none to which the model was not fitted.
        """
        started = now()
        parent, chosen, seen = self._new_rows("recalibrate", None, session)
        settings = seen.settings_to_recalibrate(self.file.settings_of_step("recalibrate", **overrides))
        result = recalibrate(self.model_folder(parent.name), seen.rows, settings, progress)
        found = (*self.controller_warnings("recalibrate", parent), *self.file.measured_joints_warnings())
        result = with_warnings(result, found)
        if not (result.trusted or accept_implausible):
            doubt = result.diagnostics[0].sentence
            refused = ("recalibrate", parent.name, chosen.name, "not_trusted", doubt)
            self.history.add(Check(*refused, None, False, now()))
            return result, None
        path = self._saved(result, accept_implausible)
        remark, (p95, rms) = result.summary.verdict, result.held_out_p95_and_best_known_rms_mm
        entry = model_entry((), started, path, [chosen], remark, result, parent)
        of = ("recalibrate", entry.name, chosen.name, result.summary.kept_candidate, remark)
        added: list[Entry] = [entry, Check(*of, p95, False, now(), rms)]
        if result.trusted:
            events = unrecorded_changes(result, chosen, seen.changed_frames, self.sessions.valid_sessions())
            added += [InUse(entry.name, now(), remark), *events]
        self.history.add(*added)
        return result, entry

    def use(self, model: str | None, reason: str) -> tuple[str, ...]:
        """Put a model into use by hand, or undo the last change of the model in use; no model is deleted.

        Args:
            model: name of the model; None for the one before the last change (repeated calls go further back).
            reason: reason to record in the history.

        Returns:
            Warnings.

        Raises:
            ModelError: the cell has no model with this name, its folder was changed, or there is nothing to undo.
        """
        name = self.history.model_after_undo if model is None else self.history.model(model).name
        if name is None:
            raise ModelError("no model was in use before", at=Place(self.folder), option="--undo")
        warnings = self.controller_warnings("use", self.history.model(name)) if name else ()
        put_into_use(self.history, name, reason or ("undo" if model is None else "by hand"), model is None)
        return warnings

    def status(self) -> CellStatus:
        """Return the status of the cell and its next step."""
        return status_of(self.folder)

    def controller_warnings(self, command: str, model: ModelEntry | None) -> tuple[str, ...]:
        """Return warnings about active exports on the controller; raise a ModelError if a rule refuses the command."""
        return findings(self.history, command, model).checked_warnings(self.folder)

    def _saved(self, result: Calibration | Recalibration, accept_implausible: bool) -> Path:
        """Save a model under a name that no model of the cell has had; return its folder."""
        names = [one.name for one in self.history.models()]
        return save_under_new_name(
            self.folder / MODELS, partial(result.save, accept_implausible=accept_implausible), names
        )

    def _candidate(self, model: str | None) -> ModelEntry:
        """Return the named model or, without a name, the model in use or the newest model."""
        if model is not None:
            return self.history.model(model)
        if (entry := self.history.in_use) is not None:
            return entry
        if models := self.history.models():
            return models[-1]
        remedy = f"run `pisigma calibrate {self.folder}` first"
        raise ModelError("the cell has no model", at=Place(self.folder), remedy=remedy)

    def _new_rows(
        self, command: str, model: str | None, session: str | None
    ) -> tuple[ModelEntry, SessionEntry, RowsWithModelNames]:
        """Return a model, a session (by default the newest to which it was not fitted), and rows of the session."""
        entry = self._candidate(model)
        self.controller_warnings(command, entry)
        chosen = self.sessions.choose_session(entry, session)
        return (
            entry,
            chosen,
            self.sessions.rows_with_model_names(entry, self.sessions.rows_of_file(chosen), chosen.day),
        )
