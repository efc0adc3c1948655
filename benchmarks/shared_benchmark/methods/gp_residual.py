"""Gaussian processes on the residuals of a fitted geometry, with scikit-learn."""

import numpy as np

from shared_benchmark.methods._residual import Correct, fit_residuals, names_of, turns, with_targets
from shared_benchmark.rows import Array, Method, Predict, Rows, Task

SIZED_ROWS = 300
"""Largest number of rows from which the sizes of the kernel are estimated; all rows are used afterwards."""


def _regression(train: Rows, residual: Array, seed: int) -> Correct:
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    names = names_of(train)
    x = with_targets(turns(train.q), train, names)
    some = np.random.default_rng(seed).permutation(len(x))[:SIZED_ROWS]
    fitted = []
    for y in residual.T:
        kernel = ConstantKernel(1.0) * RBF(np.full(x.shape[1], 3.0), (0.1, 1e3)) + WhiteKernel(
            0.1, (1e-4, 10.0)
        )
        sized = GaussianProcessRegressor(kernel, normalize_y=True, random_state=seed).fit(x[some], y[some])
        fixed = GaussianProcessRegressor(sized.kernel_, optimizer=None, normalize_y=True)
        fitted.append(fixed.fit(x, y))

    def correct(rows: Rows) -> tuple[Array, Array]:
        x = with_targets(turns(rows.q), rows, names)
        found = [one.predict(x, return_std=True) for one in fitted]
        return np.stack([mean for mean, _ in found], 1), np.stack([sigma for _, sigma in found], 1)

    return correct


def fit(task: Task) -> Predict:
    """Fit the geometry, and one process for each coordinate of the residuals."""
    return fit_residuals(task, _regression)


METHOD = Method(
    name="gp_residual",
    title="geometry, then Gaussian processes on sines and cosines of the joint values",
    source="Rasmussen and Williams 2006, Gaussian Processes for Machine Learning, with scikit-learn",
    packages=("scikit-learn", "numpy", "scipy"),
    measured=("position", "pose"),
    fit=fit,
    slow=True,
)
