"""Errors of measured poses under a model, statistics of these errors, and errors that a calibration predicts."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.calibration.geometric.result import CalibrationResult
from pisigma.calibration.hybrid.result import HybridResult
from pisigma.calibration.hybrid.uncertainty import PositionUncertainty
from pisigma.estimation.covariance_root import CovarianceRoot
from pisigma.files.errors import MeasurementError, Phrase, Place
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.corner import relative_position_sigmas
from pisigma.measurement.sensors.intrinsics import NOISE_COLUMN
from pisigma.model.calibrated_model import CalibratedModel, nominal_poses_of_rows, poses_of_rows
from pisigma.robot.se3 import rotation_vector
from pisigma.validation.held_out.validation_figures import ErrorFigures

WITHIN = 1.96
"""Half the width of a 95 % interval of a normal distribution [standard deviations]."""
_OTHER_POSES = 5
"""Poses per row at which a calibration predicts its errors; their joint values are those of the rows, permuted."""


@dataclass(frozen=True, eq=False)
class ErrorVectors:
    """Pose errors of rows, measured minus predicted.

    Attributes:
        position: position errors along the axes of the row's frame [m]; NaN where nothing was measured or predicted.
        rotation: rotation vectors of `R_measured R_predicted^T` about these axes [rad]; NaN where nothing was measured
            or predicted; None if no row has an orientation.
    """

    position: Float64[Tensor, "rows 3"]
    rotation: Float64[Tensor, "rows 3"] | None

    @staticmethod
    def from_prediction(measurements: Measurements, expected: Float64[Tensor, "rows 4 4"]) -> "ErrorVectors":
        """Compute the errors of measurements relative to predicted poses T_base_tool.

        Raises:
            MeasurementError: no position was measured.
        """
        if measurements.position is None:
            raise _no_positions(measurements)
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
    def to_pose_errors(self) -> "PoseErrors":
        """Lengths and angles of the errors."""
        return PoseErrors(
            self.position.norm(dim=-1), None if self.rotation is None else self.rotation.norm(dim=-1)
        )


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Lengths and angles of the pose errors of rows.

    Attributes:
        position: length of the position error of every row [m]; NaN where nothing was measured or predicted.
        rotation: angle of the rotation error of every row [rad]; NaN where nothing was measured or predicted; None if
            no row has an orientation.
    """

    position: Float64[Tensor, " rows"]
    rotation: Float64[Tensor, " rows"] | None

    @staticmethod
    def from_prediction(measurements: Measurements, expected: Float64[Tensor, "rows 4 4"]) -> "PoseErrors":
        """Compute the errors of measurements relative to predicted poses; see `ErrorVectors.from_prediction`."""
        return ErrorVectors.from_prediction(measurements, expected).to_pose_errors

    @staticmethod
    def all_nan(rows: int, with_orientation: bool) -> "PoseErrors":
        """Make errors that are all NaN, with orientations or without."""
        nothing = torch.full((rows,), torch.nan, dtype=torch.float64)
        return PoseErrors(nothing, nothing.clone() if with_orientation else None)

    def set_rows(self, rows: Int64[Tensor, " some"], errors: "PoseErrors") -> None:
        """Set the errors of some rows in place; rotations are set only if both objects have them."""
        self.position[rows] = errors.position
        if self.rotation is not None and errors.rotation is not None:
            self.rotation[rows] = errors.rotation

    @staticmethod
    def concatenate(several: Sequence["PoseErrors"]) -> "PoseErrors":
        """Concatenate errors, all of which, or none of which, have orientations."""
        rotations = [errors.rotation for errors in several if errors.rotation is not None]
        return PoseErrors(
            torch.cat([errors.position for errors in several]), torch.cat(rotations) if rotations else None
        )

    def mask_other_rows(self, rows: Bool[Tensor, " rows"]) -> "PoseErrors":
        """Set the errors of all other rows to NaN."""
        position = torch.where(rows, self.position, torch.nan)
        return PoseErrors(
            position, None if self.rotation is None else torch.where(rows, self.rotation, torch.nan)
        )

    @property
    def figures(self) -> ErrorFigures:
        """RMS, mean, 95 % quantile and maximum in mm and, if measured, in deg."""
        figures = {f"{name}_mm": value * 1e3 for name, value in error_statistics(self.position).items()}
        if self.rotation is not None:
            degrees = torch.rad2deg(self.rotation)
            figures |= {f"{name}_deg": value for name, value in error_statistics(degrees).items()}
        return ErrorFigures(**figures)


