"""Creation of the cells of a fleet from a manifest (CSV), or from a folder with the rows of every robot."""

import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from pisigma.files.errors import FleetError, Phrase, PisigmaError, Place, choice_remedy
from pisigma.files.setting import build_settings, settings_by_key
from pisigma.files.setting_values import read_assignments
from pisigma.lifetime.cell.facts import sha256_of
from pisigma.lifetime.cell.layout import SESSIONS, is_cell
from pisigma.measurement.camera.camera_files import CameraFiles
from pisigma.measurement.csv.header import check_separators
from pisigma.measurement.csv.table import read_table
from pisigma.measurement.dates import EXPECTED_DATE, date_in_name, is_date
from pisigma.workflow.cell.new_cell import NewCell, cell_from_model
from pisigma.workflow.cell.new_files import write_under_new_name
from pisigma.workflow.settings.calibration import CalibrationSettings

COLUMNS = ("id", "robot", "data", "date", "model", "options", "camera", "board")
"""Columns of a manifest; `id` and `data` are required."""
_ROBOT_FILES = ("robot.yaml", "robot.yml", "robot.urdf")
"""Names of the robot description in a folder with the rows of a robot."""
_NO_VALIDATION = {"folds": 0}
"""Settings of calibrations unless the manifest states others; many robots are calibrated without a cross-validation."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
_EXPECTED_NAME = "1 to 100 letters, digits, '.', '_' or '-', starting with a letter or digit"
_Row = tuple[Place, Mapping[str, str]]


@dataclass(frozen=True)
class NewCells:
    """Result of `new_cells`.

    Attributes:
        cells: folders of all cells of the manifest, sorted by name.
        created: number of cells that did not exist before.
        sessions: number of files of rows that were copied into cells.
        refused: reasons, by id, why a robot has no cell, or why its cell lacks some of its rows.
    """

    cells: tuple[Path, ...]
    created: int
    sessions: int
    refused: Mapping[str, str]

    def to_json(self) -> dict[str, object]:
        """Return all values as plain values."""
        refused = [{"cell": name, "reason": reason} for name, reason in self.refused.items()]
        counts = {"created": self.created, "sessions": self.sessions}
        return {"cells": [os.fspath(cell) for cell in self.cells], **counts, "refused": refused}


def new_cells(source: Path, out: Path, common: NewCell) -> NewCells:
    """Create a cell for every robot in a manifest or folder, and add new sessions to existing cells.

    A manifest has the columns `id` and `data`, and optionally `robot`, `date`, `model`, `options` (settings of
    `pisigma calibrate`, such as `free=joint_offsets; model=geometric`), `camera` and `board` (several as `a.yaml;
    b.yaml`). Several rows with the same id are several sessions. Paths are relative to the folder of the manifest. In a
    folder, every subfolder is a robot, with its description (`robot.yaml` or `robot.urdf`) and one `*.csv` file per
    session, and every `*.csv` file directly in the folder is a robot with a single session.

    Args:
        source: manifest or folder.
        out: folder of the cells.
        common: settings that all cells have in common; its robot applies to rows that state none ("" for none).

    Raises:
        FleetError: there is no robot, an id is invalid or appears twice, or no robot can be used.
        MeasurementError: the manifest is not a CSV file with commas between its fields.
    """
    robots: dict[str, list[_Row]] = {}
    for at, fields in _in_folder(source) if source.is_dir() else _in_manifest(source, common):
        robots.setdefault(fields["id"], []).append((at, fields))
    _check_names(robots, source)
    created, copied, refused = 0, 0, dict[str, PisigmaError]()
    for name, rows in sorted(robots.items()):
        try:
            cell = _cell(rows, common)
            if is_cell(out / name):
                copied += _add_sessions(cell, out / name)
            else:
                cell.write(out / name)
                created, copied = created + 1, copied + len(cell.sessions)
        except PisigmaError as problem:  # a fault of one robot does not stop other robots
            refused[name] = problem
    if len(refused) == len(robots):
        raise next(iter(refused.values()))
    cells = tuple(out / name for name in sorted(robots) if is_cell(out / name))
    return NewCells(cells, created, copied, {name: str(problem) for name, problem in refused.items()})


def _check_names(robots: Mapping[str, list[_Row]], source: Path) -> None:
    """Refuse ids that cannot be names of folders, or that some file systems cannot distinguish."""
    if not robots:
        raise FleetError(
            expected="a manifest (CSV) with the columns id, robot and data, a model folder, or a folder with one "
            "folder or one CSV file per robot",
            value=Phrase("no robot"),
            at=Place(source),
        )
    first: dict[str, str] = {}
    for name, rows in robots.items():
        if not _NAME.fullmatch(name):
            raise FleetError(expected=f"an id of {_EXPECTED_NAME}", value=name, at=rows[0][0])
        if (other := first.setdefault(name.casefold(), name)) != name:
            problem = f"the ids '{other}' and '{name}' differ in case only"
            raise FleetError(problem, value=name, at=Place(source), remedy="rename one")


def _in_manifest(path: Path, common: NewCell) -> Iterator[_Row]:
    """Yield the rows of a manifest; a row that is not valid CSV states its problem as `problem`."""
    table = read_table(path)
    for name in table.header:
        check_separators(name, table.header_place)
        if name not in COLUMNS:
            at, remedy = Place(path, table.header_line, name), choice_remedy(name, COLUMNS)
            raise FleetError("unknown column", value=name, at=at, remedy=remedy)
    required = ("id", "data") if common.robot else COLUMNS[:3]
    if missing := [name for name in required if name not in table.header]:
        at = Place(path, table.header_line, missing[0])
        raise FleetError("the column is missing", at=at, remedy="add it")
    for number, record in enumerate(table.records):
        at = Place(path, table.lines[number])
        fields = dict(zip(table.header, (field.strip() for field in record), strict=False))
        if number in table.invalid_rows:
            fields["problem"] = table.invalid_rows[number].removesuffix(".")
        elif len(record) != len(table.header):
            fields["problem"] = f"expected {len(table.header)} fields, got {len(record)}"
        if "id" not in fields:
            raise FleetError(fields["problem"], at=at)
        files = {
            key: "; ".join(
                os.fspath(path.parent / one.strip()) for one in fields[key].split(";") if one.strip()
            )
            for key in ("data", "model", "camera", "board")
            if fields.get(key)
        }
        if (robot := path.parent / fields.get("robot", "")).is_file():
            files["robot"] = os.fspath(robot)
        yield at, fields | files


def _in_folder(path: Path) -> Iterator[_Row]:
    """Yield a row for every CSV file in a folder and in its subfolders, except names that start with a dot."""
    for entry in sorted(path.iterdir()):
        if entry.name.startswith("."):
            continue
        robot = next((os.fspath(entry / one) for one in _ROBOT_FILES if (entry / one).is_file()), "")
        files = sorted(entry.glob("*.csv")) if entry.is_dir() else [entry] * (entry.suffix.lower() == ".csv")
        for file in files:
            name = entry.name if entry.is_dir() else entry.stem
            yield Place(entry), {"id": name, "robot": robot, "data": os.fspath(file)}


def _cell(rows: list[_Row], common: NewCell) -> NewCell:
    """Return the cell of some rows of a manifest.

    Raises:
        PisigmaError: a row is faulty.
    """
    for at, fields in rows:
        if "problem" in fields:
            raise FleetError(fields["problem"], at=at, remedy="write one field for every column")
        if not fields.get("data"):
            raise FleetError(
                "the field is empty", at=replace(at, column="data"), remedy="name a file of rows"
            )
        if fields.get("date") and not is_date(fields["date"]):
            place = replace(at, column="date")
            raise FleetError(
                expected=EXPECTED_DATE, value=fields["date"], at=place, remedy="correct the date"
            )
    at = rows[0][0]
    stated = {key: [one for one in dict.fromkeys(f.get(key, "") for _, f in rows) if one] for key in COLUMNS}
    for key in ("robot", *COLUMNS[4:]):
        if len(stated[key]) > 1:
            place = replace(at, column=key)
            raise FleetError(
                "the rows of one robot have different entries",
                value=stated[key][1],
                at=place,
                remedy="state the same in every row",
            )
    robot, model, options, camera, board = ((stated[key] or [""])[0] for key in ("robot", *COLUMNS[4:]))
    if not (robot or common.robot or model):
        place = replace(at, column="robot" if at.line else None)
        remedy = f"name it, add one of {', '.join(_ROBOT_FILES)} to its folder, or state a robot for all"
        raise FleetError("the robot is not stated", at=place, remedy=remedy)
    if bool(camera) != bool(board):
        place = replace(at, column="board" if camera else "camera")
        raise FleetError(
            "the columns 'camera' and 'board' belong together", at=place, remedy="fill both or neither"
        )
    parts = [part.strip() for part in options.split(";") if part.strip()]
    try:
        settings = read_assignments(parts, settings_by_key(CalibrationSettings))
        build_settings(CalibrationSettings, settings)
    except PisigmaError as problem:
        raise problem.with_place(replace(at, column="options"), FleetError) from None
    cell = replace(
        common,
        robot=robot or common.robot,
        cameras=CameraFiles(tuple(camera.split("; ")), tuple(board.split("; ")))
        if camera
        else common.cameras,
        calibrate=_NO_VALIDATION | settings,
        sessions=tuple(_sessions(rows)),
    )
    return cell_from_model(Path(model), cell) if model else cell


def _sessions(rows: list[_Row]) -> Iterator[tuple[str, Path]]:
    """Yield names and files of the sessions of a robot.

    Raises:
        FleetError: a session is missing, cannot be named, appears twice, or has no date although there are several.
    """
    known: dict[str, Place] = {}
    for at, fields in rows:
        file = Path(fields["data"])
        date = fields.get("date") or date_in_name(file.stem)
        name, real = date or file.stem, os.path.realpath(file)
        try:
            file.open("rb").close()
        except OSError as problem:
            what = f"the file cannot be read: {problem.strerror}"
            raise FleetError(what, value=str(file), at=at, remedy="correct the column 'data'") from None
        if not _NAME.fullmatch(name):
            remedy = "state its date, or rename the file"
            raise FleetError(expected=f"a file name of {_EXPECTED_NAME}", value=name, at=at, remedy=remedy)
        if len(rows) > 1 and not date:
            remedy = "state it in the column 'date' or in the name of the file, such as 2026-11-22.csv"
            raise FleetError(
                "a robot with several sessions needs their dates", value=name, at=at, remedy=remedy
            )
        if name in known or real in known:
            same = "two sessions of a robot have the same file or the same date"
            raise FleetError(same, value=name, at=at, remedy="correct one")
        known |= {name: at, real: at}
        yield name, file


def _add_sessions(cell: NewCell, folder: Path) -> int:
    """Copy the sessions that a cell does not yet have; return their number."""
    present = {sha256_of(path) for path in (folder / SESSIONS).glob("*.csv")}
    new = [(name, file) for name, file in cell.sessions if sha256_of(file) not in present]
    for name, file in new:
        write_under_new_name(folder / SESSIONS, name, file.read_bytes(), ())
    return len(new)
