"""Load corrected inverse kinematics from a model folder, or from a cell with the model that is in use there."""

import os
from pathlib import Path
from typing import Any

from pisigma.lifetime.cell.controller import checked_model_folder
from pisigma.lifetime.cell.layout import is_cell
from pisigma.lifetime.cell.model_in_use import ModelInUse
from pisigma.model.inverse.corrected_ik import CorrectedIK
from pisigma.model.inverse.corrected_ik import load as load_folder
from pisigma.model.inverse.solution import Solution


class CellIK(CorrectedIK):
    """Corrected inverse kinematics of the model in use of a cell, which takes over a change of this model.

    Every call, a path included, is answered by one model, which `Solution.model` names. Copies such as those of
    `for_task` and `under` keep their model. All other attributes are those of `present`.

    """

    def __init__(self, cell: Path) -> None:
        """Load the model in use, and look for changes in a background thread.

        Raises:
            ModelError: no model of the cell is in use, it cannot be loaded, or it must not be used with what is active
                on the controller.
        """
        self._in_use = ModelInUse(cell, "load", self._load)
        self._in_use.follow()

    def _load(self, folder: Path) -> None:
        self._loaded = load_folder(folder)

    @property
    def present(self) -> CorrectedIK:
        """Corrected inverse kinematics of the model in use.

        Raises:
            ModelError: the model must not be used with what is active on the controller.
        """
        self._in_use.findings.accepted(self._in_use.cell)
        return self._loaded

    def __call__(self, *arguments: Any, **options: Any) -> Solution:
        """See `CorrectedIK.__call__`."""
        return self.present(*arguments, **options)

    @property
    def warnings(self) -> tuple[str, ...]:  # type: ignore[override]
        """Warnings of the model, and why it must be used with care or a newer one could not be loaded."""
        return (*self._loaded.warnings, *self._in_use.warnings)

    def __getattribute__(self, name: str) -> Any:
        """Return the attributes that are not of this class from the model in use."""
        of_self = name in ("present", "warnings", "_in_use", "_load", "_loaded") or name.startswith("__")
        return object.__getattribute__(self, name) if of_self else getattr(self.present, name)


def load(folder: str | os.PathLike[str], pin: bool = False) -> CorrectedIK:
    """Load a model folder, or the model in use of a cell, as corrected inverse kinematics.

    Args:
        folder: what `pisigma calibrate`, `pisigma train` or `pisigma new` wrote.
        pin: of a cell, keep the model that is in use now; else a change is taken over between two calls.

    Raises:
        ModelError: the folder is not a complete model; the message names the file at fault; or no model of the cell is
            in use, or it must not be used with what is active on the controller.
    """
    if is_cell(folder) and not pin:
        return CellIK(Path(folder))
    path, warnings = checked_model_folder(Path(folder), "load")
    ik = load_folder(path)
    ik.warnings += warnings
    return ik
