"""Upgrade a model folder or a cell that an earlier version wrote."""

import os
from dataclasses import dataclass
from pathlib import Path

from pisigma.files.errors import ModelError
from pisigma.files.input_file import read_text
from pisigma.files.model_files import model_hash
from pisigma.files.output_file import write_atomically
from pisigma.files.yaml_file import read_yaml
from pisigma.lifetime.cell.history import HISTORY, SCHEMA_VERSION, History
from pisigma.lifetime.cell.layout import MODELS, history_of_model, is_cell
from pisigma.model.folder.upgrade import Upgrade, upgrade_folder
from pisigma.model.inverse.written_model import check_written
from pisigma.validation.held_out.arms_summary import ArmsSummary
from pisigma.workflow.arms.calibrate_arms import FRAMES_FILE


@dataclass(frozen=True)
class UpgradeResult:
    """Result of `upgrade`.

    Attributes:
        models: results of the models.
        before: version of the history's schema before the upgrade; equal to `after` if there was no history.
        after: version of the history's schema after the upgrade.
    """

    models: tuple[Upgrade, ...]
    before: int
    after: int = SCHEMA_VERSION


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
