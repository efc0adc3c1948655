"""One robot on its mount: every step of its calibration, with rows and settings from its folder.

`Cell.open` reads a folder that `Cell.create` made. Each step calls the function of the same name in
`pisigma.workflow`, records what it found in the history, and decides which model is in use.
"""

import datetime
import hashlib
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from pisigma.files.errors import (
    AcceptanceError,
    MeasurementError,
    ModelError,
    OutputError,
    Place,
    check_choice,
)
from pisigma.files.model_files import is_model, model_hash
from pisigma.files.output_file import write_whole
from pisigma.files.progress import Progress
from pisigma.lifetime.cell.history import (
    HISTORY,
    Check,
    Event,
    History,
    ModelEntry,
    SessionEntry,
    Use,
    event_kinds,
    now,
)
from pisigma.lifetime.cell.status import CellFacts, Step, next_step, valid_sessions
from pisigma.measurement.camera.camera_files import CameraFiles
from pisigma.measurement.camera.corner_file import read_rows
from pisigma.measurement.copies import RowValues, copies_of_known
from pisigma.measurement.dataset import Measurements, join
from pisigma.measurement.dates import WANTED, date_in_name, is_date
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.folder.model_folder import load_model
from pisigma.planning.plan_file import yaml_of
from pisigma.robot.description import Robot
from pisigma.robot.robot_file import robot_file
from pisigma.validation.gate import check_rows
from pisigma.validation.held_out.validation_figures import ValidationFigures
from pisigma.workflow.calibrate import Calibration, calibrate
from pisigma.workflow.cell.cell_file import CELL_FILE, CellFile, template
from pisigma.workflow.evaluate import evaluate
from pisigma.workflow.monitor import Monitoring, monitor
from pisigma.workflow.plan import Plan, plan
from pisigma.workflow.recalibrate import Recalibration, may_move, recalibrate
from pisigma.workflow.settings.calibration import CalibrationSettings
from pisigma.workflow.settings.evaluation import EvaluationSettings
from pisigma.workflow.settings.recalibration import RecalibrationSettings
from pisigma.workflow.verify import Verification, verify

PLANS, SESSIONS, MODELS = "plans", "sessions", "models"
MIN_ROWS_TO_COMPARE = 10
"""Rows of the newest session, without which both methods are refitted and compared on it."""


@dataclass(frozen=True, eq=False)
class ModelRows:
    """Rows as a model sees them.

    Attributes:
        rows: with the names of the newest frame and tool that the model has.
        moved: "base" and "tool", where an event since says that they were changed.
    """

    rows: Measurements
    moved: tuple[str, ...]


@dataclass(frozen=True)
class CellStatus:
    """Where a cell stands.

    Attributes:
        facts: all that is known.
        step: what to do next.
        not_taken_in: files in `sessions/` that are not in the history yet.
    """

    facts: CellFacts
    step: Step
    not_taken_in: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """The status as plain values; `next.command` and `next.reason` are the next step."""
        facts, model = self.facts, self.facts.in_use
        return {
            "cell": facts.folder,
            "model": None if model is None else model.name,
            "made_of": [] if model is None else model.sessions.split(","),
            "p95_mm": None if model is None else model.p95_mm,
            "limit_mm": facts.limit_mm,
            "plans": list(facts.plans),
            "sessions": [
                {"name": one.name, "day": one.day, "rows": one.rows, "set_aside": one.set_aside or None}
                for one in facts.sessions
            ],
            "events": [{"day": one.day, "kind": one.kind, "note": one.note} for one in facts.events],
            "models": [{"name": one.name, "remark": one.remark} for one in facts.models],
            "not_taken_in": list(self.not_taken_in),
            "next": self.step.to_json(),
        }


