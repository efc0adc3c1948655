"""Robots of a fleet and their measurements, from a manifest (CSV) or from a tree of folders."""

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from pisigma.files.errors import FleetError, Place, nearest_choice
from pisigma.measurement.camera.camera_files import CameraFiles
from pisigma.measurement.csv.header import check_separators
from pisigma.measurement.csv.table import Table, read_table
from pisigma.measurement.dates import EXPECTED_DATE, date_in_name, is_date

COLUMNS = ("id", "robot", "data", "date", "model", "options", "camera", "board")
"""Columns of a manifest; the first three are required."""
ROBOT_FILES = ("robot.yaml", "robot.yml", "robot.urdf")
"""Names of the robot description in a robot's folder."""
_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
_ID_CHARACTERS = "1 to 100 letters, digits, '.', '_' or '-', a letter or digit first"


@dataclass(frozen=True)
class SessionFile:
    """Measurements of a robot at one time.

    Attributes:
        name: name of the session in its results: the date, else the name of the file without suffix.
        date: date (ISO 8601); "" if neither the manifest nor the name of the file states it.
        data: measurements (CSV).
    """

    name: str
    date: str
    data: Path


@dataclass(frozen=True)
class Member:
    """A robot of the fleet.

    Attributes:
        id: name in the fleet, valid as the name of a folder.
        robot: nominal robot: a name of the catalogue or a robot file.
        sessions: sessions sorted by date; empty if the description is faulty.
        model: folder of the model that the first session is compared with; None to calibrate with the first session.
        options: names and values of settings of this robot alone.
        cameras: cameras and boards where its files contain corners in images.
        fault: fault of the description, with file and line; the robot is then not processed.
        error: the exception with the fields of the fault.
    """

    id: str
    robot: str
    sessions: tuple[SessionFile, ...]
    model: Path | None = None
    options: tuple[tuple[str, str], ...] = ()
    cameras: CameraFiles | None = None
    fault: str = ""
    error: FleetError | None = field(default=None, compare=False, repr=False)


def read_fleet(source: str | os.PathLike[str], robot: str | None = None) -> tuple[Member, ...]:
    """Read the robots of a fleet.

    A manifest has the columns `id`, `robot` and `data`, and optionally `date`, `model` and `options` (such as
    `free=joint_offsets; model=geometric`), and `camera` and `board` where the data are corners in images (several as
    `a.yaml; b.yaml`). Several rows of one id are several sessions. Paths are relative to the folder of the manifest. In
    a folder, every subfolder is a robot with its measurements (`*.csv`) and its description (`robot.yaml` or
    `robot.urdf`), and every `*.csv` is a robot that was measured once.

    Args:
        source: manifest or folder.
        robot: nominal robot of those robots that state none.

    Returns:
        The robots sorted by their ids.

    Raises:
        FleetError: there is no robot, an id is invalid or appears twice, or the descriptions of all robots are faulty.
        MeasurementError: the manifest is not a CSV file with commas between its fields.
    """
    path = Path(source)
    members = _in_folder(path, robot) if path.is_dir() else _in_manifest(path, robot)
    if not members:
        raise FleetError(
            expected="a manifest (CSV) with the columns id, robot and data, or a folder with one folder or one CSV "
            "file per robot",
            value="no robot",
            at=Place(path),
        )
    _check_apart([one.id for one in members], path)
    if all(one.fault for one in members):
        raise members[0].error or FleetError(members[0].fault)
    return tuple(sorted(members, key=lambda one: one.id))


def _check_apart(names: Sequence[str], path: Path) -> None:
    """Refuse ids that are equal, or equal up to case, which some file systems do not distinguish."""
    first: dict[str, str] = {}
    for name in names:
        other = first.setdefault(name.casefold(), name)
        if other != name:
            problem = f"the ids '{other}' and '{name}' differ in case only"
            raise FleetError(problem, value=name, at=Place(path), remedy="rename one")
        if names.count(name) > 1:
            problem = f"robot '{name}' is a folder and a file"
            raise FleetError(problem, value=name, at=Place(path), remedy="rename one")


