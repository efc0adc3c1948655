"""Course of a training by epochs and by points, for the figures of the papers."""

from typing import Any

import numpy as np
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.validation.held_out.training_summary import TrainingRun

EPOCHS_SHOWN = 80
"""Maximum number of stored epochs, on a logarithmic scale."""

_DIGITS = 6


def report_course(run: TrainingRun) -> dict[str, Any]:
    """Return energies over the epochs and, for simulated data, every training point with its joint errors.

    Args:
        run: The training.

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
    """Return epochs, counted from 1, evenly spaced on a logarithmic axis, including the first and the last."""
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
