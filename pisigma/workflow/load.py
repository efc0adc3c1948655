"""Load corrected inverse kinematics from a model folder, or the model in use of a cell."""

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from pisigma.files.errors import PoseError
from pisigma.lifetime.cell.controller import checked_model_folder
from pisigma.lifetime.cell.layout import is_cell
from pisigma.lifetime.cell.model_in_use import ModelInUse
from pisigma.model.inverse.corrected_ik import CorrectedIK
from pisigma.model.inverse.loading import load as load_folder
from pisigma.model.inverse.solution import Solution
from pisigma.robot.kernels.array_kinematics import transform_of
from pisigma.robot.row import FRAME_COLUMNS, MAX_MAGNITUDE


class CellIK(CorrectedIK):
    """Corrected inverse kinematics of the model in use of a cell, which follows changes of this model.

    Every call, including one for a path, is answered by a single model, which `Solution.model` names. Copies, such as
    the results of `for_task` and `under`, do not change their model. All other attributes are those of the current
    model.

    """

    def __init__(self, cell: Path) -> None:
        """Load the model in use, and look for changes in a background thread.

        Raises:
            ModelError: no model of the cell is in use, the model cannot be loaded, or an export that is active on
                the controller forbids its use.
        """
        self._in_use = ModelInUse(cell, "load", self._load)
        self._in_use.follow()

    def _load(self, folder: Path) -> None:
        self._loaded = load_folder(folder)

    @property
    def current(self) -> CorrectedIK:
        """Corrected inverse kinematics of the model in use.

        Raises:
            ModelError: an export that is active on the controller forbids the use of the model.
        """
        self._in_use.findings.checked_warnings(self._in_use.cell)
        return self._loaded

    def __call__(self, *arguments: Any, **options: Any) -> Solution:
        """Solve poses with the current model; see `CorrectedIK.__call__`."""
        return self.current(*arguments, **options)

    @property
    def warnings(self) -> tuple[str, ...]:  # type: ignore[override]
        """Return warnings about the model and the controller, and the reason why a newer model could not be loaded."""
        return (*self._loaded.warnings, *self._in_use.warnings)

    def __getattribute__(self, name: str) -> Any:
        """Return attributes that this class lacks from the model in use."""
        of_self = name in ("current", "warnings", "_in_use", "_load", "_loaded") or name.startswith("__")
        return object.__getattribute__(self, name) if of_self else getattr(self.current, name)


def load(folder: str | os.PathLike[str], pin: bool = False) -> CorrectedIK:
    """Load a model folder, or the model in use of a cell, as corrected inverse kinematics.

    Args:
        folder: folder written by `pisigma calibrate`, `pisigma train` or `pisigma new`.
        pin: for a cell, whether to always use the model that is in use now; otherwise, a change takes effect between
            two calls.

    Raises:
        ModelError: the folder is not a complete model (the message names the faulty file), no model of the cell is in
            use, or an export that is active on the controller forbids its use.
    """
    if is_cell(folder) and not pin:
        return CellIK(Path(folder))
    path, warnings = checked_model_folder(Path(folder), "load")
    ik = load_folder(path)
    ik.warnings += warnings
    return ik


def pose_from_mm_and_deg(xyzrpy_mm_deg: Sequence[float]) -> Float64[np.ndarray, "1 4 4"]:
    """Return a stated pose T_base_tool as a batch `(1, 4, 4)` [m].

    Args:
        xyzrpy_mm_deg: x, y, z [mm], roll, pitch and yaw [deg] of the tool in the frame of the measurements.

    Raises:
        PoseError: a value is not valid for a pose.
    """
    for name, value in zip(FRAME_COLUMNS, xyzrpy_mm_deg, strict=True):
        if not abs(value) <= MAX_MAGNITUDE:
            raise PoseError(
                expected=f"a finite length [mm] or angle [deg] as {name} of the pose",
                value=value,
                option="--pose",
                remedy="give X Y Z ROLL PITCH YAW",
            )
    T: Float64[np.ndarray, "1 4 4"] = transform_of(
        [*(value / 1e3 for value in xyzrpy_mm_deg[:3]), *map(math.radians, xyzrpy_mm_deg[3:])]
    )[None]
    return T
