"""Layout of the folder of a cell: its file, plans, sessions, models, exports and reports."""

import datetime
import os
import re
from pathlib import Path

from pisigma.files.errors import ModelError, Place, PlanningError
from pisigma.files.model_files import is_unchanged
from pisigma.lifetime.cell.history import HISTORY, MODEL_HISTORY, History, ModelEntry
from pisigma.measurement.dates import date_in_name

CELL_FILE = "cell.yaml"
PLANS, SESSIONS, MODELS = "plans", "sessions", "models"
EXPORTS, REPORTS = "exports", "reports"


def is_cell(path: str | os.PathLike[str]) -> bool:
    """Return whether a folder is a cell."""
    return (Path(path) / CELL_FILE).is_file()


def is_cell_of_arms(path: str | os.PathLike[str]) -> bool:
    """Return whether a folder is a cell whose file lists several arms."""
    file = Path(path) / CELL_FILE
    return file.is_file() and any(
        line.startswith("arms:") for line in file.read_text("utf-8-sig", errors="replace").splitlines()
    )


def newest_plan(path: str | os.PathLike[str]) -> Path:
    """Return the newest plan of a cell; a path that is not a cell is returned unchanged.

    Raises:
        PlanningError: the cell has no plan.
    """
    if not is_cell(path):
        return Path(path)
    plans = sorted((Path(path) / PLANS).glob("*.csv"), key=_made)
    if not plans:
        raise PlanningError("the cell has no plan", at=Place(path), remedy=f"run `pisigma plan {path}`")
    return plans[-1]


def _made(plan: Path) -> tuple[str, list[tuple[int, str]]]:
    """Return a sort key of plans: the day in the name (or else of the last change), and the numbers in the name.

    Plans made on the same day are numbered, because the times of files may be lost when a cell is copied.
    """
    changed = datetime.date.fromtimestamp(plan.stat().st_mtime).isoformat()
    parts = re.findall(r"(\d+)|(\D+)", plan.stem)
    return date_in_name(plan.stem) or changed, [(int(number or 0), text) for number, text in parts]


def previous_and_current_model(path: str | os.PathLike[str]) -> tuple[Path, Path]:
    """Return the folders of the model that was previously in use and of the model in use.

    Raises:
        ModelError: fewer than two models have been in use.
    """
    used = [one.model for one in History(Path(path) / HISTORY).model_in_use_changes() if one.model]
    earlier = [name for name in used if name != used[-1]]
    if not earlier:
        raise ModelError(
            expected="two models that have been in use",
            value=len(set(used)),
            at=Place(path),
            remedy="name two models",
        )
    return Path(path) / MODELS / earlier[-1], Path(path) / MODELS / used[-1]


def model_folder(path: str | os.PathLike[str]) -> Path:
    """Return the folder of a cell's model in use; a path that is not a cell is returned unchanged.

    Raises:
        ModelError: no model of the cell is in use, or the model was changed or removed.
    """
    if not is_cell(path):
        return Path(path)
    entry = History(Path(path) / HISTORY).in_use
    if entry is None:
        raise ModelError(
            "no model of the cell is in use",
            at=Place(path),
            remedy=f"see `pisigma status {path}` for the next step",
        )
    return checked_model(Path(path), entry)


def checked_model(cell: Path, model: ModelEntry) -> Path:
    """Return the folder of a model of a cell.

    Raises:
        ModelError: the folder was changed or removed after the model was made.
    """
    folder = cell / MODELS / model.name
    if is_unchanged(folder, model.sha256):
        return folder
    raise ModelError(
        "the model was changed or removed after it was made",
        at=Place(folder),
        remedy=f"restore the folder, or see `pisigma status {cell}` for the next step",
    )


def cell_of_model(folder: str | os.PathLike[str]) -> Path | None:
    """Return the cell of a model folder, named as the folder was named; None if the folder is outside a cell."""
    model = Path(os.path.realpath(folder))
    if model.parent.name != MODELS or not is_cell(model.parent.parent):
        return None
    named = Path(folder).parent.parent
    return named if os.path.realpath(named) == os.fspath(model.parent.parent) else model.parent.parent


def history_of_model(folder: str | os.PathLike[str]) -> History:
    """Return the history with a model's monitored sessions, in its cell or else in a file next to its folder.

    The file of a model outside a cell is `MODEL.history.sqlite`.

    Args:
        folder: folder of the model.
    """
    if (cell := cell_of_model(folder)) is not None:
        return History(cell / HISTORY)
    model = Path(os.path.realpath(folder))
    return History(model.parent / f"{model.name}{MODEL_HISTORY}")


def cells_in(folder: str | os.PathLike[str]) -> tuple[Path, ...]:
    """Return the cells in a folder, sorted by name.

    Raises:
        PlanningError: the folder contains no cell.
    """
    found = tuple(sorted(path.parent for path in Path(folder).glob(f"*/{CELL_FILE}")))
    if not found:
        raise PlanningError(
            expected=f"a cell (a folder with a {CELL_FILE}) or a folder of cells",
            value=os.fspath(folder),
            remedy="create one with `pisigma new`",
        )
    return found
