"""Cells from elsewhere: packing into a ZIP file, unpacking, and upgrades of what an earlier version wrote.

Unpacking refuses links and paths that lead out of the folder.
"""

import os
import stat
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from pisigma.files.errors import ModelError, OutputError, Phrase, Place, PlanningError
from pisigma.files.input_file import read_text
from pisigma.files.model_files import model_hash
from pisigma.files.output_file import check_output, write_atomically
from pisigma.files.scratch import FILE, FOLDER, scratch_beside
from pisigma.files.yaml_file import read_yaml
from pisigma.lifetime.cell.history import HISTORY, SCHEMA_VERSION, History
from pisigma.lifetime.cell.layout import CELL_FILE, MODELS, history_of_model, is_cell
from pisigma.model.folder.upgrade import Upgrade, upgrade_folder
from pisigma.model.inverse.written_model import check_written
from pisigma.validation.held_out.arms_summary import ArmsSummary
from pisigma.workflow.arms.calibrate_arms import FRAMES_FILE
from pisigma.workflow.cell.cell import Cell

MAX_BYTES = 2 * 10**9
"""Largest total size of the files of a cell [bytes]."""
_CHUNK = 2**20


def pack(cell: Cell, path: str | os.PathLike[str]) -> int:
    """Write all files of a cell into a ZIP file, completely or not at all.

    Args:
        cell: the cell; the files of its sessions must be unchanged.
        path: the ZIP file to write.

    Returns:
        The number of files.

    Raises:
        MeasurementError: a session was changed or removed.
        OutputError: the file cannot be written, or the cell contains a link or more than 2 GB.
    """
    target = Path(path)
    check_output(target, (".zip",), "a packed cell", (cell.folder,))
    for session in cell.history.sessions():
        if not session.set_aside:
            cell.sessions.checked_path(session)
    journal = cell.history.path.with_name(f"{cell.history.path.name}-journal")
    files = sorted(
        one for one in cell.folder.rglob("*") if (not one.is_dir() or one.is_symlink()) and one != journal
    )
    for one in files:
        if one.is_symlink() or not one.is_file():
            raise OutputError(
                expected="regular files in the cell", value=Phrase("a link or a device"), at=Place(one)
            )
    if (size := sum(one.stat().st_size for one in files)) > MAX_BYTES:
        raise OutputError(
            expected=f"files of at most {MAX_BYTES:,} bytes in total", value=size, at=Place(cell.folder)
        )
    try:
        with scratch_beside(target, FILE) as scratch, scratch_beside(target, FILE) as history:
            if cell.history.path in files:
                cell.history.database.copy(history)  # copied completely, even if another process writes
            with zipfile.ZipFile(scratch, "w", zipfile.ZIP_DEFLATED) as archive:
                for one in files:
                    source = history if one == cell.history.path else one
                    archive.write(source, one.relative_to(cell.folder).as_posix())
            scratch.chmod(0o644)
            os.replace(scratch, target)
    except OSError as problem:
        raise OutputError(f"the file cannot be written: {problem.strerror}", at=Place(path)) from None
    return len(files)


def unpack(path: str | os.PathLike[str], folder: str | os.PathLike[str]) -> Cell:
    """Restore a cell from a ZIP file that `pack` wrote, completely or not at all.

    Args:
        path: the ZIP file.
        folder: folder to write; it must not exist.

    Raises:
        PlanningError: the file is not a packed cell, is damaged, or contains links, paths that lead out of the folder
            or more than 2 GB.
        OutputError: the folder already exists or cannot be written.
    """
    target = Path(folder)
    if target.exists() or target.is_symlink():
        raise OutputError("the folder already exists", at=Place(folder), remedy="choose another --out")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with zipfile.ZipFile(path) as archive, scratch_beside(target, FOLDER) as scratch:
            _check_members(archive, path)
            for member in archive.infolist():
                _extract(archive, member, scratch, path)
            Cell.open(scratch)
            scratch.chmod(0o755)
            os.replace(scratch, target)
    except (zipfile.BadZipFile, zlib.error, RuntimeError, EOFError) as problem:  # damaged or encrypted
        raise PlanningError(f"the file is not a packed cell: {problem}", at=Place(path)) from None
    except FileNotFoundError:
        raise PlanningError("there is no such file", at=Place(path)) from None
    except OSError as problem:
        raise OutputError(f"the cell cannot be written: {problem.strerror}", at=Place(folder)) from None
    return Cell.open(target)


