"""History of a cell in one SQLite file: sessions, events, models, checks, and which model was in use when.

DuckDB and pandas can read the tables directly; `_TABLES` maps the classes below to tables, and columns are named after
attributes. Every change is one transaction. SQLite's rollback journal and lock let several processes write safely.
"""

import datetime
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args

from pisigma.files.errors import MeasurementError, ModelError, OutputError, Place, check_choice
from pisigma.measurement.dates import EXPECTED_DATE, is_date

HISTORY = "history.sqlite"
SCHEMA_VERSION = 1
LOCK_TIMEOUT = 10.0
"""[s] Longest wait for another process that is writing."""

EventKind = Literal["instrument", "tool", "mastering", "encoder", "collision", "maintenance", "firmware"]
"""What was changed: the instrument (tracker, camera, board) was set up again, the tool or reflector was exchanged, or
the arm was changed (see `ARM_EVENTS`); "firmware" is only recorded."""
ARM_EVENTS: frozenset[EventKind] = frozenset(("mastering", "encoder", "collision", "maintenance"))
"""Events after which earlier sessions no longer describe the arm."""


@dataclass(frozen=True)
class SessionEntry:
    """A session of measured rows.

    Attributes:
        name: name of the session and, with ".csv", of its file in `sessions/`.
        sha256: SHA-256 of the file.
        taken_in: time at which it was added to the cell (ISO 8601, UTC).
        day: first day on which rows were measured (ISO 8601).
        rows: number of rows.
        sensor: kinds of readings, separated by commas.
        temperature_c: mean temperature [deg C]; None if the rows do not state it.
        judged_by: what the rows were checked against: "robot" (the nominal robot), or the name of a model.
        remark: warnings of the check.
        set_aside: why the session is not used; empty if it is used.
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


@dataclass(frozen=True)
class Event:
    """A change of the robot, its tool or its instrument.

    Attributes:
        day: day on which it happened (ISO 8601); sessions of that day were measured after it.
        kind: see `EventKind`.
        note: free text.
        recorded: time at which it was recorded (ISO 8601, UTC).
    """

    day: str
    kind: EventKind
    note: str
    recorded: str


@dataclass(frozen=True)
class ModelEntry:
    """A model of the cell.

    Attributes:
        name: name of its folder in `models/`.
        sha256: SHA-256 of its `model.yaml`.
        made: time at which it was calibrated or recalibrated (ISO 8601, UTC).
        sessions: names of the sessions that it was fitted to, separated by commas.
        day: day of the newest of them (ISO 8601).
        frame_day: day of the instrument event with which the newest frame of the model begins; empty if the model has
            only the first frame.
        target_day: day of the tool event with which the newest target of the model begins; empty if it has only the
            first target.
        parent: name of the model that was recalibrated; empty for a calibration.
        p95_mm: 95 % quantile of the position errors of held-out rows [mm]; None if no rows were held out.
        remark: why it is or is not in use.
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


@dataclass(frozen=True)
class Check:
    """Verdict of a command on a model and a session.

    Attributes:
        command: "calibrate", "verify", "monitor" or "recalibrate".
        model: name of the model; empty if none was written.
        session: name of the session; empty if all valid sessions were used.
        verdict: verdict in one word; the result class of the command lists them.
        summary: verdict in one sentence.
        p95_mm: 95 % quantile of the position errors [mm]; None if it is unknown.
        recalibrate: whether recalibrating with the session is due.
        checked: time of the check (ISO 8601, UTC).
    """

    command: str
    model: str
    session: str
    verdict: str
    summary: str
    p95_mm: float | None
    recalibrate: bool
    checked: str


@dataclass(frozen=True)
class Use:
    """A change of the model in use.

    Attributes:
        model: name of the model; empty if none was in use.
        since: time from which it was in use (ISO 8601, UTC).
        reason: why it was put into use.
    """

    model: str
    since: str
    reason: str


Entry = TypeVar("Entry", SessionEntry, Event, ModelEntry, Check, Use)
_TABLES: dict[type, str] = {
    SessionEntry: "cell_sessions",
    Event: "events",
    ModelEntry: "models",
    Check: "checks",
    Use: "uses",
}
_SQL_TYPES = {str: "TEXT NOT NULL", int: "INTEGER NOT NULL", bool: "INTEGER NOT NULL"}


def now() -> str:
    """Return the time as stored in a history (ISO 8601, UTC, to the second)."""
    return datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds")


