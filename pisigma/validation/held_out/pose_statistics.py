"""Errors of measured poses under a model, and their statistics."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.files.errors import MeasurementError
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel, nominal_poses_of_rows, poses_of_rows
from pisigma.robot.se3 import rotation_vector
from pisigma.validation.held_out.validation_figures import ErrorFigures


@dataclass(frozen=True, eq=False)
class ErrorVectors:
    """How measured rows are off from where a model expects them, measured minus expected.

    Attributes:
        position: along the axes of the row's frame [m]; NaN where no position was measured or predicted.
        rotation: rotation vector of `R_measured R_expected^T` about these axes [rad]; NaN likewise; None where no row
            has an orientation.
    """

    position: Float64[Tensor, "rows 3"]
    rotation: Float64[Tensor, "rows 3"] | None

    @staticmethod
    def between(measurements: Measurements, expected: Float64[Tensor, "rows 4 4"]) -> "ErrorVectors":
        """Errors of measurements against expected poses T_base_tool.

        Raises:
            MeasurementError: no position was measured.
        """
        if measurements.position is None:
            raise MeasurementError(f"{measurements.source}: {_no_positions(measurements)}")
        position = measurements.position - expected[:, :3, 3]
        if measurements.rotation is None:
            return ErrorVectors(position, None)
        there = torch.isfinite(measurements.rotation).all(-1).all(-1) & torch.isfinite(expected).all(-1).all(
            -1
        )
        eye = torch.eye(3, dtype=position.dtype)
        R = torch.where(there[:, None, None], measurements.rotation @ expected[:, :3, :3].mT, eye)
        return ErrorVectors(position, torch.where(there[:, None], rotation_vector(R), torch.nan))

    @property
    def sizes(self) -> "PoseErrors":
        """Lengths and angles of the errors."""
        return PoseErrors(
            self.position.norm(dim=-1), None if self.rotation is None else self.rotation.norm(dim=-1)
        )


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """How far measured rows are from where a model expects them.

    Attributes:
        position: length of the position error of every row [m]; NaN where no position was measured or
            predicted.
        rotation: angle of the rotation error of every row [rad]; NaN likewise; None where no row has an
            orientation.
    """

    position: Float64[Tensor, " rows"]
    rotation: Float64[Tensor, " rows"] | None

    @staticmethod
    def between(measurements: Measurements, expected: Float64[Tensor, "rows 4 4"]) -> "PoseErrors":
        """Errors of measurements against expected poses; see `ErrorVectors.between`."""
        return ErrorVectors.between(measurements, expected).sizes

    @staticmethod
    def none(rows: int, turned: bool) -> "PoseErrors":
        """Errors of rows that are not judged yet, with orientations or without."""
        nothing = torch.full((rows,), torch.nan, dtype=torch.float64)
        return PoseErrors(nothing, nothing.clone() if turned else None)

    def put(self, rows: Int64[Tensor, " some"], errors: "PoseErrors") -> None:
        """Write the errors of some rows, as far as both have orientations."""
        self.position[rows] = errors.position
        if self.rotation is not None and errors.rotation is not None:
            self.rotation[rows] = errors.rotation

    @staticmethod
    def joined(several: Sequence["PoseErrors"]) -> "PoseErrors":
        """Join errors one after the other; all have orientations or none has."""
        rotations = [errors.rotation for errors in several if errors.rotation is not None]
        return PoseErrors(
            torch.cat([errors.position for errors in several]), torch.cat(rotations) if rotations else None
        )

    def only(self, rows: Bool[Tensor, " rows"]) -> "PoseErrors":
        """The errors of some rows; NaN in all others."""
        position = torch.where(rows, self.position, torch.nan)
        return PoseErrors(
            position, None if self.rotation is None else torch.where(rows, self.rotation, torch.nan)
        )

    @property
    def figures(self) -> ErrorFigures:
        """RMS, mean, 95 % and maximum in mm and, where measured, in deg."""
        figures = {f"{name}_mm": value * 1e3 for name, value in error_statistics(self.position).items()}
        if self.rotation is not None:
            degrees = torch.rad2deg(self.rotation)
            figures |= {f"{name}_deg": value for name, value in error_statistics(degrees).items()}
        return ErrorFigures(**figures)


def error_statistics(errors: Float64[Tensor, " rows"]) -> dict[str, float]:
    """Root mean square, mean, 95 % quantile and maximum of error lengths; NaN rows do not count."""
    present = errors[torch.isfinite(errors)]
    if not len(present):
        raise MeasurementError(
            "there is no row with both a measured and a predicted value; nothing can be compared."
        )
    return {
        "rms": float(present.square().mean().sqrt()),
        "mean": float(present.mean()),
        "p95": float(torch.quantile(present, 0.95)),
        "max": float(present.max()),
    }


def axis_statistics(errors: Float64[Tensor, " rows"]) -> dict[str, float]:
    """Mean of signed errors, which is their bias, and RMS, 95 % quantile and maximum of their sizes; without NaN."""
    sizes = error_statistics(errors.abs())
    return {**sizes, "mean": float(errors[torch.isfinite(errors)].mean())}


def _no_positions(measurements: Measurements) -> str:
    """What is missing in rows without positions."""
    kinds = measurements.kinds - {"rotation"}
    if not kinds:
        return "no positions were measured; give x, y and z."
    return (
        f"no positions were measured, but {' and '.join(sorted(kinds))} values, which `pisigma evaluate` and "
        "`pisigma verify` judge; give x, y and z, or hold rows out with `pisigma calibrate --hold-out`."
    )


@dataclass(frozen=True, eq=False)
class Comparison:
    """A model with and without its correction, on the same rows.

    Attributes:
        nominal: errors of the model's robot without its correction (base and tool as fitted).
        corrected: errors with it; NaN in the same rows.
        not_predicted: rows that are left out of both, because the model predicts nothing there.
    """

    nominal: PoseErrors
    corrected: PoseErrors
    not_predicted: int

    @staticmethod
    def of(nominal: PoseErrors, corrected: PoseErrors) -> "Comparison":
        """Compare on the rows that both have."""
        both = ~(torch.isfinite(nominal.position) & torch.isnan(corrected.position))
        return Comparison(nominal.only(both), corrected, int((~both).sum()))


def compare_on(model: CalibratedModel, measurements: Measurements) -> Comparison:
    """Compare a model with and without its correction on measurements.

    Raises:
        MeasurementError: no positions were measured, or in a frame or of a target that the model does not know.
    """
    nominal, corrected = (
        PoseErrors.between(measurements, poses(model, measurements))
        for poses in (nominal_poses_of_rows, poses_of_rows)
    )
    return Comparison.of(nominal, corrected)