class Cell:
    """A cell: its folder, its file and its history.

    Attributes:
        folder: of the cell.
        file: its `cell.yaml`.
        history: its sessions, events, models and checks.
    """

    def __init__(self, folder: Path, file: CellFile) -> None:
        self.folder, self.file = folder, file
        self.history = History(folder / HISTORY)

    @staticmethod
    def open(folder: str | os.PathLike[str]) -> "Cell":
        """Open a cell.

        Args:
            folder: with a `cell.yaml`.

        Raises:
            PlanningError: the folder has no `cell.yaml`, or one that cannot be used.
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
            folder: to write; it must not exist, or be empty.
            robot: catalogue name, or a robot file (YAML or URDF), which is copied into the cell.
            sensor: "tracker", "camera", "sockets", "draw-wire" or "touch".
            limit_mm: length below which 95 % of the position errors have to stay [mm].
            base: of a URDF file: link that poses are given in.
            tip: of a URDF file: link that is the tool.
            cameras: cameras and boards, whose files are copied into the cell.

        Raises:
            OutputError: the folder exists and is not empty, or cannot be written.
            RobotError: there is no such robot.
            PlanningError: a value cannot be used.
        """
        target, name = Path(folder), os.fspath(robot)
        Robot.load(name, base, tip)
        if target.exists() and (not target.is_dir() or any(target.iterdir())):
            raise OutputError(
                "the folder exists and is not empty", at=Place(folder), remedy="choose another --out"
            )
        known: dict[str, Any] = {
            "robot": name,
            "base": base,
            "tip": tip,
            "sensor": sensor,
            "limit_mm": limit_mm,
        }
        try:
            for part in (PLANS, SESSIONS, MODELS):
                (target / part).mkdir(parents=True, exist_ok=True)
            if (drawn := robot_file(name)) is not None:
                known["robot"] = f"robot{drawn.suffix.lower()}"
                shutil.copyfile(drawn, target / known["robot"])
            if cameras is not None:
                known["camera"] = _copied(cameras, target)
            write_whole(target / CELL_FILE, template(known))
        except OSError as problem:
            raise OutputError(f"the cell cannot be written: {problem.strerror}", at=Place(folder)) from None
        return Cell.open(target)

    @property
    def robot(self) -> Robot:
        """The robot as drawn."""
        document = self.file.document
        return Robot.load(self.file.robot, document.base, document.tip)

    @property
    def cameras(self) -> CameraFiles | None:
        """What the pixels of corners mean; None where no camera measures."""
        settings: CalibrationSettings = self.file.settings("calibrate")
        return settings.cameras

    @property
    def model(self) -> CalibratedModel | None:
        """The model in use; None where there is none."""
        entry = self.history.in_use
        return None if entry is None else load_model(self.model_folder(entry.name))

    def model_folder(self, name: str | None = None) -> Path:
        """The folder of a model.

        Args:
            name: of the model. None: of the one in use.

        Raises:
            ModelError: there is no such model, or none in use.
        """
        if name is None:
            entry = self.history.in_use
            if entry is None:
                raise ModelError(
                    "no model is in use", at=Place(self.folder), remedy=self.status().step.reason
                )
            name = entry.name
        elif not is_model(self.folder / MODELS / name):
            self.history.model(name)
        return self.folder / MODELS / name

    def plan(self, progress: Progress = lambda what: None, **changed: Any) -> tuple[Plan, Path]:
        """Plan which poses to measure, for the model in use or for the robot as drawn.

        Args:
            progress: called with what is being done.
            **changed: options of `pisigma plan` other than in `cell.yaml`, by its keys.

        Returns:
            The plan, and the CSV file in `plans/` that it was written to.
        """
        entry = self.history.in_use
        subject = self.robot if entry is None else self.model_folder(entry.name)
        planned = plan(
            subject, self.file.settings("plan", **changed), self.file.document.surroundings, progress
        )
        path = self._free(PLANS, datetime.date.today().isoformat(), ".csv")
        planned.save(path)
        return planned, path

    def take_in(
        self, file: str | os.PathLike[str] | Measurements, accept_implausible: bool = False, day: str = ""
    ) -> SessionEntry:
        """Check the rows of a session and store them; they are never changed afterwards.

        Args:
            file: measurements (CSV), or rows in memory.
            accept_implausible: take them in although the check says that they must not be trusted.
            day: on which they were measured (ISO 8601). "": the column `date`, the name of the file, or today.

        Raises:
            MeasurementError: the rows cannot be read, or are all known.
            AcceptanceError: the rows must not be trusted.
        """
        rows = read_rows(file, self.robot, self.cameras)
        day = day or _day_of(rows)
        if not is_date(day):
            raise MeasurementError(expected=WANTED, value=day, option="--date")
        entry = self._judged(rows, day, accept_implausible)
        path = self._free(SESSIONS, day, ".csv")
        if isinstance(file, Measurements):
            file.write_csv(path, self.robot)
        elif Path(file).parent.resolve() == (self.folder / SESSIONS).resolve():
            path = Path(file)
        else:
            write_whole(path, Path(file).read_bytes())
        entry = replace(entry, name=path.stem, sha256=_sha256(path))
        self.history.add(entry)
        return entry

    def _judged(self, rows: Measurements, day: str, accept_implausible: bool) -> SessionEntry:
        """The entry of rows that the gate lets through."""
        known = [one for one in self.history.sessions() if not one.set_aside]
        again = torch.zeros(rows.rows, dtype=torch.bool)
        for one in known:
            values = RowValues.of(self.rows_of([one]).as_fields(), self.robot)
            again |= copies_of_known(rows.as_fields(), self.robot, values)
        if bool(again.all()):
            raise MeasurementError(
                "every row was taken in before", at=Place(rows.source), remedy="give new rows"
            )
        model = self.history.in_use
        if model is None:
            verdict = check_rows(rows, self.robot)
        else:
            seen = self.rows_for(model, rows, day)
            stated = RecalibrationSettings(seen.moved or None)
            loaded = load_model(self.model_folder(model.name))
            verdict = check_rows(seen.rows, loaded, stated.fitted, may_move(stated))
        if verdict.implausible and not accept_implausible:
            raise AcceptanceError(
                f"the rows must not be trusted: {verdict.implausible[0].sentence.rstrip('.')}",
                at=Place(rows.source),
                remedy="correct the file, or take it in with --accept-implausible",
            )
        temperature = None if rows.temperature is None else float(rows.temperature.nanmean())
        return SessionEntry(
            name="",
            sha256="",
            taken_in=now(),
            day=day,
            rows=rows.rows,
            sensor=",".join(sorted(rows.kinds)),
            temperature_c=temperature,
            judged_by="robot" if model is None else model.name,
            remark=" ".join(one.sentence for one in verdict.diagnostics),
        )

    def set_aside(self, session: str, reason: str) -> None:
        """Leave a session out of everything from now on; its file stays.

        Raises:
            MeasurementError: there is no such session, or no reason.
        """
        sessions = {one.name: one for one in self.history.sessions()}
        check_choice(MeasurementError, "session", session, tuple(sessions), Place(self.folder))
        if not reason.strip():
            raise MeasurementError(expected="a reason", value=reason, option="--set-aside")
        self.history.add(replace(sessions[session], set_aside=reason.strip()))

    def record(self, kind: str, day: str = "", note: str = "") -> Event:
        """Record that something was changed; see `pisigma.lifetime.cell.history.EventKind`.

        Args:
            kind: of the event.
            day: on which it happened (ISO 8601). "": today.
            note: free text.

        Raises:
            MeasurementError: the kind is unknown, or the day is not one.
        """
        check_choice(MeasurementError, "event", kind, event_kinds())
        day = day or datetime.date.today().isoformat()
        if not is_date(day):
            raise MeasurementError(expected=WANTED, value=day, option="--date")
        event = Event(day, kind, note, now())  # type: ignore[arg-type]  # checked above
        self.history.add(event)
        return event

    def rows_of(self, sessions: Sequence[SessionEntry]) -> Measurements:
        """The rows of sessions, those after an instrument or tool event in frames or of targets of their own.

        Raises:
            MeasurementError: a file was changed or removed since it was taken in.
        """
        events, parts = self.history.events(), []
        for one in sessions:
            path = self.folder / SESSIONS / f"{one.name}.csv"
            if _sha256(path) != one.sha256:
                raise MeasurementError(
                    f"session '{one.name}' was changed or removed after it was taken in",
                    at=Place(path),
                    remedy=f"put the measured file back, or set the session aside (pisigma session {self.folder} "
                    f"{one.name} --set-aside REASON)",
                )
            rows = read_rows(path, self.robot, self.cameras)
            parts.append(
                _named(rows, _newest_day(events, "instrument", one.day), _newest_day(events, "tool", one.day))
            )
        if any(
            one.split is not None for one in parts
        ):  # a session without check poses is all for calibration
            parts = [
                one if one.split is not None else replace(one, split=("train",) * one.rows) for one in parts
            ]
        return parts[0] if len(parts) == 1 else read_rows(join(parts), self.robot)

    def rows_for(self, model: ModelEntry, rows: Measurements, day: str) -> ModelRows:
        """Rows of a day with the names that a model has for frame and tool, and what has moved since.

        Args:
            model: the model.
            rows: with the names of their file.
            day: on which they were measured (ISO 8601).
        """
        events = self.history.events()
        changed = {"base": "instrument", "tool": "tool"}
        moved = tuple(what for what, kind in changed.items() if model.day < _newest_day(events, kind, day))
        return ModelRows(_named(rows, model.frame_day, model.target_day), moved)

    def calibrate(
        self, progress: Progress = lambda what: None, **changed: Any
    ) -> tuple[Calibration, ModelEntry]:
        """Calibrate with all rows since the last event that changed the arm, and store the model.

        The first model goes into use after `verify`. A later one goes into use where rows that neither it nor the one
        in use was made of show that it is better: the newest session of ten rows or more is held out, and the
        calibration without it is compared with the model in use.

        Args:
            progress: called with what is being done.
            **changed: options of `pisigma calibrate` other than in `cell.yaml`, by its keys.

        Raises:
            MeasurementError: there are no valid sessions.
            AcceptanceError: the result must not be trusted; nothing is stored.
        """
        sessions = self._valid()
        settings: CalibrationSettings = self.file.settings("calibrate", **changed)
        robot = self.robot
        result = calibrate(robot, self.rows_of(sessions), replace(settings, cameras=None), progress)
        if not result.trusted:
            sentence = next(one.sentence for one in result.diagnostics if one.severity == "implausible")
            self.history.add(Check("calibrate", "", "", "not_trusted", sentence, None, True, now()))
        path = self._free(MODELS, datetime.date.today().isoformat(), "")
        result.save(path)
        remark, better = "not verified yet", False
        if self.history.in_use is not None:
            better, remark = self._is_better(robot, sessions, settings, progress)
        judged = result.summary.cross_validation
        entry = self._entry(path, sessions, remark, _p95(judged))
        summary = next(iter(result.warnings), "")
        self.history.add(
            entry, Check("calibrate", entry.name, "", "trusted", summary, entry.p95_mm, False, now())
        )
        if better:
            self._use(entry, remark)
        return result, entry

    def _is_better(
        self,
        robot: Robot,
        sessions: Sequence[SessionEntry],
        settings: CalibrationSettings,
        progress: Progress,
    ) -> tuple[bool, str]:
        """Whether a new calibration is better than the model in use on rows that neither was made of, and why."""
        in_use = self.history.in_use
        assert in_use is not None
        newest, older = sessions[-1], list(sessions[:-1])
        if newest.name in in_use.sessions.split(",") or newest.rows < MIN_ROWS_TO_COMPARE or not older:
            return (
                False,
                f"no session of {MIN_ROWS_TO_COMPARE} rows or more is new to it and to '{in_use.name}'",
            )
        progress("calibration without the newest session")
        without = calibrate(
            robot, self.rows_of(older), replace(settings, cameras=None, folds=0, hold_out=None)
        )
        seen = self.rows_for(in_use, self.rows_of([newest]), newest.day)
        fit_frame, fit_tool = "base" in seen.moved, "tool" in seen.moved
        old = load_model(self.model_folder(in_use.name))
        judged = evaluate(
            [replace(old, name="in use"), replace(without.model, name="new")],
            _named(read_rows(self.folder / SESSIONS / f"{newest.name}.csv", robot, self.cameras), "", ""),
            EvaluationSettings(fit_frame=fit_frame, fit_tool=fit_tool),
        )
        difference = judged.models[-1].position.difference
        interval = None if difference is None else difference.intervals["mean"]
        better = interval is not None and interval[1] < 0
        figures = " and ".join(
            f"{one.position.statistics['mean']:.3f} mm ({one.name})" for one in judged.models
        )
        return better, f"mean errors of session '{newest.name}', which neither was made of: {figures}"

    def verify(
        self, session: str | None = None, model: str | None = None, **changed: Any
    ) -> tuple[Verification, ModelEntry]:
        """Verify a model with a session that it was not made of; the first that is verified goes into use.

        Args:
            session: its name. None: the newest that the model was not made of.
            model: its name. None: the newest model where none is in use, else the one in use.
            **changed: options of `pisigma verify` other than in `cell.yaml`, by its keys.

        Raises:
            ModelError: there is no model.
            MeasurementError: there is no such session.
        """
        entry = self._candidate(model)
        chosen = self._unseen(entry, session)
        seen = self.rows_for(entry, self._plain_rows(chosen), chosen.day)
        settings = self.file.settings("verify", **changed)
        settings = replace(
            settings,
            cameras=None,
            fit_frame=settings.fit_frame or "base" in seen.moved,
            fit_tool=settings.fit_tool or "tool" in seen.moved,
        )
        found = verify(self.model_folder(entry.name), seen.rows, settings)
        p95 = found.comparison.models[-1].position.statistics["p95"]
        action = found.verdict in ("moved", "not_better", "implausible", "setup_fault")
        self.history.add(
            Check("verify", entry.name, chosen.name, found.verdict, found.sentence, p95, action, now())
        )
        in_use = self.history.in_use
        if found.accepted and (in_use is None or in_use.made < entry.made):
            self._use(entry, f"verified with session '{chosen.name}'")
        return found, entry

    def monitor(self, progress: Progress = lambda what: None, **changed: Any) -> Monitoring:
        """Say of every session that was measured since the model in use was made what has moved.

        Args:
            progress: called with what is being done.
            **changed: options of `pisigma monitor` other than in `cell.yaml`, by its keys.

        Raises:
            ModelError: no model is in use.
            MeasurementError: no session is newer than the model.
        """
        entry = self._candidate(None)
        sessions = self._unseen_sessions(entry)
        stated = {"limit_mm": None} | changed
        found: Monitoring | None = None
        for one in sessions:
            seen = self.rows_for(entry, self._plain_rows(one), one.day)
            moved = ",".join(seen.moved) if seen.moved else None
            words = {key: value for key, value in stated.items() if value is not None}
            settings = self.file.settings("monitor", **words, **({"moved": moved} if moved else {}))
            settings = replace(settings, cameras=None, dates=(one.day,))
            found = monitor(
                self.model_folder(entry.name), [replace(seen.rows, date=None)], settings, progress
            )
            self.history.add(_check_of(found, entry, one))
        assert found is not None  # there is a session
        return found

    def recalibrate(
        self, session: str | None = None, progress: Progress = lambda what: None, **changed: Any
    ) -> tuple[Recalibration, ModelEntry]:
        """Recalibrate the model in use with the newest session; what is trusted goes into use.

        Args:
            session: its name. None: the newest that the model was not made of.
            progress: called with what is being done.
            **changed: options of `pisigma recalibrate` other than in `cell.yaml`, by its keys.

        Raises:
            ModelError: no model is in use.
            MeasurementError: there is no such session.
            AcceptanceError: the result must not be trusted; nothing is stored.
        """
        parent = self._candidate(None)
        chosen = self._unseen(parent, session)
        seen = self.rows_for(parent, self._plain_rows(chosen), chosen.day)
        settings = replace(self.file.settings("recalibrate", **changed), cameras=None)
        if seen.moved and settings.moved is None:
            settings = replace(settings, moved=seen.moved)
        result = recalibrate(self.model_folder(parent.name), seen.rows, settings, progress)
        path = self._free(MODELS, datetime.date.today().isoformat(), "")
        result.save(path)
        remark = result.summary.verdict
        entry = replace(
            self._entry(path, [chosen], remark, None),
            sessions=",".join((*parent.sessions.split(","), chosen.name)),
            frame_day=parent.frame_day,
            target_day=parent.target_day,
            parent=parent.name,
        )
        check = Check("recalibrate", entry.name, chosen.name, result.summary.kept, remark, None, False, now())
        self.history.add(entry, check)
        self._use(entry, remark)
        return result, entry

    def use(self, model: str, reason: str) -> None:
        """Put a model into use by hand; the earlier ones stay in the history, so that this can be undone.

        Raises:
            ModelError: the cell has no such model, or its folder was changed.
        """
        entry = self.history.model(model)
        folder = self.folder / MODELS / model
        if model_hash(folder) != entry.sha256:
            raise ModelError(
                "the model was changed after it was made", at=Place(folder), remedy="use another one"
            )
        self._use(entry, reason or "by hand")

    def status(self) -> CellStatus:
        """Where the cell stands, and the next step."""
        sessions = self.history.sessions()
        names = {one.name for one in sessions}
        folder = self.folder / SESSIONS
        edited = tuple(
            one.name
            for one in sessions
            if not one.set_aside and _sha256(folder / f"{one.name}.csv") != one.sha256
        )
        facts = CellFacts(
            folder=os.fspath(self.folder),
            plans=tuple(sorted(path.stem for path in (self.folder / PLANS).glob("*.csv"))),
            sessions=sessions,
            edited=edited,
            events=self.history.events(),
            models=self.history.models(),
            checks=self.history.checks(),
            in_use=self.history.in_use,
            limit_mm=self.file.document.limit_mm,
            today=datetime.date.today().isoformat(),
        )
        new = tuple(sorted(path.name for path in folder.glob("*.csv") if path.stem not in names))
        return CellStatus(facts, next_step(facts), new)

    def _valid(self) -> list[SessionEntry]:
        """Sessions that describe the arm of today; files that lie in the folder are taken in first."""
        for name in self.status().not_taken_in:
            self.take_in(self.folder / SESSIONS / name)
        sessions = list(valid_sessions(self.history.sessions(), self.history.events()))
        if not sessions:
            raise MeasurementError(
                "there is no session of the arm as it is",
                at=Place(self.folder),
                remedy=self.status().step.reason,
            )
        return sessions

    def _candidate(self, model: str | None) -> ModelEntry:
        """The model that a step is about."""
        if model is not None:
            return self.history.model(model)
        models = self.history.models()
        if (entry := self.history.in_use) is not None:
            return entry
        if not models:
            raise ModelError(
                "there is no model", at=Place(self.folder), remedy="run `pisigma calibrate` of it first"
            )
        return models[-1]

    def _unseen_sessions(self, model: ModelEntry) -> list[SessionEntry]:
        made_of = model.sessions.split(",")
        found = [one for one in self._valid() if one.name not in made_of and one.day >= model.day]
        if not found:
            raise MeasurementError(
                f"every valid session was used to make model '{model.name}'",
                at=Place(self.folder),
                remedy="measure new rows and take them in",
            )
        return found

    def _unseen(self, model: ModelEntry, session: str | None) -> SessionEntry:
        """The session that a model is judged with."""
        if session is None:
            return self._unseen_sessions(model)[-1]
        sessions = {one.name: one for one in self._valid()}
        check_choice(MeasurementError, "session", session, tuple(sessions), Place(self.folder))
        return sessions[session]

    def _plain_rows(self, session: SessionEntry) -> Measurements:
        """The rows of a session with the names of their file; its hash is checked."""
        self.rows_of([session])
        return read_rows(self.folder / SESSIONS / f"{session.name}.csv", self.robot, self.cameras)

    def _entry(
        self, path: Path, sessions: Sequence[SessionEntry], remark: str, p95_mm: float | None
    ) -> ModelEntry:
        events, day = self.history.events(), max(one.day for one in sessions)
        return ModelEntry(
            name=path.name,
            sha256=model_hash(path),
            made=now(),
            sessions=",".join(one.name for one in sessions),
            day=day,
            frame_day=_newest_day(events, "instrument", day),
            target_day=_newest_day(events, "tool", day),
            p95_mm=p95_mm,
            remark=remark,
        )

    def _use(self, entry: ModelEntry, reason: str) -> None:
        self.history.add(Use(entry.name, now(), reason))

    def _free(self, part: str, name: str, suffix: str) -> Path:
        """A path in a folder of the cell that is not taken: NAME, NAME-2, NAME-3 and so on."""
        taken = {one.name for one in self.history.sessions()} if part == SESSIONS else set()
        for number in range(1, 10_000):
            stem = name if number == 1 else f"{name}-{number}"
            path = self.folder / part / f"{stem}{suffix}"
            if not path.exists() and not yaml_of(path).exists() and stem not in taken:
                return path
        raise OutputError("too many files of one day", at=Place(self.folder / part))


