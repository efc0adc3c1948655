"""A cell with two models of the repository, of which either can be put into use."""

import shutil
from pathlib import Path

from testing.models import REPOSITORY

from pisigma.files.model_files import model_hash
from pisigma.lifetime.cell.history import InUse, ModelEntry, now
from pisigma.workflow.cell.cell import Cell

FIRST, SECOND = "kiro4", "kiro3"


def cell_of_two_models(folder: Path) -> Cell:
    """Create a cell in which `FIRST` is in use."""
    cell = Cell.create(folder, "ur10")
    for name in (FIRST, SECOND):
        path = cell.folder / "models" / name
        shutil.copytree(REPOSITORY / "models" / name, path)
        cell.history.add(ModelEntry(name, model_hash(path), now(), "", "2026-01-10"))
    put_into_use(cell, FIRST)
    return cell


def put_into_use(cell: Cell, model: str) -> None:
    """Put a model into use as another process does."""
    cell.history.add(InUse(model, now(), "a test"))
