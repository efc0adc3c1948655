"""Calibrate, recalibrate or monitor the robots of a fleet; the results are records, model folders and one table."""

import functools
import hashlib
import json
import os
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from pisigma.files.conflicts import check_conflicts
from pisigma.files.engines.engine import AbstractEngine
from pisigma.files.engines.processes import ProcessEngine
from pisigma.files.errors import OutputError, PisigmaError, Place
from pisigma.files.model_files import is_model, model_hash
from pisigma.files.plugins import loaded
from pisigma.files.progress import Progress
from pisigma.lifetime.fleet.members import Member, read_fleet
from pisigma.lifetime.fleet.record import (
    MARKER_FILE,
    RESULTS,
    RobotRecord,
    expect_robots,
    read_record,
    read_records,
    record_path,
    write_results,
)
from pisigma.model.folder.model_folder import load_model
from pisigma.model.model_posterior import check_fleet_prior
from pisigma.workflow.fleet.one_robot import process_robot, settings_for
from pisigma.workflow.settings.calibration import CalibrationSettings
from pisigma.workflow.settings.fleet import FleetSettings

ROBOTS_PER_CHUNK = 4
"""Robots that a worker processes at once, which takes some seconds."""

_LOST = "the process that worked on it ended twice; check the memory and its files."


@dataclass(frozen=True)
class FleetRun:
    """Result of `run_fleet`.

    Attributes:
        records: records of the robots of this call, in the order of the fleet.
        refused: ids of the robots without results, and reasons.
        resumed: number of robots that an earlier call had already processed.
        results: file of the table of all robots in the folder.
        seconds: computing time [s].
    """

    records: tuple[RobotRecord, ...]
    refused: tuple[tuple[str, str], ...]
    resumed: int
    results: Path
    seconds: float

    @property
    def done(self) -> int:
        """Number of robots with results for all of their sessions."""
        return len(self.records) - len(self.refused)

    def to_json(self) -> dict[str, Any]:
        """Return all figures as plain values."""
        return {
            "robots": len(self.records),
            "done": self.done,
            "resumed": self.resumed,
            "refused": [{"robot": robot, "reason": reason} for robot, reason in self.refused],
            "seconds": round(self.seconds, 3),
            "results": str(self.results),
        }


def run_fleet(
    source: str | os.PathLike[str],
    out: str | os.PathLike[str],
    settings: FleetSettings | None = None,
    robot: str | None = None,
    progress: Progress = lambda what: None,
) -> FleetRun:
    """Process all robots of a fleet, and keep the results of earlier calls with the same folder.

    A robot with bad files or options is reported and does not stop the others. Every robot has a record, which is
    written whole when the robot is done. A robot is processed again where its files or the settings have changed, its
    model is missing, or it was refused because the disk was full.

    Args:
        source: manifest (CSV) or folder; see `pisigma.lifetime.fleet.members.read_fleet`.
        out: folder to write: `results.parquet`, `records/ID.json` and `models/ID/SESSION`.
        settings: see `FleetSettings`. None: the defaults.
        robot: nominal robot of those robots that do not state one.
        progress: called with the number of processed robots.

    Raises:
        FleetError: the fleet cannot be used, or the options of none of its robots can.
        MeasurementError: the manifest is not a CSV file.
        ModelError: the prior is not a model of `pisigma fleet prior`.
        OutputError: the folder is not that of a fleet, or cannot be written to.
        ImportError: the extra of the engine or of the table is not installed.
    """
    started, settings = time.perf_counter(), settings or FleetSettings()
    for extra in ("pyarrow", *(("ray",) if settings.engine == "ray" else ())):
        import_module(extra)  # before the work, and before anything is written
    members = read_fleet(source, robot)
    plans = _plans(members, settings)
    folder = Path(out)
    if settings.prior is not None:
        check_fleet_prior(load_model(settings.prior))
    keys = {member.id: _key(member, settings, plans[member.id]) for member in members}
    _prepare(folder, Path(source), members)
    finished = [_finished(folder, member, keys[member.id]) for member in members]
    records = {record.robot: record for record in finished if record is not None}
    resumed, waiting = len(records), [member for member in members if member.id not in records]
    lost: dict[str, str] = {}
    work = functools.partial(process_robot, settings=settings, out=folder.absolute(), keys=keys, plans=plans)
    with _engine(settings, len(waiting)) as engine:
        for member, record in engine.results(work, waiting, ROBOTS_PER_CHUNK) if waiting else ():
            if record is None:
                lost[member.id] = _LOST
                record = RobotRecord(member.id, keys[member.id], ())
            records[member.id] = record
            progress(f"{len(records)} of {len(members)} robots")
    of_call = tuple(records[member.id] for member in members)
    reasons = {record.robot: lost.get(record.robot) or record.reason for record in of_call}
    write_results(folder / RESULTS, read_records(folder))
    return FleetRun(
        records=of_call,
        refused=tuple((name, reason) for name, reason in reasons.items() if reason),
        resumed=resumed,
        results=folder / RESULTS,
        seconds=time.perf_counter() - started,
    )


