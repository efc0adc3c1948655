"""What came of the robots of a fleet: one small file each, which a later call goes on from, and a table of all."""

import io
import json
from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from pisigma.files.errors import FleetError
from pisigma.files.output_file import write_whole

REFUSED = "refused"
MARK = "fleet.json"
"""In the folder of a fleet, with the ids of its robots, so that no other folder is written into."""
RESULTS = "results.parquet"


@dataclass(frozen=True)
class ParameterValue:
    """A geometric parameter that was estimated.

    Attributes:
        name: such as "theta_1".
        unit: "mm" or "deg"; of the three figures.
        value: as identified.
        change: from its nominal value.
        standard_error: of the estimate; None where there is none.
    """

    name: str
    unit: str
    value: float | None
    change: float | None
    standard_error: float | None


@dataclass(frozen=True)
class SessionRecord:
    """What came of one session.

    Attributes:
        session: its name.
        date: as ISO 8601 writes it; "" where it is not known.
        file: name of the file of measurements.
        rows: that were measured and count; 0 where the file was refused.
        verdict: "calibrated"; of a recalibration which model was kept ("old", "recalibrated" or "scratch"); of a
            monitored session "unchanged", "moved" or "unclear"; or "refused".
        sentence: the same in words; of a refused session the reason.
        model: folder of the model, in the folder of the fleet; "" where none was written.
        rms_mm: RMS error of the position [mm] of the rows that were calibrated with, or of those left out by a
            recalibration, or of the monitored rows under the model.
        held_out_rms_mm: of the cross-validation [mm]; None without one.
        recalibrate: whether recalibrating pays.
        moved: whether something has clearly moved since the session before.
        parameters: that were estimated.
        warnings: what to heed, a sentence each.
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
        """Whether nothing came of it."""
        return self.verdict == REFUSED

    @property
    def error_mm(self) -> float | None:
        """RMS error of the position [mm], of the cross-validation where there was one."""
        return self.rms_mm if self.held_out_rms_mm is None else self.held_out_rms_mm


@dataclass(frozen=True)
class RobotRecord:
    """What came of a robot.

    Attributes:
        robot: its id.
        key: SHA-256 of all that it was worked out from; another one is worked out anew.
        sessions: by date, up to one that was refused.
    """

    robot: str
    key: str
    sessions: tuple[SessionRecord, ...]

    @property
    def reason(self) -> str | None:
        """Why a session was refused; None where none was."""
        return next((f"{one.session}: {one.sentence}" for one in self.sessions if one.refused), None)


_RECORD = TypeAdapter(RobotRecord)


def record_path(out: Path, robot: str) -> Path:
    """Where the record of a robot is kept."""
    return out / "records" / f"{robot}.json"


def write_record(out: Path, record: RobotRecord) -> None:
    """Write a record whole or not at all.

    Raises:
        OutputError: it cannot be written.
    """
    path = record_path(out, record.robot)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, _RECORD.dump_json(record, indent=1) + b"\n")


def read_record(path: Path) -> RobotRecord | None:
    """Read a record; None where there is none that can be read, so that the robot is worked out anew."""
    try:
        return _RECORD.validate_json(path.read_bytes()) if path.is_file() else None
    except (OSError, ValidationError):
        return None


def expect_robots(out: Path, robots: Collection[str]) -> None:
    """Note in the folder of a fleet which robots it has, beside those that earlier calls noted.

    Raises:
        OutputError: it cannot be written.
    """
    before = expected_robots(out) if (out / MARK).is_file() else ()
    everyone = sorted({*before, *robots})
    write_whole(out / MARK, json.dumps({"format": 1, "robots": everyone}, indent=1) + "\n")


def expected_robots(out: Path) -> tuple[str, ...]:
    """Read which robots a fleet has, by their ids.

    Raises:
        FleetError: the folder is not that of a fleet.
    """
    try:
        content = json.loads((out / MARK).read_text(encoding="utf-8"))
        return tuple(str(robot) for robot in content["robots"])
    except (OSError, ValueError, KeyError, TypeError):
        raise FleetError(f"{out}: is not the folder of a fleet; make one with `pisigma fleet run`.") from None


def read_records(out: Path) -> tuple[RobotRecord, ...]:
    """Read the records of all robots that have one, by their ids.

    Raises:
        FleetError: the folder is not that of a fleet.
    """
    expected_robots(out)
    found = (read_record(path) for path in sorted((out / "records").glob("*.json")))
    return tuple(one for one in found if one is not None)


def write_results(path: Path, records: Sequence[RobotRecord]) -> None:
    """Write one row per robot and session, ordered by both; parameters and warnings are lists in their columns.

    Raises:
        OutputError: it cannot be written; what was there stays.
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
