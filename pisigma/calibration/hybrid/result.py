"""Result of a hybrid calibration."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.geometric.outliers import Outlier
from pisigma.calibration.geometric.parameter_table import ParameterEstimate
from pisigma.calibration.geometric.posterior import ParameterPosterior
from pisigma.calibration.geometric.prediction import predicted_poses
from pisigma.calibration.geometric.problem.setup import IdentifiedGeometry
from pisigma.calibration.geometric.result import CalibrationResult
from pisigma.calibration.hybrid.arm import HybridArm, JointCoverage
from pisigma.calibration.hybrid.search import Trial
from pisigma.calibration.hybrid.uncertainty import PositionUncertainty
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.registry import measured_errors
from pisigma.robot.se3 import wrap_to_pi


@dataclass(frozen=True, eq=False)
class LearnedPart:
    """A joint correction and the geometry that was fitted together with it.

    Attributes:
        geometry: geometry fitted together with the correction, which differs from the geometry of the geometric
            calibration.
        correction: the joint correction Δ.
        coverage: measured ranges of joint values; outside them the correction is an extrapolation.
        noise: standard deviation per sensor [m or rad], or a factor on the standard deviations that the rows state.
        unknowns: number of parameters and weights.
        effective_unknowns: effective number of parameters and weights that the data determine; the prior determines
            the others.
        rounds: number of linearisations.
        outliers: rows with less than half of the full weight, worst first.
    """

    geometry: IdentifiedGeometry
    correction: JointCorrection
    coverage: JointCoverage
    noise: dict[str, float]
    unknowns: int
    effective_unknowns: float
    rounds: int
    outliers: tuple[Outlier, ...] = ()


@dataclass(frozen=True, eq=False)
class HybridResult:
    """A hybrid calibration: a geometric calibration and a learned joint correction.

    Attributes:
        geometric: the calibration without a correction.
        learned: the correction; None without a correction, so that the geometric calibration is the result.
        uncertainty: uncertainty of predicted positions.
        trials: the trials of features, in order.
        verdict: sentence on the chosen features, with the reason.
    """

    geometric: CalibrationResult
    learned: LearnedPart | None
    uncertainty: PositionUncertainty
    trials: tuple[Trial, ...]
    verdict: str

    @property
    def outliers(self) -> tuple[Outlier, ...]:
        """Rows with less than half of the full weight in the resulting calibration, worst first."""
        return self.geometric.outliers if self.learned is None else self.learned.outliers

    @property
    def parameters(self) -> tuple[ParameterEstimate, ...]:
        """All parameters of the geometric calibration, with standard errors that include its bias.

        What only a correction describes, such as errors of gears, biases the geometric calibration. The standard error
        is therefore at least the root mean square of its difference from the hybrid's posterior.
        """
        estimates, learned = self.geometric.parameters, self.learned
        if learned is None:
            return estimates
        known = self.uncertainty
        posterior = ParameterPosterior.from_geometry(known.space, learned.geometry, known.dense_root)
        bias = torch.tensor([one.estimated for one in estimates], dtype=torch.float64) - posterior.mean
        angle = torch.tensor([one.unit == "rad" for one in estimates])
        errors = torch.where(angle, wrap_to_pi(bias), bias).hypot(posterior.standard_errors).tolist()
        return tuple(
            replace(one, standard_error=max(one.standard_error, error))  # NaN remains NaN
            for one, error in zip(estimates, errors, strict=True)
        )

    def arm(self) -> HybridArm | None:
        """Return the corrected arm with the first base and the first tool; None without a correction."""
        if self.learned is None:
            return None
        learned = self.learned
        return HybridArm(learned.geometry.robot, learned.correction, learned.coverage)

    def predicted_poses(self, measurements: Measurements) -> Float64[Tensor, "rows 4 4"]:
        """Return predicted poses of the targets, each in the frame of its row.

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
        """Compute measured minus predicted values of measurements; see `CalibrationResult.errors_of`."""
        if self.learned is None:
            return self.geometric.errors_of(measurements)
        T = self.predicted_poses(measurements)
        return measured_errors(T, measurements, self.learned.geometry.unknowns)

    def sigma(self, measurements: Measurements) -> Float64[Tensor, "rows 3"]:
        """Compute the standard deviation of predicted positions along the axes of the row's frame [m], without noise.

        It is the standard deviation of the posterior, within the measured joint ranges and outside.

        Raises:
            IdentificationError: no value was measured in metres.
        """
        return self.uncertainty.sigma(measurements, None if self.learned is None else self.learned.correction)

    def _moved_joints(self, measurements: Measurements) -> Float64[Tensor, "rows dof"]:
        """Compute the joint values of rows with their corrections [rad or m]."""
        if self.learned is None:
            return measurements.q
        with torch.no_grad():
            return measurements.q + self.learned.correction.for_rows(measurements)