class History:
    """The history of a cell.

    Attributes:
        path: path of its SQLite file, which is created with the first entry.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def sessions(self) -> tuple[SessionEntry, ...]:
        """Return all sessions in the order of their days, including those that were set aside."""
        return tuple(sorted(self._read(SessionEntry), key=lambda one: (one.day, one.taken_in, one.name)))

    def events(self) -> tuple[Event, ...]:
        """Return all events in the order of their days."""
        return tuple(sorted(self._read(Event), key=lambda one: (one.day, one.recorded)))

    def models(self) -> tuple[ModelEntry, ...]:
        """Return all models in the order in which they were made."""
        return self._read(ModelEntry)

    def checks(self) -> tuple[Check, ...]:
        """Return all checks in the order in which they were made."""
        return self._read(Check)

    def uses(self) -> tuple[Use, ...]:
        """Return the changes of the model in use; the last one names the model in use now."""
        return self._read(Use)

    @property
    def in_use(self) -> ModelEntry | None:
        """The model in use; None if there is none."""
        uses = self.uses()
        return self.model(uses[-1].model) if uses and uses[-1].model else None

    def model(self, name: str) -> ModelEntry:
        """Return the entry of a model.

        Raises:
            ModelError: the cell has no model with this name.
        """
        models = {one.name: one for one in self.models()}
        check_choice(ModelError, "model", name, tuple(models), Place(self.path.parent))
        return models[name]

    def add(self, *entries: SessionEntry | Event | ModelEntry | Check | Use) -> None:
        """Add entries in one transaction; a session or a model of the same name is replaced.

        Raises:
            OutputError: the history cannot be written.
        """
        with self._opened() as database, database:
            for entry in entries:
                values = asdict(entry)
                marks = ", ".join("?" * len(values))
                names = ", ".join(values)
                database.execute(
                    f"INSERT OR REPLACE INTO {_TABLES[type(entry)]} ({names}) VALUES ({marks})",
                    tuple(values.values()),
                )

    def record(self, kind: str, day: str = "", note: str = "") -> Event:
        """Record that something was changed; see `EventKind`.

        Args:
            kind: kind of the event.
            day: day on which it happened (ISO 8601). "": today.
            note: free text.

        Raises:
            MeasurementError: the kind is unknown, or the day is not a valid date.
        """
        check_choice(MeasurementError, "event", kind, event_kinds())
        day = day or datetime.date.today().isoformat()
        if not is_date(day):
            raise MeasurementError(expected=EXPECTED_DATE, value=day, option="--date")
        event = Event(day, kind, note, now())  # type: ignore[arg-type]  # checked above
        self.add(event)
        return event

    def _read(self, kind: type[Entry]) -> tuple[Entry, ...]:
        if not self.path.exists():
            return ()
        names = [one.name for one in fields(kind)]
        with self._opened() as database:
            rows = database.execute(
                f"SELECT {', '.join(names)} FROM {_TABLES[kind]} ORDER BY rowid"
            ).fetchall()
        return tuple(_entry(kind, dict(zip(names, row, strict=True))) for row in rows)

    @contextmanager
    def _opened(self) -> Iterator[sqlite3.Connection]:
        try:
            with closing(sqlite3.connect(self.path, timeout=LOCK_TIMEOUT)) as database:
                (version,) = database.execute("PRAGMA user_version").fetchone()
                if version > SCHEMA_VERSION:
                    raise OutputError(
                        expected=f"a history of schema version {SCHEMA_VERSION} or older",
                        value=version,
                        at=Place(self.path),
                        remedy="update pisigma",
                    )
                if version < SCHEMA_VERSION:
                    with database:
                        _create_tables(database)
                yield database
        except sqlite3.Error as problem:
            raise OutputError(
                f"the history of the cell cannot be used: {problem}",
                at=Place(self.path),
                remedy="check that the file is an SQLite database and that its folder is writable",
            ) from None


def _create_tables(database: sqlite3.Connection) -> None:
    for kind, table in _TABLES.items():
        columns = [f"{one.name} {_sql_type(one.type)}" for one in fields(kind)]
        key = ", PRIMARY KEY (name)" if "name" in {one.name for one in fields(kind)} else ""
        database.execute(f"CREATE TABLE IF NOT EXISTS {table} ({', '.join(columns)}{key})")
    database.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")


def _sql_type(kind: Any) -> str:
    if kind == float | None:
        return "REAL"
    return _SQL_TYPES.get(kind, "TEXT NOT NULL")


def _entry(kind: type[Entry], values: dict[str, Any]) -> Entry:
    booleans = {one.name: bool(values[one.name]) for one in fields(kind) if one.type is bool}
    return kind(**(values | booleans))


def event_kinds() -> tuple[str, ...]:
    """Return the kinds of events."""
    return get_args(EventKind)
