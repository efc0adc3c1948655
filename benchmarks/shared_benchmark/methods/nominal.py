"""The nominal arm with base and tool fitted."""

from shared_benchmark.methods._dh import fit_geometry, predict_with
from shared_benchmark.rows import Method, Predict, Task


def fit(task: Task) -> Predict:
    """Fit base and tools by least squares."""
    return predict_with(fit_geometry(task, arm=False))


METHOD = Method(
    name="nominal",
    title="nominal, base and tool fitted",
    source="nominal parameters of the maker",
    packages=("numpy", "scipy"),
    measured=("position", "pose", "socket"),
    fit=fit,
)