def error_statistics(errors: Float64[Tensor, " rows"]) -> dict[str, float]:
    """Compute RMS, mean, 95 % quantile and maximum of error lengths, ignoring NaN.

    Raises:
        MeasurementError: all errors are NaN.
    """
    present = errors[torch.isfinite(errors)]
    if not len(present):
        raise MeasurementError(
            expected="a row with both a measured and a predicted value",
            value=Phrase("none"),
            remedy="give other rows",
        )
    return {
        "rms": float(present.square().mean().sqrt()),
        "mean": float(present.mean()),
        "p95": float(torch.quantile(present, 0.95)),
        "max": float(present.max()),
    }


def axis_statistics(errors: Float64[Tensor, " rows"]) -> dict[str, float]:
    """Compute the mean of signed errors (bias) and RMS, 95 % quantile and maximum of their sizes, ignoring NaN."""
    sizes = error_statistics(errors.abs())
    return {**sizes, "mean": float(errors[torch.isfinite(errors)].mean())}


def _no_positions(measurements: Measurements) -> MeasurementError:
    """Make the error for rows without positions."""
    kinds = " and ".join(sorted(measurements.kinds - {"rotation"}))
    return MeasurementError(
        expected="positions",
        value=Phrase(kinds or "none"),
        at=Place(measurements.source),
        remedy="give x, y and z, use `pisigma evaluate` or `pisigma verify`, which accept such rows, or hold rows out "
        "with `pisigma calibrate --set hold_out=0.2`"
        if kinds
        else "give x, y and z",
    )


@dataclass(frozen=True, eq=False)
class Comparison:
    """Errors of the same rows with and without the correction of a model.

    Attributes:
        nominal: errors without the correction (base and tool as fitted).
        corrected: errors with it; NaN in the same rows.
        rows_not_predicted: number of rows that are left out of both because the model has no prediction for them.
    """

    nominal: PoseErrors
    corrected: PoseErrors
    rows_not_predicted: int

    @staticmethod
    def from_errors(nominal: PoseErrors, corrected: PoseErrors) -> "Comparison":
        """Compare the errors on the rows for which both are available."""
        both = ~(torch.isfinite(nominal.position) & torch.isnan(corrected.position))
        return Comparison(nominal.mask_other_rows(both), corrected, int((~both).sum()))


def compare_with_nominal(model: CalibratedModel, measurements: Measurements) -> Comparison:
    """Compare a model with and without its correction on measurements.

    Raises:
        MeasurementError: there are no positions, or the model does not have a frame or target.
    """
    nominal, corrected = (
        PoseErrors.from_prediction(measurements, poses(model, measurements))
        for poses in (nominal_poses_of_rows, poses_of_rows)
    )
    return Comparison.from_errors(nominal, corrected)


@dataclass(frozen=True, eq=False)
class ErrorsWithPredictedSigma:
    """Position errors and their predicted standard deviations.

    Attributes:
        error: measured minus predicted position along the axes of the row's frame [m]; NaN if a row has no position or
            was not evaluated.
        sigma: predicted standard deviation of the error, including measurement noise [m]; NaN in the same rows.
    """

    error: Float64[Tensor, "rows 3"]
    sigma: Float64[Tensor, "rows 3"]

    @staticmethod
    def all_nan(rows: int) -> "ErrorsWithPredictedSigma":
        """Make a spread that is all NaN."""
        nothing = torch.full((rows, 3), torch.nan, dtype=torch.float64)
        return ErrorsWithPredictedSigma(nothing, nothing.clone())

    @staticmethod
    def concatenate(spreads: Sequence["ErrorsWithPredictedSigma"]) -> "ErrorsWithPredictedSigma":
        """Concatenate spreads."""
        return ErrorsWithPredictedSigma(
            torch.cat([spread.error for spread in spreads]), torch.cat([spread.sigma for spread in spreads])
        )

    @property
    def value_count(self) -> int:
        """Number of coordinates with an error and a predicted standard deviation."""
        return int(self._judged.sum())

    @property
    def coverage(self) -> float:
        """Share of coordinates whose error is within 1.96 standard deviations; ideally 0.95."""
        inside = self.error.abs() <= WITHIN * self.sigma
        return float(inside[self._judged].double().mean())

    def in_file_units(self) -> dict[str, float]:
        """Return the coverage and the RMS predicted position error [mm]; empty if there are no rows."""
        if not self.value_count:
            return {}
        rows = self._judged.all(-1)
        sigma = float(self.sigma[rows].square().sum(-1).mean().sqrt()) * 1e3
        return {"coverage": self.coverage, "predicted_rms_mm": sigma}

    @property
    def _judged(self) -> Tensor:
        return torch.isfinite(self.error) & torch.isfinite(self.sigma)


