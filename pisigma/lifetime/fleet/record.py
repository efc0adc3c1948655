"""Results of the robots of a fleet: one small file each, from which a later call resumes, and a table of all."""

import io
import json
from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from pisigma.files.errors import FleetError, Place
from pisigma.files.output_file import write_whole

REFUSED = "refused"
"""Verdict on a session whose file cannot be used."""
MARKER_FILE = "fleet.json"
"""File in the folder of a fleet with the ids of its robots; folders without it are not written into."""
RESULTS = "results.parquet"
"""Name of the table of all results."""


@dataclass(frozen=True)
class ParameterValue:
    """An estimated geometric parameter.

    Attributes:
        name: name such as "theta_1".
        unit: "mm" or "deg", of the three figures.
        value: identified value.
        change: difference from the nominal value.
        standard_error: standard error of the estimate; None if there is none.
    """

    name: str
    unit: str
    value: float | None
    change: float | None
    standard_error: float | None


@dataclass(frozen=True)
class SessionRecord:
    """Result of one session.

    Attributes:
        session: name of the session.
        date: date (ISO 8601); "" if it is unknown.
        file: name of the file of measurements.
        rows: number of rows that count; 0 where the file was refused.
        verdict: "calibrated"; for a recalibration the model that was kept ("old", "recalibrated" or "scratch"); for a
            monitored session "unchanged", "moved" or "unclear"; or "refused".
        sentence: the verdict as a sentence; for a refused session the reason.
        model: folder of the model, relative to the folder of the fleet; "" if none was written.
        rms_mm: RMS position error [mm] of the rows that were calibrated with, of the rows held out by a recalibration,
            or of the monitored rows under the model.
        held_out_rms_mm: RMS position error of the cross-validation [mm]; None without one.
        recalibrate: whether a recalibration is recommended.
        moved: whether a movement since the session before is significant.
        parameters: estimated parameters.
        warnings: warnings, one sentence each.
    """

    session: str
    date: str
    file: str
    rows: int
    verdict: str
    sentence: str
    model: str = ""
    rms_mm: float | None = None
    held_out_rms_mm: float | None = None
    recalibrate: bool = False
    moved: bool = False
    parameters: tuple[ParameterValue, ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def refused(self) -> bool:
        """Whether the file of the session was refused."""
        return self.verdict == REFUSED

    @property
    def error_mm(self) -> float | None:
        """RMS position error [mm], of the cross-validation where there was one."""
        return self.rms_mm if self.held_out_rms_mm is None else self.held_out_rms_mm


@dataclass(frozen=True)
class RobotRecord:
    """Results of a robot.

    Attributes:
        robot: id of the robot.
        key: SHA-256 of all inputs; a robot with another key is processed again.
        sessions: results sorted by date, up to one that was refused.
    """

    robot: str
    key: str
    sessions: tuple[SessionRecord, ...]

    @property
    def reason(self) -> str | None:
        """Why a session was refused; None if none was."""
        return next((f"{one.session}: {one.sentence}" for one in self.sessions if one.refused), None)


_RECORD = TypeAdapter(RobotRecord)


def record_path(out: Path, robot: str) -> Path:
    """Return the path of the record of a robot."""
    return out / "records" / f"{robot}.json"


def write_record(out: Path, record: RobotRecord) -> None:
    """Write a record atomically.

    Raises:
        OutputError: it cannot be written.
    """
    path = record_path(out, record.robot)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, _RECORD.dump_json(record, indent=1) + b"\n")


def read_record(path: Path) -> RobotRecord | None:
    """Read a record; None if it is missing or unreadable, so that the robot is processed again."""
    try:
        return _RECORD.validate_json(path.read_bytes()) if path.is_file() else None
    except (OSError, ValidationError):
        return None


def expect_robots(out: Path, robots: Collection[str]) -> None:
    """Add robots to the list in the folder of a fleet.

    Raises:
        OutputError: it cannot be written.
    """
    before = expected_robots(out) if (out / MARKER_FILE).is_file() else ()
    everyone = sorted({*before, *robots})
    write_whole(out / MARKER_FILE, json.dumps({"format": 1, "robots": everyone}, indent=1) + "\n")


def expected_robots(out: Path) -> tuple[str, ...]:
    """Read the ids of the robots of a fleet.

    Raises:
        FleetError: the folder is not the folder of a fleet.
    """
    try:
        content = json.loads((out / MARKER_FILE).read_text(encoding="utf-8"))
        return tuple(str(robot) for robot in content["robots"])
    except (OSError, ValueError, KeyError, TypeError):
        problem, remedy = "not the folder of a fleet", "make one with `pisigma fleet run`"
        raise FleetError(problem, at=Place(out), remedy=remedy) from None


def read_records(out: Path) -> tuple[RobotRecord, ...]:
    """Read the records of all robots that have one, sorted by id.

    Raises:
        FleetError: the folder is not the folder of a fleet.
    """
    expected_robots(out)
    found = (read_record(path) for path in sorted((out / "records").glob("*.json")))
    return tuple(one for one in found if one is not None)


def write_results(path: Path, records: Sequence[RobotRecord]) -> None:
    """Write one row per robot and session, sorted by both; parameters and warnings are list columns.

    Raises:
        OutputError: the file cannot be written; an existing one is kept.
        ImportError: pyarrow is not installed.
    """
    import pyarrow
    from pyarrow import parquet

    text, number = pyarrow.string(), pyarrow.float64()
    parameter = [
        ("name", text),
        ("unit", text),
        *((name, number) for name in ("value", "change", "standard_error")),
    ]
    schema = pyarrow.schema(
        [
            *((name, text) for name in ("robot", "session", "date", "file")),
            ("rows", pyarrow.int64()),
            *((name, text) for name in ("verdict", "sentence", "model")),
            *((name, number) for name in ("rms_mm", "held_out_rms_mm")),
            *((name, pyarrow.bool_()) for name in ("recalibrate", "moved")),
            ("parameters", pyarrow.list_(pyarrow.struct(parameter))),
            ("warnings", pyarrow.list_(text)),
        ]
    )
    rows = [
        {"robot": record.robot, **asdict(session)}
        for record in sorted(records, key=lambda one: one.robot)
        for session in record.sessions
    ]
    content = io.BytesIO()
    parquet.write_table(pyarrow.Table.from_pylist(rows, schema), content)
    write_whole(path, content.getvalue())
