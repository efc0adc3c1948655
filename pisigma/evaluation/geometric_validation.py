"""Geometric calibration judged on rows that it never saw."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Int64
from torch import Tensor

from pisigma.evaluation.pose_statistics import PoseErrors
from pisigma.identification.calibrator import GeometricCalibrator
from pisigma.identification.loss import SquaredLoss
from pisigma.identification.result import CalibrationResult
from pisigma.measurement.dataset import Measurements

TrainTest = tuple[Int64[Tensor, " train"], Int64[Tensor, " test"]]


@dataclass(frozen=True, eq=False)
class GeometricValidation:
    """Errors of held-out rows, each under a calibration that never saw it.

    In rows that were never held out they are NaN.

    Attributes:
        folds: how many times the rows were parted.
        nominal: the nominal arm, base and tool fitted to the training rows.
        geometric: the calibrated arm.
    """

    folds: int
    nominal: PoseErrors
    geometric: PoseErrors

    def in_file_units(self) -> dict[str, object]:
        """The figures in mm and deg; `rows` counts the held-out ones with a position."""
        return {
            "folds": self.folds,
            "rows": int(torch.isfinite(self.geometric.position).sum()),
            "nominal": self.nominal.in_file_units(),
            "geometric": self.geometric.in_file_units(),
        }


def validate_geometric(
    calibrator: GeometricCalibrator,
    measurements: Measurements,
    parts: Sequence[TrainTest],
    on_fold: Callable[[int, int], None] = lambda done, folds: None,
) -> GeometricValidation:
    """Calibrate on the training rows of every part and judge on its test rows.

    Args:
        calibrator: the calibration; "nominal" is the same with no parameter of the arm free and no row
            downweighted.
        measurements: the rows.
        parts: from `k_folds` or `holdout`.
        on_fold: called before every part with the number of parts done and of all.

    Raises:
        IdentificationError: the training rows of a part do not determine what is asked for, or a test row has
            a frame or target that its training rows lack.
    """
    nominal = torch.full((2, measurements.rows), torch.nan, dtype=torch.float64)
    geometric = nominal.clone()
    for done, (train, test) in enumerate(parts):
        on_fold(done, len(parts))
        seen, unseen = measurements.select(train), measurements.select(test)
        for chosen, store in ((_base_and_tool(calibrator), nominal), (calibrator, geometric)):
            errors = errors_under(chosen.fit(seen), unseen)
            store[0, test] = errors.position
            if errors.rotation is not None:
                store[1, test] = errors.rotation
    rotated = measurements.rotation is not None
    before, after = (PoseErrors(store[0], store[1] if rotated else None) for store in (nominal, geometric))
    return GeometricValidation(len(parts), before, after)


def judge(
    calibrator: GeometricCalibrator, result: CalibrationResult, seen: Measurements, test: Measurements
) -> GeometricValidation:
    """Judge a calibration on rows that were kept aside.

    Args:
        calibrator: what calibrated, for the "nominal" figures; see `validate_geometric`.
        result: what it gave.
        seen: the rows that it was given.
        test: other rows.

    Raises:
        IdentificationError: a test row has a frame or target that was not calibrated.
    """
    nominal = errors_under(_base_and_tool(calibrator).fit(seen), test)
    return GeometricValidation(1, nominal, errors_under(result, test))


def _base_and_tool(calibrator: GeometricCalibrator) -> GeometricCalibrator:
    """The arm as drawn; only base and tool are fitted, and every row counts in full."""
    return replace(calibrator, free=(), loss=SquaredLoss())


def errors_under(result: CalibrationResult, measurements: Measurements) -> PoseErrors:
    """Errors of any rows under a calibration, whatever sensor measured them.

    Returns:
        As "position" the length of the error of whatever length a row has: of a position or a ball in a socket the
        distance, of a touch, a wire or a pair the difference [m].

    Raises:
        IdentificationError: a row has a frame, target or anchor that was not calibrated.
    """
    lengths = torch.full((measurements.rows,), torch.nan, dtype=torch.float64)
    rotation: Tensor | None = None
    for sensor, errors in result.errors_of(measurements).items():
        size = torch.as_tensor(errors).norm(dim=-1)
        if sensor == "rotation":
            rotation = size
        else:
            lengths = torch.where(torch.isfinite(size), size, lengths)
    return PoseErrors(lengths, rotation)
