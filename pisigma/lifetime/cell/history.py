"""History in an SQLite file: sessions, events, models, checks, changes of the model in use, and more.

A cell has one history; a model outside a cell has a history next to its folder, with only monitored sessions.
DuckDB and pandas can read the tables directly: `TABLES` maps the classes below to tables, and columns are named
after attributes.
"""

import datetime
import sqlite3
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, fields
from pathlib import Path

from pisigma.files.errors import MeasurementError, ModelError, OutputError, Place, check_choice
from pisigma.files.model_files import DESCRIPTION
from pisigma.lifetime.cell.database import Database, Table
from pisigma.lifetime.cell.events import Event, check_event
from pisigma.lifetime.cell.exports import ControllerEntry, ExportEntry

HISTORY = "history.sqlite"
"""Name of the history of a cell."""
MODEL_HISTORY = ".history.sqlite"
"""Suffix, after the name of the folder, of the history of a model outside a cell."""
SCHEMA_VERSION = 6
"""Version of the schema. Version 1 had no monitored sessions, for which each model had a file without a version.
Version 2 had no exports, and changes of the model in use could not be undone. Version 3 had no scatter of models,
version 4 no poses of sessions, and version 5 no settings of checks."""


@dataclass(frozen=True)
class SessionEntry:
    """A session of measured rows.

    Attributes:
        name: name of the session and, with ".csv", of its file in `sessions/`.
        sha256: SHA-256 of the file.
        taken_in: time at which the session was added to the cell (ISO 8601, UTC).
        day: first day on which rows were measured (ISO 8601).
        rows: number of rows.
        sensor: kinds of readings, separated by commas.
        temperature_c: mean temperature [deg C]; None if the rows do not state it.
        judged_by: reference of the checks of the rows: "robot" (the nominal robot), or the name of a model.
        remark: warnings of the check.
        set_aside: reason why the session is not used; empty if it is used.
        poses: number of different joint values in the rows; 0 if unknown.
    """

    name: str
    sha256: str
    taken_in: str
    day: str
    rows: int
    sensor: str
    temperature_c: float | None = None
    judged_by: str = "robot"
    remark: str = ""
    set_aside: str = ""
    poses: int = 0


@dataclass(frozen=True)
class ModelEntry:
    """A model of the cell.

    Attributes:
        name: name of its folder in `models/`.
        sha256: SHA-256 of its `model.yaml`.
        made: time at which its rows and events were read (ISO 8601, UTC).
        sessions: names of the sessions to which the model was fitted, separated by commas.
        day: day of the newest of these sessions (ISO 8601).
        frame_day: day of the instrument event with which the newest frame of the model begins; empty if the model has
            only the first frame.
        target_day: day of the tool event with which the newest target of the model begins; empty if it has only the
            first target.
        parent: name of the model that was recalibrated; empty for a calibration.
        p95_mm: 95 % quantile of the position errors of held-out rows [mm]; None if no rows were held out.
        remark: reason why the model is or is not in use.
        scatter_mm: standard deviation of a measured coordinate about the model [mm], from the sensor and the
            repeatability of the robot, as the calibration identified it; None if it is unknown.
        has_posterior: whether the model stores the posterior of its parameters, which `monitor` and `recalibrate`
            require.
    """

    name: str
    sha256: str
    made: str
    sessions: str
    day: str
    frame_day: str = ""
    target_day: str = ""
    parent: str = ""
    p95_mm: float | None = None
    remark: str = ""
    scatter_mm: float | None = None
    has_posterior: bool = True

    @property
    def made_of(self) -> tuple[str, ...]:
        """Names of the sessions to which the model was fitted; empty if it was made outside the cell."""
        return tuple(filter(None, self.sessions.split(",")))


@dataclass(frozen=True)
class Check:
    """Verdict of a command on a model and a session.

    Attributes:
        command: "plan", "import", "calibrate", "verify", "monitor" or "recalibrate".
        model: name of the model; empty if none was written.
        session: name of the session; empty if all valid sessions were used.
        verdict: verdict in one word; the result class of the command lists the possible verdicts.
        summary: verdict in one sentence.
        p95_mm: 95 % quantile of the position errors [mm]; None if it is unknown.
        recalibrate: whether recalibrating with the session is due.
        checked: time of the check (ISO 8601, UTC).
        rms_mm: RMS position error [mm] of held-out rows or, without a validation, of the rows of a calibration; for
            `verify` and `monitor`, of the session. None if it is unknown.
        settings_sha256: SHA-256 of the settings in `cell.yaml` that a calibration depends on, and of the files that it
            names; empty if it is unknown, and for all other commands.
    """

    command: str
    model: str
    session: str
    verdict: str
    summary: str
    p95_mm: float | None
    recalibrate: bool
    checked: str
    rms_mm: float | None = None
    settings_sha256: str = ""


