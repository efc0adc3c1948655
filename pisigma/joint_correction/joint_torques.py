"""Deflection of compliant joints by measured torques."""

from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from pisigma.joint_correction.feature import AbstractFeature, FeatureOptions, FeatureSection
from pisigma.joint_correction.gravity_torques import Direction, GravityTorques
from pisigma.measurement.conditions import TORQUE, JointState
from pisigma.robot.description import Robot

MIN_ROWS = 12
"""Rows with a torque of a joint that its model of gravity torques needs."""
MIN_TORQUE = 1e-6
"""[Nm or N] A joint whose torque varies less has no deflection that could be identified."""
RIDGE = 1e-6
"""Share of the mean square of the columns that is added to the normal equations of the modelled torques, because some
masses cannot be distinguished."""


class TorqueSection(FeatureSection):
    """Section of measured torques in the description of a model."""

    name: Literal["torques"]
    gravity: Direction
    scale: tuple[float, ...]
    model: tuple[tuple[float, ...], ...]
    deviation: tuple[float, ...]


class JointTorques(AbstractFeature):
    """`Δ_j = w_j τ_j / s_j`: the deflection of a joint by its torque; `c_j = -w_j / s_j` is its compliance [rad/Nm].

    τ_j is the torque that the drive exerts on the joint in the direction in which its value increases [Nm; N for
    prismatic joints]; it holds the arm, and an elastic gear yields against it, so that c_j is positive. s_j is the
    standard deviation of the measured torques.

    Where no torque is stated, τ_j is the modelled gravity torque `Σ_m g_jm m_jm`, with the columns g of
    `GravityTorques`, and m fitted to the measured torques of the calibration (ridge regression). A payload that differs
    from the mean of the calibration is not a part of it; `unstated_deviation` contains the spread of the measured
    torques about the modelled ones.

    Source: Dumas, Caro, Garnier and Furet, Robotics and Computer-Integrated Manufacturing 27(4), 2011, 881-888: joint
    stiffness from torques; measured torques instead of modelled ones are our choice.

    Attributes:
        gravity: direction of gravity in the frame of the robot's first row.
        scale: s_j [Nm or N]; 0 for joints without measured torques.
        model: m_jm [Nm or N].
        deviation: RMS difference of measured and modelled torques per joint [Nm or N].
    """

    name = "torques"
    section = TorqueSection
    reads = (TORQUE,)
    group_names = ("torques",)
    usual_sizes = (3e-4,)

    def __init__(
        self,
        robot: Robot,
        gravity: Direction,
        scale: Sequence[float],
        model: Sequence[Sequence[float]],
        deviation: Sequence[float],
    ) -> None:
        """Create the feature with one weight per joint with measured torques.

        Raises:
            ValueError: the numbers of joints do not agree, or a scale or deviation is negative.
        """
        super().__init__(robot)
        self._torques = GravityTorques(robot, gravity)
        self.gravity = self._torques.gravity
        self.scale, self.deviation = tuple(scale), tuple(deviation)
        self.model = tuple(tuple(row) for row in model)
        expected = (robot.dof, robot.dof, *(4 * robot.dof,) * robot.dof)
        if (len(self.scale), len(self.deviation), *map(len, self.model)) != expected or min(
            *self.scale, *self.deviation
        ) < 0:
            raise ValueError(
                f"expected scales, deviations and models of the torques of {robot.dof} joints, got {self.scale}, "
                f"{self.deviation} and {len(self.model)} models."
            )
        self.used = torch.tensor(self.scale)[:, None] > 0
        self.group = torch.zeros(robot.dof, 1, dtype=torch.int64)

    @classmethod
    def candidates(
        cls, robot: Robot, options: FeatureOptions, state: JointState
    ) -> tuple["JointTorques", ...]:
        """Return the feature, with modelled torques fitted to the measured ones, if the torque of a joint varies."""
        torque = state.stated.get(TORQUE)
        if torque is None:
            return ()
        columns = GravityTorques(robot, options.gravity).columns(state)
        scale, model, deviation = [], torch.zeros(robot.dof, 4 * robot.dof, dtype=torch.float64), []
        for joint, measured in enumerate(torque.t()):
            rows = torch.isfinite(measured)
            y, X = measured[rows], columns[rows, joint]
            varies = int(rows.sum()) >= MIN_ROWS and float(y.std()) > MIN_TORQUE
            scale.append(float(y.std()) if varies else 0.0)
            if varies:
                ridge = RIDGE * X.square().sum(0).mean().clamp(min=1e-12)
                normal = X.T @ X + ridge * torch.eye(X.shape[1]).to(X)
                model[joint] = torch.linalg.solve(normal, X.T @ y).cpu()
            deviation.append(float((y - X @ model[joint].to(X)).square().mean().sqrt()) if varies else 0.0)
        if not any(scale):
            return ()
        return (JointTorques(robot, options.gravity, scale, model.tolist(), deviation),)

    def columns(self, state: JointState) -> Float[Tensor, "*batch dof columns"]:
        """Return the torques, stated or modelled, over their scale."""
        q = state.q
        modelled = (self._torques.columns(state) * q.new_tensor(self.model)).sum(-1)
        stated = state.stated.get(TORQUE)
        torque = modelled
        if stated is not None:
            stated = stated.to(q).expand(q.shape)
            torque = torch.where(torch.isfinite(stated), stated, modelled)
        return (torque * self._per_scale(q))[..., None]

    def unstated_deviation(
        self, state: JointState, weight: Float64[Tensor, "dof columns"]
    ) -> Float[Tensor, "*batch dof"]:
        """Return the deflection by the RMS difference of measured and modelled torques where none is stated."""
        q = state.q
        deviation = (weight[:, 0].to(q) * self._per_scale(q)).abs() * q.new_tensor(self.deviation)
        stated = state.stated.get(TORQUE)
        if stated is None:
            return deviation.expand(q.shape)
        return torch.where(torch.isfinite(stated.to(q).expand(q.shape)), 0.0, deviation)

    def gravity_weights(
        self, weight: Float64[Tensor, "dof columns"]
    ) -> Float64[Tensor, "dof gravity_columns"]:
        """Return the weights with which `GravityTorques` gives the deflections by modelled torques."""
        return weight * self._per_scale(weight)[:, None] * weight.new_tensor(self.model)

    def deflections(
        self, weight: Float64[Tensor, "dof columns"], torques: Float64[np.ndarray, " dof"]
    ) -> Float64[Tensor, " dof"]:
        """Return the deflections of the joints [rad or m] by torques [Nm or N]."""
        return weight[:, 0] * self._per_scale(weight) * weight.new_tensor(torques)

    def _per_scale(self, like: Tensor) -> Float[Tensor, " dof"]:
        """Return 1 / s_j; 0 for joints without measured torques."""
        return like.new_tensor([1 / scale if scale else 0.0 for scale in self.scale])
