"""Exports of a cell: records of exported files, and of the file that is active on the controller."""

import hashlib
import os
from dataclasses import replace
from pathlib import Path

from pisigma.deployment.export.export_format import Exported, ExportRequest
from pisigma.deployment.export.registry import export_format, export_model
from pisigma.files.errors import MeasurementError, Place
from pisigma.files.input_file import read_input
from pisigma.lifetime.cell.controller import checked_model_folder, record_controller
from pisigma.lifetime.cell.exports import ControllerEntry, ExportEntry
from pisigma.lifetime.cell.history import now
from pisigma.workflow.cell.cell import Cell

NONE = "none"
"""Word that stands for no file if no export is active on the controller."""


def export_from_cell(cell: Cell, format_name: str, request: ExportRequest) -> Exported:
    """Export the model in use of a cell, and record the file in its history.

    Args:
        cell: the cell.
        format_name: name of the format.
        request: file and options; its model is ignored.

    Raises:
        ModelError: no model is in use, or an export that is already active on the controller would be applied as well.
        PisigmaError: see `export_model`.
    """
    contains = export_format(format_name).contents_for(request)
    folder, warnings = checked_model_folder(cell.folder, f"export {contains}")
    exported = export_model(format_name, replace(request, model=folder))
    cell.history.add(
        ExportEntry(request.out.name, _sha256(request.out), format_name, contains, folder.name, now())
    )
    return replace(exported, warnings=(*warnings, *exported.warnings))


def record_active_export(
    cell: Cell, file: str | os.PathLike[str], day: str = "", note: str = ""
) -> ControllerEntry:
    """Record which exported file is active on the controller; see `record_controller`.

    Args:
        cell: the cell.
        file: unchanged file of `export_from_cell`; "none" if no export is active from this day.
        day: day from which the export is active (ISO 8601); "" for today.
        note: free text.
    """
    if os.fspath(file) == NONE:
        return record_controller(cell.history, "", day, note)
    if not Path(file).is_file():
        raise MeasurementError("there is no such file", at=Place(file), option="--export")
    return record_controller(cell.history, _sha256(Path(file)), day, note)


def _sha256(path: Path) -> str:
    """Return the SHA-256 of a file, or of all files in a folder."""
    if not path.is_dir():
        return hashlib.sha256(read_input(path, MeasurementError)).hexdigest()
    files = sorted(one for one in path.iterdir() if one.is_file())
    return hashlib.sha256("".join(f"{one.name} {_sha256(one)}\n" for one in files).encode()).hexdigest()
