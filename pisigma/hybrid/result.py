"""What a hybrid calibration comes to."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.hybrid.arm import HybridArm, blend
from pisigma.hybrid.coverage import JointCoverage
from pisigma.hybrid.search import Trial
from pisigma.hybrid.uncertainty import PositionUncertainty
from pisigma.identification.prediction import predicted_poses
from pisigma.identification.problem.setup import IdentifiedGeometry
from pisigma.identification.result import CalibrationResult
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.measurement.dataset import Measurements
from pisigma.sensors.registry import measured_errors


@dataclass(frozen=True, eq=False)
class LearnedPart:
    """A joint correction and the geometry that was fitted together with it.

    Attributes:
        geometry: differs from that of the geometric calibration, which has to make up for the correction.
        correction: Δ.
        coverage: joint values that were measured; beyond them the geometric calibration holds.
        noise: per sensor, its standard deviation [m or rad], or a factor where the rows state it.
        unknowns: number of parameters and weights.
        effective: how many of them the data determine (the rest the prior holds).
        rounds: linearisations made.
    """

    geometry: IdentifiedGeometry
    correction: JointCorrection
    coverage: JointCoverage
    noise: dict[str, float]
    unknowns: int
    effective: float
    rounds: int


@dataclass(frozen=True, eq=False)
class HybridResult:
    """A hybrid calibration: the geometric one, and what was learned beyond it.

    Attributes:
        geometric: the calibration without a correction.
        learned: the correction; None where there is nothing to learn, and then the geometric calibration holds.
        uncertainty: of predicted positions where joint values were measured.
        trials: what was tried, in order.
        verdict: what was kept and why, in a sentence.
    """

    geometric: CalibrationResult
    learned: LearnedPart | None
    uncertainty: PositionUncertainty
    trials: tuple[Trial, ...]
    verdict: str

    def arm(self) -> HybridArm | None:
        """The arm with the correction, base of the first frame and tool of the first target; None without one."""
        if self.learned is None:
            return None
        learned = self.learned
        return HybridArm(self.geometric.robot, learned.geometry.robot, learned.correction, learned.coverage)

    def predicted_poses(self, measurements: Measurements) -> Float64[Tensor, "rows 4 4"]:
        """Where the targets were, each in the frame of its row.

        Raises:
            IdentificationError: a row has a frame or a target that was not calibrated.
            PoseError: the joint values do not fit the robot.
        """
        geometric = self.geometric
        T = predicted_poses(geometric.robot, geometric.bases, geometric.tools, measurements)
        if self.learned is None:
            return T
        geometry, q = self.learned.geometry, measurements.q
        with torch.no_grad():
            moved = replace(measurements, q=q + self.learned.correction.of_rows(measurements))
        T_learned = predicted_poses(geometry.robot, geometry.bases, geometry.tools, moved)
        return blend(T, T_learned, self.learned.coverage.share(q))

    def errors_of(self, measurements: Measurements) -> dict[str, Float64[Tensor, "rows components"]]:
        """Measured - predicted of any measurements; see `CalibrationResult.errors_of`."""
        if self.learned is None:
            return self.geometric.errors_of(measurements)
        T = self.predicted_poses(measurements)
        return measured_errors(T, measurements, self.learned.geometry.unknowns)

    def deviation(self, measurements: Measurements) -> Float64[Tensor, "rows 3"]:
        """Standard deviation of the predicted positions along the axes of the row's frame [m], without noise.

        Outside the measured joint values it goes over into what the geometric calibration does not explain.

        Raises:
            IdentificationError: nothing was measured in metres.
        """
        q = measurements.q
        if self.learned is None:
            return self.uncertainty.deviation(measurements, q)
        with torch.no_grad():
            inside = self.uncertainty.deviation(
                measurements, q + self.learned.correction.of_rows(measurements)
            )
        outside = unexplained_length(self.geometric)
        share = self.learned.coverage.share(q)[:, None]
        return ((share * inside).square() + ((1 - share) * outside) ** 2).sqrt()


def unexplained_length(result: CalibrationResult) -> float:
    """What a geometric calibration does not explain of one coordinate of the measured lengths [m]; 0 without any.

    The estimated noise; where the rows state their own, the RMS of the residuals.
    """
    lengths = []
    for noise in result.noise:
        if noise.unit == "m":
            lengths.append(noise.sigma)
        elif noise.quantity == "m" and noise.unit == "stated":
            lengths.append(noise.rms / math.sqrt(noise.components))
    return max(lengths, default=0.0)
