"""pisigma's default: geometry and a joint correction."""

from shared_benchmark.rows import Method, Predict, Task


def fit(task: Task) -> Predict:
    """Fit the hybrid with its defaults."""
    from pisigma.calibration.hybrid.calibrator import HybridCalibrator
    from shared_benchmark.methods._pisigma import calibrator_and_rows, predict_with

    calibrator, train = calibrator_and_rows(task)
    result = HybridCalibrator(calibrator).fit(train)
    noise = {one.sensor: one.sigma for one in result.geometric.noise}
    if result.learned is not None:
        noise = result.learned.noise
    return predict_with(result.predicted_poses, result.sigma, noise)


METHOD = Method(
    name="hybrid",
    title="pisigma, hybrid",
    source="pisigma, default of `pisigma calibrate`",
    packages=("pisigma", "torch", "numpy", "scipy"),
    measured=("position", "pose", "socket"),
    fit=fit,
)
