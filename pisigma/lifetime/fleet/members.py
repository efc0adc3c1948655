"""Which robots a fleet has and what was measured of each: from a manifest (CSV) or from a tree of folders."""

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pisigma.files.errors import FleetError, nearest_choice
from pisigma.measurement.camera.camera_files import CameraFiles
from pisigma.measurement.csv.header import check_separators
from pisigma.measurement.csv.table import Table, read_table
from pisigma.measurement.dates import WANTED, date_in_name, is_date

COLUMNS = ("id", "robot", "data", "date", "model", "options", "camera", "board")
"""Of a manifest; the first three are needed."""
ROBOT_FILES = ("robot.yaml", "robot.yml", "robot.urdf")
"""The description of a robot in its folder."""
_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")


@dataclass(frozen=True)
class SessionFile:
    """What was measured of a robot at one time.

    Attributes:
        name: of the session, which its results carry: the date, or else the name of the file without its ending.
        date: as ISO 8601 writes it; "" where neither the manifest nor the name of the file states it.
        data: measurements (CSV).
    """

    name: str
    date: str
    data: Path


@dataclass(frozen=True)
class Member:
    """A robot of the fleet.

    Attributes:
        id: its name in the fleet, fit for a folder.
        robot: as drawn: a name of the catalogue or a robot file.
        sessions: what was measured, by date; none where its description is wrong.
        model: folder of the model that the first session meets; None where the first session is calibrated.
        options: names and texts of settings that only this robot has.
        cameras: what the pixels mean where its files hold corners of boards in images.
        fault: what is wrong with its description, with file and line; this robot cannot be worked out then.
    """

    id: str
    robot: str
    sessions: tuple[SessionFile, ...]
    model: Path | None = None
    options: tuple[tuple[str, str], ...] = ()
    cameras: CameraFiles | None = None
    fault: str = ""


def read_fleet(source: str | os.PathLike[str], robot: str | None = None) -> tuple[Member, ...]:
    """Read which robots there are.

    A manifest has the columns `id`, `robot` and `data`, and may have `date`, `model` and `options` (such as
    `free=joint_offsets; model=geometric`), and `camera` and `board` where the data are corners in images (`a.yaml;
    b.yaml` of several); several rows of one id are several sessions. Its paths are relative to its own folder. In a
    folder, every folder in it is a robot with its measurements (`*.csv`) and its description
    (`robot.yaml` or `robot.urdf`), and every `*.csv` in it a robot that was measured once.

    Args:
        source: manifest or folder.
        robot: as drawn, of those robots that state none.

    Returns:
        The robots by their ids.

    Raises:
        FleetError: there is none, or one that cannot be named or is described twice, or all are described wrongly; the
            message names file and line.
        MeasurementError: the manifest is no CSV file, or has no commas between its fields.
    """
    path = Path(source)
    members = _in_folder(path, robot) if path.is_dir() else _in_manifest(path, robot)
    if not members:
        raise FleetError(
            f"{path}: holds no robot; a manifest (CSV) with the columns id, robot and data was wanted, or a folder "
            "with one folder or one CSV file per robot."
        )
    _check_apart([one.id for one in members], path)
    if all(one.fault for one in members):
        raise FleetError(members[0].fault)
    return tuple(sorted(members, key=lambda one: one.id))


def _check_apart(names: Sequence[str], path: Path) -> None:
    """Refuse ids that are the same, or whose folders are the same where file systems take a for A."""
    first: dict[str, str] = {}
    for name in names:
        other = first.setdefault(name.casefold(), name)
        if other != name:
            raise FleetError(f"{path}: the ids '{other}' and '{name}' differ by capitals only; rename one.")
        if names.count(name) > 1:
            raise FleetError(f"{path}: robot '{name}' is a folder and a file; rename one.")


def _in_manifest(path: Path, robot: str | None) -> list[Member]:
    """The robots of a manifest."""
    table = read_table(path)
    for name in table.header:
        check_separators(name, table.header_place)
        if name not in COLUMNS:
            raise FleetError(
                f"{path}, line {table.header_line}: column '{name}' is unknown; {nearest_choice(name, COLUMNS)}"
            )
    wanted = COLUMNS[:3] if robot is None else ("id", "data")
    if missing := [name for name in wanted if name not in table.header]:
        raise FleetError(f"{path}, line {table.header_line}: column '{missing[0]}' is missing; add it.")
    rows: dict[str, list[tuple[int, dict[str, str]]]] = {}
    broken: dict[str, str] = {}
    for number, record in enumerate(table.records):
        line, problem = table.lines[number], _broken(table, number)
        fields = dict(zip(table.header, (field.strip() for field in record), strict=False))
        if problem and "id" not in fields:
            raise FleetError(f"{path}, line {line}: {problem}")
        if problem:
            broken.setdefault(fields["id"], f"{path}, line {line}: {problem}")
        rows.setdefault(fields["id"], []).append((line, fields))
    members = []
    for name, lines in rows.items():
        _check_id(name, f"{path}, line {lines[0][0]}")
        try:
            if name in broken:
                raise FleetError(broken[name])
            members.append(_member(path, name, lines, robot))
        except FleetError as problem:  # what ends one robot does not end the others
            members.append(Member(name, "", (), fault=str(problem)))
    return members


def _broken(table: Table, number: int) -> str:
    """What is wrong with a row; "" where nothing is."""
    if number in table.broken:
        return table.broken[number]
    wanted, got = len(table.header), len(table.records[number])
    return "" if got == wanted else f"{wanted} fields were wanted, got {got}; write one for every column."


