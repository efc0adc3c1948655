"""Regression of the position residuals of a geometry fitted by `_dh`, for methods that correct positions."""

from collections.abc import Callable

import numpy as np

from shared_benchmark.methods._dh import fit_geometry
from shared_benchmark.rows import Array, Predict, Prediction, Rows, Task

Correct = Callable[[Rows], tuple[Array, Array | None]]
"""Function that returns corrections of positions (rows, 3) [m] and their standard deviations or None."""


def fit_residuals(task: Task, regression: Callable[[Rows, Array, int], Correct]) -> Predict:
    """Fit the geometry, and then its residuals in the frame of the sensor.

    Args:
        task: the rows.
        regression: function that gets the rows, their residuals (rows, 3) [m] and the seed.
    """
    geometry = fit_geometry(task, arm=True)
    assert task.train.position is not None
    residual = task.train.position - geometry.poses(task.train)[:, :3, 3]
    correct = regression(task.train, residual, task.seed)

    def predict(rows: Rows) -> Prediction:
        T = geometry.poses(rows)
        shift, sigma = correct(rows)
        T[:, :3, 3] += shift
        return Prediction(T, sigma)

    return predict


def turns(q: Array) -> Array:
    """Return sines and cosines of the joint values (rows, 2 dof)."""
    return np.concatenate([np.sin(q), np.cos(q)], 1)


def with_targets(values: Array, rows: Rows, names: list[str]) -> Array:
    """Append a column for every target after the first, 1 in its rows."""
    return np.concatenate([values, *((rows.target == name)[:, None].astype(float) for name in names[1:])], 1)


def names_of(rows: Rows) -> list[str]:
    """Return the names of the targets."""
    return [str(name) for name in np.unique(rows.target)]
