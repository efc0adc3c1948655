"""Errors of measured poses under a model, their statistics, and how large a calibration expected them to be."""

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
from pisigma.files.errors import MeasurementError
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.corner import position_deviations
from pisigma.measurement.sensors.intrinsics import NOISE_COLUMN
from pisigma.model.calibrated_model import CalibratedModel, nominal_poses_of_rows, poses_of_rows
from pisigma.robot.se3 import rotation_vector
from pisigma.validation.held_out.validation_figures import ErrorFigures

WITHIN = 1.96
"""95 % of a normal value lie within so many standard deviations."""
OTHER_POSES = 5
"""Poses for every row, with the values of its joints from any rows, at which a calibration predicts its errors."""


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


@dataclass(frozen=True, eq=False)
class PredictedSpread:
    """How far measured positions are from predicted ones, and how far they were expected to be.

    Attributes:
        error: measured minus predicted along the axes of the row's frame [m]; NaN where a row has no position
            or was not judged.
        sigma: predicted standard deviation of it, with the noise of the measurement [m]; NaN likewise.
    """

    error: Float64[Tensor, "rows 3"]
    sigma: Float64[Tensor, "rows 3"]

    @staticmethod
    def none(rows: int) -> "PredictedSpread":
        """Of rows that are not judged yet."""
        nothing = torch.full((rows, 3), torch.nan, dtype=torch.float64)
        return PredictedSpread(nothing, nothing.clone())

    @staticmethod
    def joined(spreads: Sequence["PredictedSpread"]) -> "PredictedSpread":
        """Rows of one after the other."""
        return PredictedSpread(
            torch.cat([spread.error for spread in spreads]), torch.cat([spread.sigma for spread in spreads])
        )

    @property
    def values(self) -> int:
        """Number of coordinates with an error and a prediction of it."""
        return int(self._judged.sum())

    @property
    def coverage(self) -> float:
        """Share of coordinates whose error is within 1.96 standard deviations; 0.95 is wanted."""
        inside = self.error.abs() <= WITHIN * self.sigma
        return float(inside[self._judged].double().mean())

    def in_file_units(self) -> dict[str, float]:
        """Coverage, and root mean square of the predicted deviation of a position [mm]; nothing without rows."""
        if not self.values:
            return {}
        rows = self._judged.all(-1)
        sigma = float(self.sigma[rows].square().sum(-1).mean().sqrt()) * 1e3
        return {"coverage": self.coverage, "predicted_rms_mm": sigma}

    @property
    def _judged(self) -> Tensor:
        return torch.isfinite(self.error) & torch.isfinite(self.sigma)


def predicted_spread(result: HybridResult, measurements: Measurements) -> PredictedSpread:
    """Errors of measured positions under a hybrid calibration, and what it predicts of them.

    The noise of the measurement is what the residuals of the calibration show, or, where its rows stated theirs, what
    these rows state times the factor that the residuals show; rows that then state none are exact.

    Raises:
        IdentificationError: a row has a target that was not calibrated.
    """
    spread = PredictedSpread.none(measurements.rows)
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
    spread.sigma[chosen] = (result.deviation(judged).square() + noise.square()).sqrt()
    return spread


def predicted_at_other_poses(
    result: CalibrationResult | HybridResult, measurements: Measurements
) -> float | None:
    """RMS of the position errors, with the noise, that a calibration predicts where it was not measured [m].

    Every joint takes the values of the rows, in an order of its own: at the rows themselves a calibration knows more
    than at any other pose between them, of few rows several times as much.

    Args:
        result: the calibration.
        measurements: the rows that it was calibrated with.

    Returns:
        None where it predicts no positions.
    """
    q, generator = measurements.q.detach().cpu(), torch.Generator().manual_seed(0)
    orders = torch.rand(OTHER_POSES, *q.shape, generator=generator).argsort(1)
    every = torch.arange(measurements.rows).repeat(OTHER_POSES)
    others = replace(
        measurements.select(every), q=q[None].take_along_dim(orders, 1).flatten(0, 1).to(measurements.q)
    )
    if isinstance(result, HybridResult):
        deviation = result.deviation(others)
    else:
        solved = result.solved
        root = CovarianceRoot(solved.root)
        known = PositionUncertainty(solved.problem.space, solved.geometry, (), root, 1.0)
        deviation = known.deviation(others, others.q)
    rms = float((deviation.square() + _noise(result, others).square()).sum(1).mean().sqrt())
    return rms if math.isfinite(rms) else None


def image_deviation(measurements: Measurements) -> float:
    """Root mean square error of the positions that images give by themselves [m]; 0 without images."""
    noise = measurements.readings.get(NOISE_COLUMN)
    if not isinstance(noise, Tensor):
        return 0.0
    by_image = position_deviations(measurements) * noise[:, None]
    return float(by_image.square().sum(1).nanmean().sqrt())


def image_remark(measurements: Measurements) -> tuple[str, ...]:
    """Say how uncertain the positions of images are by themselves; nothing where there are no images."""
    deviation = image_deviation(measurements)
    if not deviation:
        return ()
    return (
        f"The position that an image gives is itself uncertain by {deviation * 1e3:.2g} mm (RMS), which the errors "
        "contain: the robot is more accurate than they say.",
    )


def _noise(result: CalibrationResult | HybridResult, measurements: Measurements) -> Float64[Tensor, "rows 3"]:
    """Standard deviations of the measured coordinates of every row [m]."""
    deviation = torch.zeros(measurements.rows, 3, dtype=torch.float64)
    geometric, learned = (
        (result.geometric, result.learned) if isinstance(result, HybridResult) else (result, None)
    )
    for one in geometric.noise:
        sigma = one.sigma if learned is None else learned.noise[one.sensor]
        stated = measurements.sigma_position
        if one.sensor == "corner":
            by_image = position_deviations(measurements).cpu()
            deviation = torch.where(by_image.isnan(), deviation, sigma * by_image)
        elif one.sensor == "position" and one.unit != "stated":
            deviation += sigma
        elif one.sensor == "position" and stated is not None:
            deviation += sigma * torch.nan_to_num(stated)[:, None]
    return deviation
