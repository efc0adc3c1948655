"""pisigma's geometric calibration."""

from shared_benchmark.rows import Method, Predict, Task


def fit(task: Task) -> Predict:
    """Fit the geometry with its defaults."""
    from pisigma.calibration.hybrid.uncertainty import PositionUncertainty
    from pisigma.estimation.covariance_root import CovarianceRoot
    from shared_benchmark.methods._pisigma import calibrator_and_rows, predict_with

    calibrator, train = calibrator_and_rows(task)
    result = calibrator.fit(train)
    solved = result.solved
    known = PositionUncertainty(
        solved.problem.space, solved.geometry, (), CovarianceRoot(solved.covariance_root), 1.0
    )
    noise = {one.sensor: one.sigma for one in result.noise}
    return predict_with(result.predicted_poses, known.sigma, noise)


METHOD = Method(
    name="geometric",
    title="pisigma, geometric",
    source="pisigma, `pisigma calibrate --set model=geometric`",
    packages=("pisigma", "torch", "numpy", "scipy"),
    measured=("position", "pose", "socket"),
    fit=fit,
)
