"""Deflection of compliant joints by measured torques."""

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor

from pisigma.joint_correction.feature import AbstractFeature, FeatureOptions, FeatureSection
from pisigma.joint_correction.gravity_torques import Direction, GravityTorques
from pisigma.measurement.conditions import TORQUE, JointState
from pisigma.measurement.groups import groups_of_equal_joints
from pisigma.robot.description import Robot

_MIN_POSES = 30
"""Number of distinct joint values with a torque of a joint that the model of its gravity torques needs: about twice the
number of masses and centres of mass on which the torque of a joint of a six-axis arm depends."""
_MIN_TORQUE = 1e-6
"""Variation of a joint's torque below which its deflection cannot be identified [Nm or N]."""
_RIDGES = (1e-6, 1e-4, 1e-2, 1.0)
"""Shares of the mean square of the columns that are added to the normal equations of the modelled torques, because some
masses cannot be distinguished; the share with the smallest held-out errors is used."""


class TorqueSection(FeatureSection):
    """Section of measured torques in the description of a model."""

    name: Literal["torques"]
    gravity: Direction
    scale: tuple[float, ...]
    model: tuple[tuple[float, ...], ...]
    covariance: tuple[tuple[float, ...], ...]


class JointTorques(AbstractFeature):
    """`Δ_j = w_j τ_j / s_j`: the deflection of a joint by its torque; `c_j = -w_j / s_j` is its compliance [rad/Nm].

    τ_j is the torque that the drive exerts on the joint in the direction in which its value increases [Nm; N for
    prismatic joints]; it holds the arm, and an elastic gear yields in the opposite direction, so c_j is positive. s_j
    is the standard deviation of the measured torques.

    Where no torque is stated, τ_j is the modelled gravity torque `Σ_m g_jm m_jm`, with the columns g of
    `GravityTorques`, and m fitted to the measured torques of the calibration (ridge regression). It does not include a
    payload that differs from the mean of the calibration; `unstated_covariance_root` therefore contains the differences
    between measured and modelled torques, each modelled without the rows of its joint values. These differences are
    correlated, because a payload loads several joints.

    Source: Dumas, Caro, Garnier and Furet, Robotics and Computer-Integrated Manufacturing 27(4), 2011, 881-888: joint
        stiffness from torques; using measured instead of modelled torques is our choice.

    Attributes:
        gravity: direction of gravity in the frame of the robot's first row.
        scale: s_j [Nm or N]; 0 for joints without measured torques.
        model: m_jm [Nm or N].
        covariance: mean products of these differences of two joints [Nm or N, squared].
    """

    name = "torques"
    section = TorqueSection
    group_names = ("torques",)
    usual_sizes = (3e-4,)

    def __init__(
        self,
        robot: Robot,
        gravity: Direction,
        scale: Sequence[float],
        model: Sequence[Sequence[float]],
        covariance: Sequence[Sequence[float]],
    ) -> None:
        """Create the feature with one weight per joint with measured torques.

        Raises:
            ValueError: the numbers of joints do not agree, or a scale or variance is negative.
        """
        super().__init__(robot)
        self._torques = GravityTorques(robot, gravity)
        self.gravity = self._torques.gravity
        self.scale = tuple(scale)
        self.model, self.covariance = (tuple(tuple(row) for row in rows) for rows in (model, covariance))
        shapes = (np.shape(self.scale), np.shape(self.model), np.shape(self.covariance))
        if (
            shapes != ((robot.dof,), (robot.dof, 4 * robot.dof), (robot.dof, robot.dof))
            or min(*self.scale, *np.diag(self.covariance)) < 0
        ):
            raise ValueError(
                f"expected scales, models and covariances of the torques of {robot.dof} joints, got shapes {shapes} "
                f"and the scales {self.scale}."
            )
        self.used = torch.tensor(self.scale)[:, None] > 0
        self.group = torch.zeros(robot.dof, 1, dtype=torch.int64)

    @classmethod
    def candidates(
        cls, robot: Robot, options: FeatureOptions, state: JointState
    ) -> tuple["JointTorques", ...]:
        """Return the feature, with modelled torques fitted to measured torques, if the torque of a joint varies."""
        torque = state.conditions.get(TORQUE)
        if torque is None:
            return ()
        columns = GravityTorques(robot, options.gravity).columns(state)
        scale, model = [0.0] * robot.dof, torch.zeros(robot.dof, 4 * robot.dof, dtype=torch.float64)
        missed = torch.zeros_like(torque)
        for joint, measured in enumerate(torque.t()):
            rows = torch.isfinite(measured)
            y, X, pose = measured[rows], columns[rows, joint], groups_of_equal_joints(state.q[rows])
            if len(torch.unique(pose)) >= _MIN_POSES and float(y.std()) > _MIN_TORQUE:
                scale[joint] = float(y.std())
                masses, left_out = min(
                    (_fit(X, y, pose, ridge) for ridge in _RIDGES), key=lambda fit: fit[1].norm()
                )
                model[joint], missed[rows, joint] = masses.cpu(), left_out / math.sqrt(len(y))
        if not any(scale):
            return ()
        covariance = (missed.T @ missed).tolist()
        return (JointTorques(robot, options.gravity, scale, model.tolist(), covariance),)

    def columns(self, state: JointState) -> Float[Tensor, "*batch dof columns"]:
        """Return the torques, stated or modelled, divided by their scale."""
        q, modelled = state.q, self.modelled_torques(state)
        stated = state.conditions.get(TORQUE)
        torque = modelled
        if stated is not None:
            stated = stated.to(q).expand(q.shape)
            torque = torch.where(torch.isfinite(stated), stated, modelled)
        return (torque * self._per_scale(q))[..., None]

    def modelled_torques(self, state: JointState) -> Float[Tensor, "*batch dof"]:
        """Return the modelled gravity torques [Nm or N]; 0 for joints without measured torques."""
        return (self._torques.columns(state) * state.q.new_tensor(self.model)).sum(-1)

    def unstated_covariance_root(
        self, state: JointState, weight: Float64[Tensor, "dof columns"]
    ) -> Float[Tensor, "*batch dof sources"]:
        """Return the deflections due to the differences between measured and modelled torques where none are stated."""
        q = state.q
        variance, directions = torch.linalg.eigh(q.new_tensor(self.covariance))
        compliance = weight[:, 0].to(q) * self._per_scale(q)
        root: Tensor = compliance[:, None] * directions * variance.clamp(min=0).sqrt()
        stated = state.conditions.get(TORQUE)
        known = torch.zeros_like(q) if stated is None else torch.isfinite(stated.to(q).expand(q.shape)).to(q)
        root = root * (1 - known)[..., None]
        return root

    def gravity_weights(
        self, weight: Float64[Tensor, "dof columns"]
    ) -> Float64[Tensor, "dof gravity_columns"]:
        """Return the weights with which `GravityTorques` yields the deflections due to modelled torques."""
        return weight * self._per_scale(weight)[:, None] * weight.new_tensor(self.model)

    def deflections(
        self, weight: Float64[Tensor, "dof columns"], torques: Float64[np.ndarray, " dof"]
    ) -> Float64[Tensor, " dof"]:
        """Return the deflections of the joints [rad or m] due to torques [Nm or N]."""
        return -self.compliances(weight) * weight.new_tensor(torques)

    def compliances(self, weight: Float64[Tensor, "dof columns"]) -> Float64[Tensor, " dof"]:
        """Return the compliances of the joints [rad/Nm or m/N]; 0 for joints without measured torques."""
        return -weight[:, 0] * self._per_scale(weight)

    def _per_scale(self, like: Tensor) -> Float[Tensor, " dof"]:
        """Return 1 / s_j; 0 for joints without measured torques."""
        return like.new_tensor([1 / scale if scale else 0.0 for scale in self.scale])


def _fit(
    X: Float64[Tensor, "rows columns"],
    y: Float64[Tensor, " rows"],
    pose: Int64[Tensor, " rows"],
    ridge: float,
) -> tuple[Float64[Tensor, " columns"], Float64[Tensor, " rows"]]:
    """Return the masses from a ridge regression, and the differences of rows from a fit without their pose."""
    penalty = ridge * X.square().sum(0).mean().clamp(min=1e-12)
    solved = torch.linalg.solve(X.T @ X + penalty * torch.eye(X.shape[1]).to(X), X.T)
    masses = solved @ y
    residual = y - X @ masses
    # rows of a pose have equal columns, so the sum of their leverages and the mean of their residuals are sufficient
    leverage = (X * solved.T).sum(1)
    count = torch.bincount(pose)
    mean = (torch.zeros_like(count, dtype=y.dtype).index_add(0, pose, residual) / count)[pose]
    total = leverage * count[pose]
    return masses, residual + mean * total / (1 - total).clamp(min=1e-9)
