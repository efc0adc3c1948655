"""What a hybrid calibration comes to."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.geometric.outliers import Outlier
from pisigma.calibration.geometric.prediction import predicted_poses
from pisigma.calibration.geometric.problem.setup import IdentifiedGeometry
from pisigma.calibration.geometric.result import CalibrationResult
from pisigma.calibration.hybrid.arm import HybridArm, JointCoverage
from pisigma.calibration.hybrid.search import Trial
from pisigma.calibration.hybrid.uncertainty import PositionUncertainty
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.registry import measured_errors


@dataclass(frozen=True, eq=False)
class LearnedPart:
    """A joint correction and the geometry that was fitted together with it.

    Attributes:
        geometry: differs from that of the geometric calibration, which has to make up for the correction.
        correction: Δ.
        coverage: joint values that were measured; beyond them the correction is an extrapolation.
        noise: per sensor, its standard deviation [m or rad], or a factor where the rows state it.
        unknowns: number of parameters and weights.
        effective: how many of them the data determine (the rest the prior holds).
        rounds: linearisations made.
        outliers: rows that counted for less than half, the worst first.
    """

    geometry: IdentifiedGeometry
    correction: JointCorrection
    coverage: JointCoverage
    noise: dict[str, float]
    unknowns: int
    effective: float
    rounds: int
    outliers: tuple[Outlier, ...] = ()


@dataclass(frozen=True, eq=False)
class HybridResult:
    """A hybrid calibration: the geometric one, and what was learned beyond it.

    Attributes:
        geometric: the calibration without a correction.
        learned: the correction; None where there is nothing to learn, and then the geometric calibration holds.
        uncertainty: of predicted positions.
        trials: what was tried, in order.
        verdict: what was kept and why, in a sentence.
    """

    geometric: CalibrationResult
    learned: LearnedPart | None
    uncertainty: PositionUncertainty
    trials: tuple[Trial, ...]
    verdict: str

    @property
    def outliers(self) -> tuple[Outlier, ...]:
        """Rows that counted for less than half in the calibration that holds, the worst first."""
        return self.geometric.outliers if self.learned is None else self.learned.outliers

    def arm(self) -> HybridArm | None:
        """The arm with the correction, base of the first frame and tool of the first target; None without one."""
        if self.learned is None:
            return None
        learned = self.learned
        return HybridArm(learned.geometry.robot, learned.correction, learned.coverage)

    def predicted_poses(self, measurements: Measurements) -> Float64[Tensor, "rows 4 4"]:
        """Where the targets were, each in the frame of its row.

        Raises:
            IdentificationError: a row has a frame or a target that was not calibrated.
            PoseError: the joint values do not fit the robot.
        """
        if self.learned is None:
            return self.geometric.predicted_poses(measurements)
        geometry = self.learned.geometry
        moved = replace(measurements, q=self._moved_joints(measurements))
        return predicted_poses(geometry.robot, geometry.bases, geometry.tools, moved)

    def errors_of(self, measurements: Measurements) -> dict[str, Float64[Tensor, "rows components"]]:
        """Measured - predicted of any measurements; see `CalibrationResult.errors_of`."""
        if self.learned is None:
            return self.geometric.errors_of(measurements)
        T = self.predicted_poses(measurements)
        return measured_errors(T, measurements, self.learned.geometry.unknowns)

    def deviation(self, measurements: Measurements) -> Float64[Tensor, "rows 3"]:
        """Standard deviation of the predicted positions along the axes of the row's frame [m], without noise.

        It is that of the posterior, at measured joint values and beyond them.

        Raises:
            IdentificationError: nothing was measured in metres.
        """
        return self.uncertainty.deviation(measurements, self._moved_joints(measurements))

    def _moved_joints(self, measurements: Measurements) -> Float64[Tensor, "rows dof"]:
        """Joint values of measured rows with their corrections [rad or m]."""
        if self.learned is None:
            return measurements.q
        with torch.no_grad():
            return measurements.q + self.learned.correction.of_rows(measurements)