def _plans(members: Sequence[Member], settings: FleetSettings) -> dict[str, CalibrationSettings | str]:
    """Return the settings of every robot's calibration, or why its options cannot be used.

    Raises:
        PisigmaError: the options of no robot can be used.
    """
    plans: dict[str, CalibrationSettings | str] = {}
    for member in members:
        try:
            plans[member.id] = settings_for(settings, member)
        except PisigmaError as problem:
            plans[member.id] = str(problem)
            if len(plans) == len(members) and all(isinstance(plan, str) for plan in plans.values()):
                raise
    return plans


@contextmanager
def _engine(settings: FleetSettings, items: int) -> Iterator[AbstractEngine]:
    """Yield the engine that the settings choose."""
    jobs = settings.jobs or os.cpu_count() or 1
    if settings.engine == "processes" or not items:
        yield ProcessEngine(max(1, min(jobs, items)))
        return
    from pisigma.files.engines.ray_cluster import RayEngine

    engine = RayEngine(settings.jobs, settings.address)
    try:
        yield engine
    finally:
        engine.close()


def _prepare(folder: Path, source: Path, members: tuple[Member, ...]) -> None:
    """Create the folder of a fleet, or check that an existing one is that of a fleet.

    Raises:
        OutputError: it is something else, contains an input or is inside one, or cannot be written to.
    """
    inputs = [source, *(one.data for member in members for one in member.sessions)]
    inputs += [member.model for member in members if member.model is not None]
    inputs += [Path(file) for member in members if member.cameras for file in member.cameras.files]
    mark = folder / MARKER_FILE
    try:
        check_conflicts(folder, inputs)
        if folder.exists() and not folder.is_dir():
            raise OutputError(expected="a folder", at=Place(folder), remedy="choose another --out")
        if folder.is_dir() and any(folder.iterdir()) and not mark.is_file():
            raise OutputError(
                expected="the folder of a fleet, or an empty folder",
                at=Place(folder),
                remedy="choose another --out",
            )
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as problem:
        raise OutputError(
            f"cannot be written: {problem.strerror}", at=Place(folder), remedy="choose another --out"
        ) from None
    expect_robots(folder, [member.id for member in members])


def _finished(out: Path, member: Member, key: str) -> RobotRecord | None:
    """Return the record of an earlier call if its inputs were the same and its models still exist, else None."""
    record = read_record(record_path(out, member.id))
    if record is None or record.key != key:
        return None
    return record if all(not one.model or is_model(out / one.model) for one in record.sessions) else None


def _key(member: Member, settings: FleetSettings, plan: CalibrationSettings | str) -> str:
    """Return the SHA-256 of all that a robot's results depend on: files, settings and the version of pisigma."""
    from pisigma import __version__

    description, model = Path(member.robot), member.model
    stated = {
        "version": __version__,
        "task": settings.task,
        "validate": settings.validate,
        "prior": None if settings.prior is None else model_hash(settings.prior),
        "plan": repr(plan),
        "plugins": loaded().content(),
        "robot": _hash_of(description) if description.is_file() else member.robot,
        "model": None if model is None else model_hash(model) if is_model(model) else str(model),
        "cameras": [_hash_of(Path(file)) for file in (member.cameras.files if member.cameras else ())],
        "sessions": [(one.name, one.date, one.data.name, _hash_of(one.data)) for one in member.sessions],
    }
    return hashlib.sha256(json.dumps(stated, sort_keys=True).encode()).hexdigest()


def _hash_of(path: Path) -> str:
    """Return the SHA-256 of a file; the system's message where it cannot be read, which the robot's record reports."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else "no file"
    except OSError as problem:
        return str(problem.strerror)
