"""Predicted standard deviations of positions beside the errors that were made."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.geometric.result import CalibrationResult
from pisigma.calibration.hybrid.result import HybridResult
from pisigma.calibration.hybrid.uncertainty import PositionUncertainty
from pisigma.estimation.covariance_root import CovarianceRoot
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.corner import position_deviations
from pisigma.measurement.sensors.intrinsics import NOISE_COLUMN

WITHIN = 1.96
"""95 % of a normal value lie within so many standard deviations."""
OTHER_POSES = 5
"""Poses for every row, with the values of its joints from any rows, at which a calibration predicts its errors."""


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