def _member(path: Path, name: str, rows: Sequence[tuple[int, dict[str, str]]], robot: str | None) -> Member:
    """The robot of some rows of a manifest.

    Raises:
        FleetError: its rows are wrong.
    """
    first = rows[0][0]
    sessions = []
    for line, fields in rows:
        data, date = fields["data"], fields.get("date", "")
        if not data:
            raise FleetError(f"{path}, line {line}: the field 'data' is empty; name a file of measurements.")
        if date and not is_date(date):
            raise FleetError(f"{path}, line {line}: expected {WANTED}, got '{date}'; correct it.")
        sessions.append(_session(path.parent / data, date))
    stated = {key: {fields.get(key, "") for _, fields in rows} - {""} for key in ("robot", *COLUMNS[4:])}
    for key, values in stated.items():
        if len(values) > 1:
            raise FleetError(
                f"{path}, line {first}: robot '{name}' has several different entries in the column '{key}'; state one."
            )
    drawn = next(iter(stated["robot"]), robot)
    if drawn is None:
        raise FleetError(f"{path}, line {first}: the field 'robot' is empty; name a robot or a robot file.")
    file = path.parent / drawn
    return Member(
        id=name,
        robot=str(file) if file.is_file() else drawn,
        sessions=_ordered(sessions, f"{path}, line {first}: robot '{name}'"),
        model=next((path.parent / model for model in stated["model"]), None),
        options=_options(next(iter(stated["options"]), "")),
        cameras=_cameras(path, first, *(next(iter(stated[key]), "") for key in ("camera", "board"))),
    )


def _cameras(path: Path, line: int, *stated: str) -> CameraFiles | None:
    """Cameras and boards of a robot, from the files of each with `;` between them."""
    files = [[str(path.parent / file.strip()) for file in text.split(";") if file.strip()] for text in stated]
    cameras, boards = map(tuple, files)
    if bool(cameras) != bool(boards):
        raise FleetError(f"{path}, line {line}: the columns 'camera' and 'board' belong together; fill both.")
    return CameraFiles(cameras, boards) if cameras else None


def _options(text: str) -> tuple[tuple[str, str], ...]:
    """Settings of a robot, from `name=value; name=value`; what is no such pair has the value ""."""
    options = []
    for part in filter(None, map(str.strip, text.split(";"))):
        name, equals, value = map(str.strip, part.partition("="))
        options.append((name, value) if name and equals and value else (part, ""))
    return tuple(options)


def _in_folder(path: Path, robot: str | None) -> list[Member]:
    """The robots of a tree of folders; entries whose names begin with a dot are none."""
    members = []
    for entry in sorted(path.iterdir()):
        if entry.name.startswith(".") or not (entry.is_dir() or entry.suffix.lower() == ".csv"):
            continue
        files = sorted(entry.glob("*.csv")) if entry.is_dir() else [entry]
        if not files:
            continue
        name = entry.name if entry.is_dir() else entry.stem
        _check_id(name, str(entry))
        try:
            members.append(_of_files(entry, name, files, robot))
        except FleetError as problem:
            members.append(Member(name, "", (), fault=str(problem)))
    return members


def _of_files(entry: Path, name: str, files: Sequence[Path], robot: str | None) -> Member:
    """The robot of a folder, or of a file.

    Raises:
        FleetError: it is not described, or its sessions cannot be told apart.
    """
    drawn = next((str(entry / one) for one in ROBOT_FILES if (entry / one).is_file()), robot)
    if drawn is None:
        raise FleetError(
            f"{entry}: holds none of {', '.join(ROBOT_FILES)}; add the robot's description, or state one for all."
        )
    return Member(name, drawn, _ordered([_session(file, "") for file in files], f"{entry}: robot '{name}'"))


def _check_id(name: str, where: str) -> None:
    """Refuse an id that cannot be the name of a folder."""
    if not _ID.fullmatch(name):
        raise FleetError(
            f"{where}: '{name}' cannot be the id of a robot; letters, digits and . _ - were wanted, at most 100, a "
            "letter or digit first."
        )


def _session(data: Path, date: str) -> SessionFile:
    """A session with its date, from the name of the file where none is stated."""
    date = date or date_in_name(data.stem)
    return SessionFile(date or data.stem, date, data)


def _ordered(sessions: Sequence[SessionFile], where: str) -> tuple[SessionFile, ...]:
    """Sessions by their dates.

    Raises:
        FleetError: two cannot be told apart, are of one file, or cannot be put in order.
    """
    names = [one.name for one in sessions]
    for one in sessions:
        if not _ID.fullmatch(one.name):
            raise FleetError(
                f"{where}: the session of '{one.data.name}' cannot be called '{one.name}'; state its date, or name the "
                "file with letters, digits and . _ - only, at most 100, a letter or digit first."
            )
        if names.count(one.name) > 1:
            raise FleetError(f"{where}: has two sessions '{one.name}'; state different dates.")
    files = [os.path.realpath(one.data) for one in sessions]  # also of a link that leads to itself
    if twice := [one for one, file in zip(sessions, files, strict=True) if files.count(file) > 1]:
        raise FleetError(
            f"{where}: the sessions '{twice[0].name}' and '{twice[1].name}' are of the same file "
            f"'{twice[0].data.name}'; name the file of each."
        )
    if len(sessions) > 1 and not all(one.date for one in sessions):
        raise FleetError(
            f"{where}: has several sessions, and not all have dates; state them in the column 'date' or in the names "
            "of the files, such as 2026-11-22.csv."
        )
    return tuple(sorted(sessions, key=lambda one: one.date))