@dataclass(frozen=True)
class InUse:
    """A change of the model in use.

    Attributes:
        model: name of the model; empty if no model was in use.
        since: time from which the model was in use (ISO 8601, UTC).
        reason: reason why the model was put into use.
        undo: whether this change undid the last change that had not been undone.
    """

    model: str
    since: str
    reason: str
    undo: bool = False


@dataclass(frozen=True)
class MonitoredSession:
    """Result of comparing one session with a model.

    Attributes:
        model_sha256: SHA-256 of the `model.yaml` of the model.
        rows_sha256: SHA-256 of the rows, without their dates.
        file: name of the file of the rows.
        day: day of the measurement (ISO 8601).
        rows: number of rows.
        temperature_c: mean temperature [deg C]; None if the rows do not state it.
        verdict: "unchanged", "moved" or "unclear".
        unchanged: probability that no part moved.
        rms_mm: RMS position error under the model [mm].
        rms_after_mm: RMS position error expected after a recalibration [mm].
        session: the whole result as JSON; lengths in m, angles in rad.
        arrays: NumPy archive (.npz) of the zeros of the joints with their covariance, and of the rows.
    """

    model_sha256: str
    rows_sha256: str
    file: str
    day: str
    rows: int
    temperature_c: float | None
    verdict: str
    unchanged: float
    rms_mm: float
    rms_after_mm: float
    session: str
    arrays: bytes


TABLES: dict[type, Table] = {
    SessionEntry: Table("cell_sessions", ("name",)),
    Event: Table("events"),
    ModelEntry: Table("models", ("name",)),
    Check: Table("checks"),
    InUse: Table("uses"),
    ExportEntry: Table("exports"),
    ControllerEntry: Table("controller"),
    MonitoredSession: Table("monitored_sessions", ("model_sha256", "rows_sha256")),
}
Entry = SessionEntry | Event | ModelEntry | Check | InUse | ExportEntry | ControllerEntry | MonitoredSession
"""A row of a table of a history."""
_SESSIONS_OF_MODEL = """SELECT model, rows, file, date, json_extract(session, '$.rows'), temperature_c,
    CASE WHEN json_array_length(session, '$.moved') THEN 'moved'
         WHEN json_array_length(session, '$.candidates') THEN 'unclear' ELSE 'unchanged' END,
    json_extract(session, '$.unchanged'), 1e3 * json_extract(session, '$.rms'),
    1e3 * json_extract(session, '$.rms_after'), session, zeros FROM sessions"""
"""Monitored sessions in the file of a model before schema version 2."""
_OF_MODELS = "models/*.history.sqlite"
"""Pattern of these files in a cell."""


def now() -> str:
    """Return the current time as stored in a history (ISO 8601, UTC, to the millisecond)."""
    return datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="milliseconds")


def day_of(time: str) -> str:
    """Return the day (ISO 8601) of a stored time in the time zone of this machine, in which people state days."""
    return datetime.datetime.fromisoformat(time).astimezone().date().isoformat()


