"""What a hybrid calibration comes to."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.hybrid.arms import HybridArm, blend
from pisigma.hybrid.coverage import JointCoverage
from pisigma.hybrid.search import Trial
from pisigma.hybrid.uncertainty import PositionUncertainty
from pisigma.identification.prediction import errors_of_poses, predicted_poses
from pisigma.identification.result import CalibrationResult
from pisigma.identification.user_coordinates import IdentifiedGeometry
from pisigma.measurement.dataset import Measurements
from pisigma.network.joint_correction import JointCorrection


@dataclass(frozen=True, eq=False)
class LearnedPart:
    """A joint correction and the geometry that was fitted together with it.

    Attributes:
        geometry: differs from that of the geometric calibration, which has to make up for the correction.
        correction: Δ.
        coverage: joint values that were measured; beyond them the geometric calibration holds.
        noise: per sensor, its standard deviation [m or rad], or a factor where the rows give it.
        unknowns: number of parameters and weights.
        effective: how many of them the data tell (the rest the prior holds).
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
        return HybridArm(
            self.geometric.robot,
            self.learned.geometry.robot,
            self.learned.correction,
            self.learned.coverage,
        )

    def predicted_poses(self, measurements: Measurements) -> Float64[Tensor, "rows 4 4"]:
        """Where the targets were, each in the frame of its row.

        Raises:
            IdentificationError: a row has a frame or a target that is not known.
            PoseError: the joint values do not fit the robot.
        """
        geometric = self.geometric
        T = predicted_poses(geometric.robot, geometric.bases, geometric.tools, measurements)
        if self.learned is None:
            return T
        geometry, q = self.learned.geometry, measurements.q
        with torch.no_grad():
            moved = replace(measurements, q=q + self.learned.correction(q))
        T_learned = predicted_poses(geometry.robot, geometry.bases, geometry.tools, moved)
        return blend(T, T_learned, self.learned.coverage.share(q))

    def errors_of(self, measurements: Measurements) -> dict[str, Float64[Tensor, "rows components"]]:
        """Measured - predicted of any measurements; see `CalibrationResult.errors_of`."""
        if self.learned is None:
            return self.geometric.errors_of(measurements)
        known = self.learned.geometry
        T = self.predicted_poses(measurements)
        return errors_of_poses(T, measurements, known.sockets, known.anchors, known.zeros)

    def deviation(self, measurements: Measurements) -> Float64[Tensor, "rows 3"]:
        """Standard deviation of the predicted positions along the axes of the row's frame [m], without noise.

        Outside the measured joint values it goes over into the noise of the geometric calibration, which
        holds what that model gets wrong.

        Raises:
            IdentificationError: nothing was measured in metres.
        """
        q = measurements.q
        if self.learned is None:
            return self.uncertainty.deviation(measurements, q)
        with torch.no_grad():
            inside = self.uncertainty.deviation(measurements, q + self.learned.correction(q))
        outside = max(noise.sigma for noise in self.geometric.noise if noise.unit != "rad")
        share = self.learned.coverage.share(q)[:, None]
        return ((share * inside).square() + ((1 - share) * outside) ** 2).sqrt()
