"""Plain least squares on the DH parameters with scipy."""

from shared_benchmark.methods._dh import fit_geometry, predict_with
from shared_benchmark.rows import Method, Predict, Task


def fit(task: Task) -> Predict:
    """Fit base, tools and the arm by least squares, from the nominal arm."""
    return predict_with(fit_geometry(task, arm=True))


METHOD = Method(
    name="scipy_dh",
    title="scipy, least squares on DH",
    source="Hayati and Mirmirani 1985, with scipy.optimize.least_squares (trf)",
    packages=("numpy", "scipy"),
    measured=("position", "pose", "socket"),
    fit=fit,
)
