"""Sessions of a cell: checked when they are taken in, stored as they were measured, and read for a model."""

import datetime
import hashlib
import os
import tempfile
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from pisigma.files.errors import AcceptanceError, MeasurementError, OutputError, Place, check_choice
from pisigma.files.scratch import FILE, scratch_beside
from pisigma.lifetime.cell.history import Event, History, ModelEntry, SessionEntry, now
from pisigma.lifetime.cell.layout import MODELS, SESSIONS
from pisigma.lifetime.cell.status import valid_sessions
from pisigma.measurement.camera.camera_files import CameraFiles
from pisigma.measurement.camera.corner_file import read_rows
from pisigma.measurement.copies import RowValues, copies_of_known
from pisigma.measurement.dataset import Measurements, join
from pisigma.measurement.dates import EXPECTED_DATE, date_in_name, is_date
from pisigma.model.folder.model_folder import load_model
from pisigma.robot.description import Robot
from pisigma.validation.gate import check_rows
from pisigma.workflow.recalibrate import may_move
from pisigma.workflow.settings.recalibration import RecalibrationSettings

MAX_NAMES = 10_000
"""Of one day."""


@dataclass(frozen=True, eq=False)
class ModelRows:
    """Rows as a model sees them.

    Attributes:
        rows: with the names of the newest frame and tool that the model has.
        moved: "base" and "tool", where an event since says that they were changed.
    """

    rows: Measurements
    moved: tuple[str, ...]

    def fitted(self, settings: Any) -> Any:
        """Settings that fit frame and tool where an event says that they were changed; cameras were read already."""
        fit_frame, fit_tool = settings.fit_frame or self.fit_frame, settings.fit_tool or self.fit_tool
        return replace(settings, cameras=None, fit_frame=fit_frame, fit_tool=fit_tool)

    @property
    def fit_frame(self) -> bool:
        """Whether the instrument was set up again."""
        return "base" in self.moved

    @property
    def fit_tool(self) -> bool:
        """Whether the tool was changed."""
        return "tool" in self.moved


class Sessions:
    """The sessions of a cell.

    Attributes:
        folder: that they are in.
        robot: as drawn.
        cameras: what the pixels of corners mean; None where no camera measures.
        history: of the cell.
    """

    def __init__(self, cell: Path, robot: Robot, cameras: CameraFiles | None, history: History) -> None:
        self.folder, self.robot, self.cameras, self.history = cell / SESSIONS, robot, cameras, history

    def path(self, session: SessionEntry) -> Path:
        """The file of a session."""
        return self.folder / f"{session.name}.csv"

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
            raise MeasurementError(expected=EXPECTED_DATE, value=day, option="--date")
        entry = self._judged(rows, day, accept_implausible)
        if isinstance(file, Measurements):
            with tempfile.TemporaryDirectory() as scratch:
                file.write_csv(Path(scratch) / "rows.csv", self.robot)
                content = (Path(scratch) / "rows.csv").read_bytes()
        else:
            content = Path(file).read_bytes()
        if not isinstance(file, Measurements) and Path(file).parent.resolve() == self.folder.resolve():
            path = Path(file)
        else:
            path = write_new(self.folder, day, content, {one.name for one in self.history.sessions()})
        entry = replace(entry, name=path.stem, sha256=hashlib.sha256(content).hexdigest())
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
            loaded = load_model(self.folder.parent / MODELS / model.name)
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

    def valid(self) -> list[SessionEntry]:
        """Sessions that describe the arm of today, by their days; new files in the folder are taken in first.

        Raises:
            MeasurementError: there is none.
        """
        for name in not_taken_in(self.folder, self.history.sessions()):
            self.take_in(self.folder / name)
        sessions = list(valid_sessions(self.history.sessions(), self.history.events()))
        if not sessions:
            raise MeasurementError(
                "there is no session of the arm as it is now",
                at=Place(self.folder),
                remedy="measure rows and take them in",
            )
        return sessions

    def unseen(self, model: ModelEntry) -> list[SessionEntry]:
        """Valid sessions that a model was not made of, measured on its newest day or later.

        Raises:
            MeasurementError: there is none.
        """
        made_of = model.sessions.split(",")
        found = [one for one in self.valid() if one.name not in made_of and one.day >= model.day]
        if not found:
            raise MeasurementError(
                f"no valid session is new to model '{model.name}'",
                at=Place(self.folder),
                remedy="measure new rows and take them in",
            )
        return found

    def chosen(self, model: ModelEntry, name: str | None) -> SessionEntry:
        """A session by its name; None for the newest that a model was not made of.

        Raises:
            MeasurementError: there is no such session.
        """
        if name is None:
            return self.unseen(model)[-1]
        sessions = {one.name: one for one in self.valid()}
        check_choice(MeasurementError, "session", name, tuple(sessions), Place(self.folder))
        return sessions[name]

    def rows_of(self, sessions: Sequence[SessionEntry]) -> Measurements:
        """The rows of sessions, those after an instrument or tool event in frames or of targets of their own.

        Raises:
            MeasurementError: a file was changed or removed since it was taken in.
        """
        events, parts = self.history.events(), []
        for one in sessions:
            days = newest_day(events, "instrument", one.day), newest_day(events, "tool", one.day)
            parts.append(named(self.as_measured(one), *days))
        if any(one.split is not None for one in parts):
            # sessions without check poses are all for calibration
            parts = [one if one.split else replace(one, split=("train",) * one.rows) for one in parts]
        return parts[0] if len(parts) == 1 else read_rows(join(parts), self.robot)

    def as_measured(self, session: SessionEntry) -> Measurements:
        """The rows of a session with the names of their file.

        Raises:
            MeasurementError: the file was changed or removed since it was taken in.
        """
        path = self.path(session)
        if sha256_of(path) != session.sha256:
            raise MeasurementError(
                f"session '{session.name}' was changed or removed after it was taken in",
                at=Place(path),
                remedy=f"put the measured file back, or set the session aside (pisigma session {self.folder.parent} "
                f"{session.name} --set-aside REASON)",
            )
        return read_rows(path, self.robot, self.cameras)

    def rows_for(self, model: ModelEntry, rows: Measurements, day: str) -> ModelRows:
        """Rows of a day with the names that a model has for frame and tool, and what has moved since.

        Args:
            model: the model.
            rows: with the names of their file.
            day: on which they were measured (ISO 8601).
        """
        events = self.history.events()
        changed = {"base": "instrument", "tool": "tool"}
        moved = tuple(what for what, kind in changed.items() if model.day < newest_day(events, kind, day))
        return ModelRows(named(rows, model.frame_day, model.target_day), moved)


