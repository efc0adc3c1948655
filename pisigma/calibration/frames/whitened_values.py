"""Measured values in standard deviations, linearised in chosen parameters, and how well they determine frames."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.calibration.geometric.problem.noise import contributions_and_noise_of
from pisigma.calibration.geometric.result import SolvedCalibration
from pisigma.calibration.hybrid.sensor_values import SensorValues, sensor_values
from pisigma.estimation.cholesky import orthonormal_columns
from pisigma.joint_correction.feature import AbstractFeature
from pisigma.measurement.conditions import JointState
from pisigma.robot.se3 import wrap_to_pi

_ROUNDING = 1e-9
"""Information on a direction, relative to that on the best determined one, below which it is a rounding error."""


@dataclass(frozen=True, eq=False)
class WhitenedValues:
    """Values `y = X u + e` with unit noise, linearised at the solution.

    Attributes:
        X: derivatives of the predicted values with respect to the chosen parameters [1/m or 1/rad].
        joint_derivatives: derivatives with respect to the joint values of the row [1/rad or 1/m].
        y: measured minus predicted [1].
        row: index of every value's row in the problem.
        has_exact_noise: whether the standard deviation of a value is exactly as stated, such as that of a prior.
        sensors: the values before whitening, each with its factor to standard deviations.
    """

    X: Float64[Tensor, "values parameters"]
    joint_derivatives: Float64[Tensor, "values dof"]
    y: Float64[Tensor, " values"]
    row: Int64[Tensor, " values"]
    has_exact_noise: Bool[Tensor, " values"]
    sensors: tuple[tuple[SensorValues, Float64[Tensor, " _rows"]], ...]

    @staticmethod
    def at_solution(solved: SolvedCalibration, parameters: Sequence[int]) -> "WhitenedValues":
        """Linearise a calibration at its solution, with the noise estimated from its residuals.

        Args:
            solved: the calibration.
            parameters: indices of the parameters with respect to which to differentiate.
        """
        problem, here = solved.problem.with_active(list(parameters)), solved.refined_linearisation
        deviation = contributions_and_noise_of(here).variances.sqrt()
        scaled = [
            (one, one.weight_root / float(sigma))
            for one, sigma in zip(sensor_values(problem, here.point), deviation, strict=True)
        ]
        by_component = [one.components for one, _ in scaled]
        return WhitenedValues(
            X=torch.cat(
                [(one.geometry_derivatives * scale[:, None, None]).flatten(0, 1) for one, scale in scaled]
            ),
            joint_derivatives=torch.cat(
                [(one.joint_derivatives * scale[:, None, None]).flatten(0, 1) for one, scale in scaled]
            ),
            y=torch.cat([(one.residual * scale[:, None]).flatten() for one, scale in scaled]),
            row=torch.cat([one.row.repeat_interleave(one.components) for one, _ in scaled]),
            has_exact_noise=torch.cat(
                [
                    torch.full((len(one.row) * count,), one.are_values_given)
                    for (one, _), count in zip(scaled, by_component, strict=True)
                ]
            ),
            sensors=tuple(scaled),
        )

    def weight_columns(
        self, features: Sequence[AbstractFeature], state: JointState
    ) -> Float64[Tensor, "values weights"]:
        """Return the derivatives with respect to the weights of a joint correction.

        Args:
            features: features of the correction.
            state: commanded joint values and conditions of all rows of the problem.
        """
        blocks = [
            torch.cat(
                [
                    (one.feature_columns(feature, state, slice(None)) * scale[:, None, None]).flatten(0, 1)
                    for one, scale in self.sensors
                ]
            )
            for feature in features
        ]
        return torch.cat(blocks, 1) if blocks else self.X[:, :0]


@dataclass(frozen=True, eq=False)
class FrameUncertaintyDirections:
    """Independent directions in the coordinates of frames, least determined first.

    Attributes:
        directions: the directions, orthonormal in units of 1 mm and 1 mrad, in the coordinates of the problem.
        sigma: standard deviation of every direction in these units; infinite if the rows contain no information.
    """

    directions: Float64[Tensor, "active frames"]
    sigma: Float64[Tensor, " frames"]

    @staticmethod
    def at_solution(
        solved: SolvedCalibration, coordinate_indices: Sequence[int]
    ) -> "FrameUncertaintyDirections":
        """Return the directions at a solution, with the noise estimated from its residuals.

        Args:
            solved: the solution.
            coordinate_indices: indices of the coordinates; the other free parameters are eliminated.
        """
        active = solved.problem.active.tolist()
        X = WhitenedValues.at_solution(solved, active).X * solved.problem.step_scale
        ours = torch.tensor([index in set(coordinate_indices) for index in active])
        U, own = orthonormal_columns(X[:, ~ours]), X[:, ours]
        own = own - U @ (U.t() @ own)
        information, vectors = torch.linalg.eigh(own.t() @ own)
        directions = X.new_zeros(len(active), len(information))
        directions[ours] = vectors
        is_known = information > _ROUNDING * information.max()
        return FrameUncertaintyDirections(
            directions, torch.where(is_known, information.clamp(min=0) ** -0.5, torch.inf)
        )

    def in_user_coordinates(
        self, solved: SolvedCalibration
    ) -> tuple[Float64[Tensor, "parameters frames"], Float64[Tensor, " frames"]]:
        """Return the directions in the user's coordinates as unit vectors, and their lengths before normalisation.

        Both are in units of 1 mm and 1 mrad.
        """
        problem, units = solved.problem, torch.from_numpy(solved.problem.space.usual_errors)
        change = solved.geometry.coordinate_jacobian[:, problem.active]
        vectors = change @ (problem.step_scale[:, None] * self.directions) / units[:, None]
        length = vectors.norm(dim=0)
        return vectors / length, length

    def distances(
        self, solved: SolvedCalibration, before: Float64[Tensor, " parameters"]
    ) -> Float64[Tensor, " frames"]:
        """Return the distances of the previous values from a solution along all directions, per 1 mm and 1 mrad."""
        space, units = solved.problem.space, torch.from_numpy(solved.problem.space.usual_errors)
        vectors, length = self.in_user_coordinates(solved)
        off = before - solved.geometry.values_of(space)
        off = torch.where(space.is_length, off, wrap_to_pi(off)) / units
        return (vectors.t() @ off) / length
