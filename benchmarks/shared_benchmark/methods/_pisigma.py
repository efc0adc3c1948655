"""What the methods of pisigma share."""

from collections.abc import Callable

import torch
from torch import Tensor

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.measurement.dataset import Measurements
from shared_benchmark.public_series import to_measurements
from shared_benchmark.rows import Predict, Prediction, Rows, Task
from shared_benchmark.series import series_of


def calibrator_and_rows(task: Task) -> tuple[GeometricCalibrator, Measurements]:
    """Return pisigma's geometric calibrator with its defaults, and the rows to fit."""
    arm = series_of(task.series).arm
    return GeometricCalibrator(arm, socket_distances=task.distances), to_measurements(task.train)


def predict_with(
    poses: Callable[[Measurements], Tensor],
    deviation: Callable[[Measurements], Tensor],
    noise: dict[str, float],
) -> Predict:
    """Return the function that predicts poses, and standard deviations with the noise of the sensor.

    Args:
        poses: function that predicts poses.
        deviation: function that predicts standard deviations of positions without noise [m].
        noise: estimated noise of a coordinate per sensor [m or rad].
    """

    def predict(rows: Rows) -> Prediction:
        others = to_measurements(rows)
        if "position" not in noise:
            return Prediction(poses(others).numpy())
        sigma = (deviation(others).square() + noise["position"] ** 2).sqrt()
        with torch.no_grad():
            return Prediction(poses(others).numpy(), sigma.numpy())

    return predict