def named(rows: Measurements, frame_day: str, target_day: str) -> Measurements:
    """Rows in frames and of targets that were set up on a day; the first ones have the names of the file."""
    frame = tuple(since(name, frame_day) for name in rows.frame)
    target = tuple(since(name, target_day) for name in rows.target)
    return replace(rows, frame=frame, target=target)


def since(name: str, day: str) -> str:
    """Name of a frame or target that was set up on a day; "" for the first one."""
    return f"{name} since {day}".lstrip() if day else name


def newest_day(events: Sequence[Event], kind: str, day: str) -> str:
    """Day of the newest event of a kind up to a day; "" where there is none."""
    return max((one.day for one in events if one.kind == kind and one.day <= day), default="")


def _day_of(rows: Measurements) -> str:
    """First day of rows: of the column `date`, the name of their file, or today."""
    if rows.date is not None and all(rows.date):
        return min(rows.date)
    return date_in_name(Path(rows.source).name) or datetime.date.today().isoformat()


def sha256_of(path: Path) -> str:
    """Hash of a file; "" where it is missing."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""


def not_taken_in(folder: Path, sessions: Sequence[SessionEntry]) -> tuple[str, ...]:
    """Names of the files in the folder of sessions that the history does not know yet."""
    names = {one.name for one in sessions}
    return tuple(sorted(path.name for path in folder.glob("*.csv") if path.stem not in names))


def free_path(folder: Path, name: str, suffix: str, taken: Collection[str] = ()) -> Path:
    """A path in a folder that is not taken: NAME, NAME-2, NAME-3 and so on.

    Raises:
        OutputError: all are taken.
    """
    for number in range(1, MAX_NAMES):
        stem = name if number == 1 else f"{name}-{number}"
        path = folder / f"{stem}{suffix}"
        if not path.exists() and stem not in taken:
            return path
    raise OutputError(f"there are {MAX_NAMES:,} files of {name} already", at=Place(folder))


def write_new(folder: Path, name: str, content: bytes, taken: Collection[str]) -> Path:
    """Write a session under a name that no file has, whole or not at all, whatever other processes do meanwhile.

    Args:
        folder: to write to.
        name: of the file, without ".csv"; see `free_path`.
        content: of the file.
        taken: further names that are taken.

    Raises:
        OutputError: it cannot be written.
    """
    while True:
        path = free_path(folder, name, ".csv", taken)
        try:
            with scratch_beside(path, FILE) as scratch:
                with scratch.open("wb") as file:
                    file.write(content)
                    file.flush()
                    os.fsync(file.fileno())
                scratch.chmod(0o644)
                os.link(scratch, path)  # unlike a rename, it never replaces what another process wrote
            return path
        except FileExistsError:
            continue
        except OSError as problem:
            raise OutputError(f"the session cannot be written: {problem.strerror}", at=Place(path)) from None


def edited_sessions(folder: Path, sessions: Sequence[SessionEntry]) -> tuple[str, ...]:
    """Names of sessions that count and whose files were changed or removed since they were taken in."""
    used = [one for one in sessions if not one.set_aside]
    return tuple(one.name for one in used if sha256_of(folder / f"{one.name}.csv") != one.sha256)