def _in_manifest(path: Path, robot: str | None) -> list[Member]:
    """Read the robots of a manifest."""
    table = read_table(path)
    for name in table.header:
        check_separators(name, table.header_place)
        if name not in COLUMNS:
            at, remedy = Place(path, table.header_line, name), nearest_choice(name, COLUMNS)
            raise FleetError("unknown column", value=name, at=at, remedy=remedy)
    required = COLUMNS[:3] if robot is None else ("id", "data")
    if missing := [name for name in required if name not in table.header]:
        at = Place(path, table.header_line, missing[0])
        raise FleetError("the column is missing", at=at, remedy="add it")
    rows: dict[str, list[tuple[int, dict[str, str]]]] = {}
    broken: dict[str, FleetError] = {}
    for number, record in enumerate(table.records):
        line, problem = table.lines[number], _broken(path, table, number)
        fields = dict(zip(table.header, (field.strip() for field in record), strict=False))
        if problem and "id" not in fields:
            raise problem
        if problem:
            broken.setdefault(fields["id"], problem)
        rows.setdefault(fields["id"], []).append((line, fields))
    members = []
    for name, lines in rows.items():
        _check_id(name, Place(path, lines[0][0]))
        try:
            if name in broken:
                raise broken[name]
            members.append(_member(path, name, lines, robot))
        except FleetError as fault:  # a faulty robot does not affect the others
            members.append(Member(name, "", (), fault=str(fault), error=fault))
    return members


def _broken(path: Path, table: Table, number: int) -> FleetError | None:
    """Return the fault of a row; None if there is none."""
    at = Place(path, table.lines[number])
    if number in table.broken:
        return FleetError(table.broken[number].removesuffix("."), at=at)
    expected, got = len(table.header), len(table.records[number])
    if got == expected:
        return None
    return FleetError(expected=f"{expected} fields", value=got, at=at, remedy="write one for every column")


def _member(path: Path, name: str, rows: Sequence[tuple[int, dict[str, str]]], robot: str | None) -> Member:
    """Make the robot of some rows of a manifest.

    Raises:
        FleetError: a row is faulty.
    """
    first = rows[0][0]
    sessions = []
    for line, fields in rows:
        data, date = fields["data"], fields.get("date", "")
        if not data:
            at, remedy = Place(path, line, "data"), "name a file of measurements"
            raise FleetError("the field is empty", at=at, remedy=remedy)
        if date and not is_date(date):
            raise FleetError(
                expected=EXPECTED_DATE, value=date, at=Place(path, line, "date"), remedy="correct it"
            )
        sessions.append(_session(path.parent / data, date))
    stated = {key: {fields.get(key, "") for _, fields in rows} - {""} for key in ("robot", *COLUMNS[4:])}
    for key, values in stated.items():
        if len(values) > 1:
            problem = f"robot '{name}' has several different entries"
            raise FleetError(problem, value=name, at=Place(path, first, key), remedy="state one")
    description = next(iter(stated["robot"]), robot)
    if description is None:
        at, remedy = Place(path, first, "robot"), "name a robot or a robot file"
        raise FleetError("the field is empty", at=at, remedy=remedy)
    file = path.parent / description
    return Member(
        id=name,
        robot=str(file) if file.is_file() else description,
        sessions=_ordered(sessions, name, Place(path, first)),
        model=next((path.parent / model for model in stated["model"]), None),
        options=_options(next(iter(stated["options"]), "")),
        cameras=_cameras(path, first, *(next(iter(stated[key]), "") for key in ("camera", "board"))),
    )


def _cameras(path: Path, line: int, *stated: str) -> CameraFiles | None:
    """Read cameras and boards of a robot, from their files separated by `;`."""
    files = [[str(path.parent / file.strip()) for file in text.split(";") if file.strip()] for text in stated]
    cameras, boards = map(tuple, files)
    if bool(cameras) != bool(boards):
        at = Place(path, line, "board" if cameras else "camera")
        raise FleetError("the columns 'camera' and 'board' belong together", at=at, remedy="fill both")
    return CameraFiles(cameras, boards) if cameras else None