def _check_members(archive: zipfile.ZipFile, path: str | os.PathLike[str]) -> None:
    """Refuse an archive that is not a packed cell, or that would write outside its folder."""
    members = archive.infolist()
    names = [one.filename for one in members]

    def check(is_met: bool, expected: str, value: object) -> None:
        if not is_met:
            raise PlanningError(expected=expected, value=value, at=Place(path))

    check(CELL_FILE in names, f"a packed cell with its {CELL_FILE}", "another archive")
    distinct = len({name.casefold() for name in names}) == len(names)
    check(distinct, "a different name for every file", "a name that appears twice")
    for one in members:
        inside, mode = PurePosixPath(one.filename), one.external_attr >> 16
        deflated = one.compress_type in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
        check(deflated, "deflated files", one.filename)
        leads_out = inside.is_absolute() or ".." in inside.parts or {"\\", ":"} & {*one.filename}
        is_regular = not mode or stat.S_ISREG(mode) or stat.S_ISDIR(mode)
        check(is_regular and not leads_out, "regular files inside the cell", one.filename)
    size = sum(one.file_size for one in members)
    check(size <= MAX_BYTES, f"files of at most {MAX_BYTES:,} bytes in total", size)


def _extract(
    archive: zipfile.ZipFile, member: zipfile.ZipInfo, folder: Path, path: str | os.PathLike[str]
) -> None:
    """Extract one file of an archive; refuse a file that is longer than the archive states."""
    target = folder / member.filename
    if member.is_dir():
        target.mkdir(parents=True, exist_ok=True)
        return
    target.parent.mkdir(parents=True, exist_ok=True)
    left = member.file_size
    with archive.open(member) as source, target.open("wb") as file:
        while chunk := source.read(_CHUNK):
            left -= len(chunk)
            if left < 0:
                raise PlanningError(
                    expected=f"{member.file_size:,} bytes",
                    value=Phrase("more"),
                    at=Place(path, None, member.filename),
                )
            file.write(chunk)


@dataclass(frozen=True)
class UpgradeResult:
    """Result of `upgrade`.

    Attributes:
        models: results of the models.
        schema_before: version of the history's schema before the upgrade; equal to `schema_after` if there was no
            history.
        schema_after: version of the history's schema after the upgrade.
    """

    models: tuple[Upgrade, ...]
    schema_before: int
    schema_after: int = SCHEMA_VERSION


def upgrade(path: str | os.PathLike[str]) -> UpgradeResult:
    """Convert a model folder or a cell to the current formats.

    The history, and the bases of several arms, then name the upgraded models.

    Args:
        path: a model folder, whose history is also upgraded, or a cell of one or several arms, whose models are all
            upgraded.

    Raises:
        ModelError: a folder is not a model, or cannot be upgraded; see `upgrade_folder`.
        OutputError: a folder or the history cannot be written, or the history has a newer version.
    """
    cell = Path(path)
    history = History(cell / HISTORY) if is_cell(cell) else history_of_model(path)
    before = history.database.upgrade() if history.path.exists() else SCHEMA_VERSION
    folders = [cell / MODELS / one.name for one in history.models()] if is_cell(cell) else [cell]
    folders += [
        file.parent / arm.name
        for file in sorted((cell / MODELS).glob(f"*/{FRAMES_FILE}"))
        for arm in read_yaml(file, ArmsSummary, ModelError).arms
    ]
    models = []
    for folder in folders:
        sha256 = model_hash(folder)
        models.append(upgrade_folder(folder, check_written))
        if history.path.exists():
            history.replace_model_hash(sha256, model_hash(folder))
        if (frames := folder.parent / FRAMES_FILE).is_file():
            text = read_text(frames, ModelError, "YAML")
            write_atomically(frames, text.replace(sha256, model_hash(folder)))
    return UpgradeResult(tuple(models), before)