class History:
    """The history of a cell, or of a model outside a cell.

    Attributes:
        path: path of its SQLite file, which is created with the first entry.
        database: tables of the file. A file of an earlier schema version is upgraded when it is opened.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.database = Database(path, TABLES, SCHEMA_VERSION, self._take_over)

    def sessions(self) -> tuple[SessionEntry, ...]:
        """Return all sessions in the order of their days, including sessions that were set aside."""
        return tuple(
            sorted(self.database.read(SessionEntry), key=lambda one: (one.day, one.taken_in, one.name))
        )

    def events(self) -> tuple[Event, ...]:
        """Return all events in the order of their days."""
        return tuple(sorted(self.database.read(Event), key=lambda one: (one.day, one.recorded)))

    def models(self) -> tuple[ModelEntry, ...]:
        """Return all models in the order in which they were made."""
        return self.database.read(ModelEntry)

    def checks(self) -> tuple[Check, ...]:
        """Return all checks in the order in which they were made."""
        return self.database.read(Check)

    def monitored_sessions(self) -> tuple[MonitoredSession, ...]:
        """Return all monitored sessions of all models in the order in which they were added."""
        return self.database.read(MonitoredSession)

    def model_in_use_changes(self) -> tuple[InUse, ...]:
        """Return the changes of the model in use; the last one names the current model."""
        return self.database.read(InUse)

    def exports(self) -> tuple[ExportEntry, ...]:
        """Return all exports in the order in which they were written."""
        return self.database.read(ExportEntry)

    def controller(self) -> tuple[ControllerEntry, ...]:
        """Return the changes of the active exports on the controller, in the order of their days."""
        return tuple(sorted(self.database.read(ControllerEntry), key=lambda one: (one.day, one.recorded)))

    @property
    def model_after_undo(self) -> str | None:
        """Name of the model that an undo would put into use, "" for no model; None if there is nothing to undo."""
        states = [""]
        for one in self.model_in_use_changes():
            if one.undo:
                states.pop()
            elif one.model != states[-1]:
                states.append(one.model)
        return states[-2] if len(states) > 1 else None

    @property
    def in_use(self) -> ModelEntry | None:
        """The model in use; None if there is none."""
        uses = self.model_in_use_changes()
        return self.model(uses[-1].model) if uses and uses[-1].model else None

    def model(self, name: str) -> ModelEntry:
        """Return the entry of a model.

        Raises:
            ModelError: the cell has no model with this name.
        """
        models = {one.name: one for one in self.models()}
        check_choice(ModelError, "model", name, tuple(models), Place(self.path.parent))
        return models[name]

    def add(self, *entries: Entry) -> None:
        """Add entries in one transaction; entries with the same key (see `TABLES`) are replaced.

        Raises:
            OutputError: the history cannot be written.
        """
        self.database.add_or_replace(entries)

    def add_session(self, session: SessionEntry, *also: Entry) -> bool:
        """Add a session and other entries unless another session in use has its content; return whether it did so.

        Raises:
            OutputError: the history cannot be written.
        """
        with self.database.transaction() as database:
            known = database.execute(
                f"SELECT 1 FROM {TABLES[SessionEntry].name} WHERE sha256 = ? AND name <> ? AND set_aside = ''",
                (session.sha256, session.name),
            ).fetchone()
            if known is None:
                self.database.insert(database, [session, *also])
        return known is None

    def replace_model_hash(self, before: str, after: str) -> None:
        """Replace the SHA-256 of a model whose folder was upgraded.

        Raises:
            OutputError: the history cannot be written.
        """
        with self.database.transaction() as database:
            for kind, column in ((ModelEntry, "sha256"), (MonitoredSession, "model_sha256")):
                database.execute(
                    f"UPDATE OR REPLACE {TABLES[kind].name} SET {column} = ? WHERE {column} = ?",
                    (after, before),
                )

    def record(self, kind: str, day: str = "", note: str = "", person: str = "") -> Event:
        """Record a change, or the acceptance of the model in use; see `EventKind`.

        Args:
            kind: kind of the event.
            day: day of the event (ISO 8601); "" for today.
            note: free text.
            person: person who accepted the model or reported the change.

        Raises:
            MeasurementError: the kind is unknown, the day is not a valid date, or the person who accepted is not named.
            ModelError: no model is in use, so none can be accepted.
        """
        day, model = day or datetime.date.today().isoformat(), ""
        check_event(kind, day, person)
        if kind == "accepted":
            if (entry := self.in_use) is None:
                raise ModelError("no model of the cell is in use", at=Place(self.path.parent))
            if day < (made := day_of(entry.made)):
                expected = f"a day since {made}, when model '{entry.name}' was made"
                raise MeasurementError(expected=expected, value=day, option="--date")
            model = entry.name
        event = Event(day, kind, note, now(), person.strip(), model)  # type: ignore[arg-type]  # checked above
        self.add(event)
        return event

    def _take_over(self, database: sqlite3.Connection) -> Sequence[Path]:
        """Add the records that earlier versions stored elsewhere.

        Versions before 2 stored monitored sessions in a file next to each model of the cell; whether a model has a
        posterior is stated only in its description.
        """
        names = database.execute(f"SELECT name FROM {TABLES[ModelEntry].name}").fetchall()
        without = [one for one in names if _lacks_posterior(self.path.parent / "models" / one[0])]
        database.executemany(
            f"UPDATE {TABLES[ModelEntry].name} SET has_posterior = 0 WHERE name = ?", without
        )
        known = database.execute("SELECT name FROM sqlite_master WHERE name = 'sessions'").fetchall()
        rows = database.execute(_SESSIONS_OF_MODEL).fetchall() if known else []
        database.execute("DROP TABLE IF EXISTS sessions")
        moved = sorted(self.path.parent.glob(_OF_MODELS)) if self.path.name == HISTORY else []
        for file in moved:
            try:
                with closing(sqlite3.connect(file)) as other:
                    rows += other.execute(_SESSIONS_OF_MODEL).fetchall()
            except sqlite3.Error as problem:
                remedy = "move the file away"
                raise OutputError(
                    f"the history cannot be used: {problem}", at=Place(file), remedy=remedy
                ) from None
        marks = ", ".join("?" * len(fields(MonitoredSession)))
        table = TABLES[MonitoredSession].name
        database.executemany(f"INSERT OR REPLACE INTO {table} VALUES ({marks})", rows)
        return moved


def _lacks_posterior(model: Path) -> bool:
    """Return whether the description of a model states no posterior; False if it is missing."""
    try:
        return b"\nuncertainty:\n" not in (model / DESCRIPTION).read_bytes()
    except OSError:
        return False