def _named(rows: Measurements, frame_day: str, target_day: str) -> Measurements:
    """Rows in frames and of targets that were set up on a day; the first ones have the names of the file."""
    frame = tuple(_since(name, frame_day) for name in rows.frame)
    target = tuple(_since(name, target_day) for name in rows.target)
    return replace(rows, frame=frame, target=target)


def _since(name: str, day: str) -> str:
    return f"{name} since {day}".lstrip() if day else name


def _newest_day(events: Sequence[Event], kind: str, day: str) -> str:
    """Day of the newest event of a kind up to a day; "" where there is none."""
    return max((one.day for one in events if one.kind == kind and one.day <= day), default="")


def _day_of(rows: Measurements) -> str:
    """First day of rows: of the column `date`, the name of their file, or today."""
    if rows.date is not None and all(rows.date):
        return min(rows.date)
    return date_in_name(Path(rows.source).name) or datetime.date.today().isoformat()


def _p95(judged: ValidationFigures | None) -> float | None:
    """95 % quantile of the position errors of held-out rows under the best calibration [mm]."""
    return None if judged is None else list(judged.models.values())[-1].p95_mm


def _check_of(found: Monitoring, entry: ModelEntry, session: SessionEntry) -> Check:
    """What monitoring found of a session."""
    if found.untrusted:
        summary = found.untrusted[0].sentence
        return Check("monitor", entry.name, session.name, "implausible", summary, None, True, now())
    judged = found.sessions[-1].session
    return Check(
        "monitor", entry.name, session.name, judged.verdict, judged.sentence, None, judged.recalibrate, now()
    )


def _copied(cameras: CameraFiles, folder: Path) -> dict[str, Any]:
    """The section of cameras, whose files are copied into the cell."""
    for path in cameras.files:
        shutil.copyfile(path, folder / Path(path).name)
    return {
        "camera": [Path(one).name for one in cameras.cameras],
        "board": [Path(one).name for one in cameras.boards],
        "fixed_camera": cameras.is_fixed,
        "intrinsics": cameras.intrinsics,
    }


def _sha256(path: Path) -> str:
    """Hash of a file; "" where it is missing."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""