def _options(text: str) -> tuple[tuple[str, str], ...]:
    """Split settings of a robot given as `name=value; name=value`; other parts have the value ""."""
    options = []
    for part in filter(None, map(str.strip, text.split(";"))):
        name, equals, value = map(str.strip, part.partition("="))
        options.append((name, value) if name and equals and value else (part, ""))
    return tuple(options)


def _in_folder(path: Path, robot: str | None) -> list[Member]:
    """Read the robots of a tree of folders, without entries whose names start with a dot."""
    members = []
    for entry in sorted(path.iterdir()):
        if entry.name.startswith(".") or not (entry.is_dir() or entry.suffix.lower() == ".csv"):
            continue
        files = sorted(entry.glob("*.csv")) if entry.is_dir() else [entry]
        if not files:
            continue
        name = entry.name if entry.is_dir() else entry.stem
        _check_id(name, Place(entry))
        try:
            members.append(_of_files(entry, name, files, robot))
        except FleetError as fault:
            members.append(Member(name, "", (), fault=str(fault), error=fault))
    return members


def _of_files(entry: Path, name: str, files: Sequence[Path], robot: str | None) -> Member:
    """Make the robot of a folder, or of a file.

    Raises:
        FleetError: it has no description, or its sessions cannot be distinguished.
    """
    description = next((str(entry / one) for one in ROBOT_FILES if (entry / one).is_file()), robot)
    if description is None:
        raise FleetError(
            expected=f"one of {', '.join(ROBOT_FILES)}",
            value="none of them",
            at=Place(entry),
            remedy="add the robot's description, or state one for all robots",
        )
    return Member(name, description, _ordered([_session(file, "") for file in files], name, Place(entry)))


def _check_id(name: str, at: Place) -> None:
    """Refuse an id that cannot be the name of a folder."""
    if not _ID.fullmatch(name):
        raise FleetError(expected=f"an id of {_ID_CHARACTERS}", value=name, at=at)


def _session(data: Path, date: str) -> SessionFile:
    """Make a session, with the date in the name of the file where none is stated."""
    date = date or date_in_name(data.stem)
    return SessionFile(date or data.stem, date, data)


def _ordered(sessions: Sequence[SessionFile], robot: str, at: Place) -> tuple[SessionFile, ...]:
    """Sort the sessions of a robot by date.

    Raises:
        FleetError: two sessions have the same name or the same file, or cannot be sorted.
    """
    names = [one.name for one in sessions]
    for one in sessions:
        if not _ID.fullmatch(one.name):
            raise FleetError(
                f"the session of '{one.data.name}' cannot be named '{one.name}'",
                value=one.name,
                at=at,
                remedy=f"state its date, or use a file name of {_ID_CHARACTERS}",
            )
        if names.count(one.name) > 1:
            problem = f"robot '{robot}' has two sessions '{one.name}'"
            raise FleetError(problem, value=one.name, at=at, remedy="state different dates")
    files = [os.path.realpath(one.data) for one in sessions]  # also resolves a link to itself
    if twice := [one for one, file in zip(sessions, files, strict=True) if files.count(file) > 1]:
        raise FleetError(
            f"the sessions '{twice[0].name}' and '{twice[1].name}' of robot '{robot}' have the same file "
            f"'{twice[0].data.name}'",
            value=twice[0].data.name,
            at=at,
            remedy="name the file of each",
        )
    if len(sessions) > 1 and not all(one.date for one in sessions):
        raise FleetError(
            f"robot '{robot}' has several sessions, not all of which have dates",
            value=robot,
            at=at,
            remedy="state them in the column 'date' or in the names of the files, such as 2026-11-22.csv",
        )
    return tuple(sorted(sessions, key=lambda one: one.date))