def errors_with_predicted_sigma(result: HybridResult, measurements: Measurements) -> ErrorsWithPredictedSigma:
    """Compute position errors under a hybrid calibration and their predicted standard deviations.

    The measurement noise is that estimated from the residuals of the calibration. If the rows of the calibration stated
    standard deviations, it is the stated one of each row times the estimated factor; rows that state none are exact.

    Raises:
        IdentificationError: a row has a target that was not calibrated.
    """
    spread = ErrorsWithPredictedSigma.all_nan(measurements.rows)
    errors = result.errors_of(measurements).get("position")
    if measurements.position is None or errors is None:
        return spread
    frames = result.uncertainty.space.frames
    rows = torch.isfinite(measurements.position).all(-1)
    rows &= torch.tensor([name in frames for name in measurements.frame], dtype=torch.bool)
    chosen = rows.nonzero()[:, 0]
    if not len(chosen):
        return spread
    judged = measurements.select(chosen)
    noise = _noise(result, judged)
    spread.error[chosen] = errors[chosen].detach().cpu()
    spread.sigma[chosen] = (result.sigma(judged).square() + noise.square()).sqrt()
    return spread


def predicted_rms_at_other_poses(
    result: CalibrationResult | HybridResult, measurements: Measurements
) -> float | None:
    """Compute the RMS position error, including noise, that a calibration predicts at other poses [m].

    Other poses have the joint values of the rows, permuted independently for every joint. The predicted errors are
    smaller at the rows themselves than at poses between them, by a factor of several for few rows.

    Args:
        result: the calibration.
        measurements: the rows of the calibration.

    Returns:
        None if it predicts no positions.
    """
    q, generator = measurements.q.detach().cpu(), torch.Generator().manual_seed(0)
    orders = torch.rand(_OTHER_POSES, *q.shape, generator=generator).argsort(1)
    every = torch.arange(measurements.rows).repeat(_OTHER_POSES)
    alone = replace(
        measurements, distance=None, pair=None, anchor=None, anchor_place=None
    )  # pairs are two rows
    others = replace(
        alone.select(every), q=q[None].take_along_dim(orders, 1).flatten(0, 1).to(measurements.q)
    )
    if isinstance(result, HybridResult):
        deviation = result.sigma(others)
    else:
        solved = result.solved
        root = CovarianceRoot(solved.covariance_root)
        known = PositionUncertainty(solved.problem.space, solved.geometry, (), root, 1.0)
        deviation = known.sigma(others)
    rms = float((deviation.square() + _noise(result, others).square()).sum(1).mean().sqrt())
    return rms if math.isfinite(rms) else None


def image_position_rms(measurements: Measurements) -> float:
    """Compute the RMS error of positions measured by single images [m]; 0 without images."""
    noise = measurements.readings.get(NOISE_COLUMN)
    if not isinstance(noise, Tensor):
        return 0.0
    by_image = relative_position_sigmas(measurements) * noise[:, None]
    return float(by_image.square().sum(1).nanmean().sqrt())


def image_remark(measurements: Measurements) -> tuple[str, ...]:
    """Write a remark on the uncertainty of positions measured by images; empty without images."""
    deviation = image_position_rms(measurements)
    if not deviation:
        return ()
    return (
        f"The position measured by an image has an uncertainty of {deviation * 1e3:.2g} mm RMS, which is included in "
        "the errors: the robot is more accurate than they indicate.",
    )


def _noise(result: CalibrationResult | HybridResult, measurements: Measurements) -> Float64[Tensor, "rows 3"]:
    """Compute the standard deviations of the measured coordinates of every row [m]."""
    deviation = torch.zeros(measurements.rows, 3, dtype=torch.float64)
    geometric, learned = (
        (result.geometric, result.learned) if isinstance(result, HybridResult) else (result, None)
    )
    for one in geometric.noise:
        sigma = one.sigma if learned is None else learned.noise[one.sensor]
        stated = measurements.sigma_position
        if one.sensor == "corner":
            solved = geometric.solved
            by_image = relative_position_sigmas(
                solved.setup.weighted_rows(measurements, solved.geometry)
            ).cpu()
            deviation = torch.where(by_image.isnan(), deviation, sigma * by_image)
        elif one.sensor == "position" and one.unit != "stated":
            deviation += sigma
        elif one.sensor == "position" and stated is not None:
            deviation += sigma * torch.nan_to_num(stated)[:, None]
    return deviation
