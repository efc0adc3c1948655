"""Position and orientation errors of measured rows under a model, and their statistics."""

from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.correction.calibrated_model import CalibratedModel
from pisigma.errors import MeasurementError
from pisigma.kinematics.forward import forward_kinematics
from pisigma.measurement.dataset import Measurements
from pisigma.se3 import rotation_vector


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """How far measured rows are from where a model expects them.

    Attributes:
        position: length of the position error of every row [m]; NaN where no position was measured or predicted.
        rotation: angle of the rotation error of every row [rad]; NaN likewise; None where no row has an orientation.
    """

    position: Float64[Tensor, " rows"]
    rotation: Float64[Tensor, " rows"] | None

    @staticmethod
    def between(measurements: Measurements, expected: Float64[Tensor, "rows 4 4"]) -> "PoseErrors":
        """Errors of measurements against expected poses T_base_tool.

        Raises:
            MeasurementError: no position was measured.
        """
        if measurements.position is None:
            raise MeasurementError(f"{measurements.source}: no positions were measured; give x, y and z.")
        position = (measurements.position - expected[:, :3, 3]).norm(dim=-1)
        if measurements.rotation is None:
            return PoseErrors(position, None)
        there = torch.isfinite(measurements.rotation).all(-1).all(-1) & torch.isfinite(expected).all(-1).all(-1)
        eye = torch.eye(3, dtype=position.dtype)
        R = torch.where(there[:, None, None], measurements.rotation @ expected[:, :3, :3].mT, eye)
        return PoseErrors(position, torch.where(there, rotation_vector(R).norm(dim=-1), torch.nan))

    def in_file_units(self) -> dict[str, float]:
        """RMS, mean, 95 % and maximum in mm and, where measured, in deg."""
        figures = {f"{name}_mm": value * 1e3 for name, value in error_statistics(self.position).items()}
        if self.rotation is not None:
            degrees = torch.rad2deg(self.rotation)
            figures |= {f"{name}_deg": value for name, value in error_statistics(degrees).items()}
        return figures


def error_statistics(errors: Float64[Tensor, " rows"]) -> dict[str, float]:
    """Root mean square, mean, 95 % quantile and maximum of error lengths; NaN rows do not count."""
    present = errors[torch.isfinite(errors)]
    if not len(present):
        raise MeasurementError("there is no row with both a measured and a predicted value; nothing can be compared.")
    return {
        "rms": float(present.square().mean().sqrt()),
        "mean": float(present.mean()),
        "p95": float(torch.quantile(present, 0.95)),
        "max": float(present.max()),
    }


def nominal_errors(model: CalibratedModel, measurements: Measurements) -> PoseErrors:
    """Errors of the model's robot without its correction (base and tool as fitted)."""
    return PoseErrors.between(measurements, forward_kinematics(model.robot, measurements.q))


def corrected_errors(model: CalibratedModel, measurements: Measurements) -> PoseErrors:
    """Errors of the model with its correction."""
    return PoseErrors.between(measurements, model.forward(measurements.q))
