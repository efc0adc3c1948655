"""Additive splines of the joint values on the residuals of a fitted geometry, with scikit-learn."""

import numpy as np

from shared_benchmark.methods._residual import Correct, fit_residuals, names_of, with_targets
from shared_benchmark.rows import Array, Method, Predict, Rows, Task

KNOTS = 8
"""Knots of the cubic splines of a joint, at quantiles of its values."""


def _regression(train: Rows, residual: Array, seed: int) -> Correct:
    from sklearn.linear_model import RidgeCV
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import SplineTransformer, StandardScaler

    del seed  # nothing is random
    names = names_of(train)
    splines = SplineTransformer(KNOTS, knots="quantile", extrapolation="constant").fit(train.q)
    ridge = make_pipeline(StandardScaler(), RidgeCV(np.logspace(-3, 5, 17), alpha_per_target=True))
    ridge.fit(with_targets(splines.transform(train.q), train, names), residual)
    return lambda rows: (ridge.predict(with_targets(splines.transform(rows.q), rows, names)), None)


def fit(task: Task) -> Predict:
    """Fit the geometry, and splines to its residuals, with a ridge chosen by leave-one-out errors."""
    return fit_residuals(task, _regression)


METHOD = Method(
    name="spline_residual",
    title="geometry, then additive cubic splines of the joint values",
    source="Hastie and Tibshirani 1990, Generalized Additive Models, with scikit-learn",
    packages=("scikit-learn", "numpy", "scipy"),
    measured=("position", "pose"),
    fit=fit,
)
