"""How a training went, epoch by epoch and point by point: what the papers' figures are drawn from."""

from typing import Any

import numpy as np
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.validation.held_out.training_summary import TrainingRun

EPOCHS_SHOWN = 80
"""At most so many epochs are given, close together at the start."""

_DIGITS = 6


def report_course(run: TrainingRun) -> dict[str, Any]:
    """Energies over the epochs, and of simulated data every training point with its joint errors.

    Args:
        run: what came out.

    Returns:
        ``{"energies": {"epoch": [...], JOINT: [...]}}`` in scaled units (Jeong et al. 1998, eq. (3)), and for
        simulated data ``{"points": {"x_mm": [...], "y_mm", "z_mm", "errors": {JOINT: {"before_deg": [...],
        "after_deg"}}}}``, millimetres for prismatic joints; six digits.
    """
    energies = run.history.energies
    epochs = epochs_shown(len(energies))
    kept = energies[epochs - 1]
    curves = {name: _rounded(kept[:, place]) for place, name in enumerate(run.history.joints)}
    course: dict[str, Any] = {"energies": {"epoch": epochs.tolist(), **curves}}
    if run.held_out is not None:
        course["points"] = _points(run)
    return course


def epochs_shown(epochs: int) -> Int64[np.ndarray, " shown"]:
    """Epochs, counted from 1, spread evenly on a logarithmic axis; the first and the last are among them."""
    if epochs == 0:
        return np.zeros(0, dtype=np.int64)
    return np.unique(np.geomspace(1, epochs, EPOCHS_SHOWN).round().astype(np.int64))


def _points(run: TrainingRun) -> dict[str, Any]:
    robot, errors = run.model.robot, run.training
    points: dict[str, Any] = {
        f"{axis}_mm": _rounded(errors.T[:, place, 3] * 1e3) for place, axis in enumerate("xyz")
    }
    points["errors"] = {}
    for index, joint in enumerate(robot.joints):
        if joint.name in run.history.joints:
            unit, factor = ("deg", float(np.rad2deg(1.0))) if robot.revolute[index] else ("mm", 1e3)
            points["errors"][joint.name] = {
                f"before_{unit}": _rounded(errors.before[:, index] * factor),
                f"after_{unit}": _rounded(errors.after[:, index] * factor),
            }
    return points


def _rounded(values: Float64[Tensor, " values"]) -> list[float]:
    return [float(f"{value:.{_DIGITS}g}") for value in values.tolist()]
