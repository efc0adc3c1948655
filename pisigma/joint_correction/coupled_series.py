"""Feature for errors in the drives of coupled joints: factors, gears before the coupling, and curved guides."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from pisigma.joint_correction.feature import USUAL_SIZE, AbstractFeature, FeatureOptions
from pisigma.measurement.conditions import JointState
from pisigma.robot.description import Robot

_HARMONICS, LOW = 8, 3
"""Number of harmonics of every axis, and number of low harmonics, which have a separate prior scale: guides have
errors in low harmonics, gears also in higher ones."""


class CoupledSeries(AbstractFeature):
    """Scaled value, and first sines and cosines, of every axis that drives a coupled joint.

    For joint i and an axis j named in its coupling, with the controller's value q_j::

        Δ_i = δC_ij · q_j + Σ_k (a_k sin k φ_j + b_k cos k φ_j) + Σ_l (∂f_i/∂ln l) δl/l

    δC_ij is the error of the factor. φ_j is the angle of the axis or, for a prismatic axis, an angle with a period of
    twice its travel, so that low harmonics describe the straightness and yaw of a rail (in a joint that follows it with
    the factor 0). The last sum is over the lengths l of the bars of a four-bar linkage. Errors of gears before the
    coupling depend on φ_j (Judd and Knasinski 1990, IEEE Transactions on Robotics and Automation 6(1), 20-30).
    """

    name = "coupling"
    group_names = (
        "factors, turning",
        "factors, sliding",
        "low harmonics, turning",
        "low harmonics, sliding",
        "high harmonics, turning",
        "high harmonics, sliding",
        "bars",
    )

    def __init__(self, robot: Robot) -> None:
        """Create the feature with columns for the axes that drive every coupled joint."""
        super().__init__(robot)
        coupling = robot.coupling
        axes = len(robot.axes)
        driven = np.zeros((robot.dof, axes), dtype=bool) if coupling is None else coupling.is_factor_stated
        sliding = torch.tensor([0 if turns else 1 for turns in robot.revolute])[:, None]
        self.used = torch.from_numpy(np.tile(driven, (1, 1 + 2 * _HARMONICS)))
        bands = ([2] * LOW + [4] * (_HARMONICS - LOW)) * 2
        self.group = torch.tensor([0, *bands]).repeat_interleave(axes) + sliding
        self._bars = () if coupling is None else coupling.four_bars
        if self._bars:
            by_bars = torch.zeros(robot.dof, 3, dtype=torch.bool)
            by_bars[[joint for joint, _ in self._bars]] = True
            self.used = torch.cat([self.used, by_bars], 1)
            self.group = torch.cat(
                [self.group, torch.full_like(by_bars, len(self.group_names) - 1, dtype=torch.int64)], 1
            )
        limits = robot.axis_limits
        bounded = np.isfinite(limits).all(1)
        turning = np.array([axis.type == "revolute" for axis in robot.axes])
        bounds = np.where(bounded[:, None], limits, [-np.pi, np.pi])
        self._middle, self._half = (
            torch.from_numpy(bounds.mean(1)),
            torch.from_numpy(np.diff(bounds)[:, 0] / 2),
        )
        self._rate = torch.from_numpy(np.where(turning, 1.0, np.pi / np.diff(bounds)[:, 0]))

    @property
    def usual_sizes(self) -> tuple[float, ...]:
        """Initial standard deviation of the weights of every group [rad]."""
        return (10 * USUAL_SIZE,) * len(self.group_names)

    @classmethod
    def candidates(
        cls, robot: Robot, options: FeatureOptions, state: JointState
    ) -> tuple["CoupledSeries", ...]:
        """Return the feature for a robot with coupled joints, otherwise an empty tuple."""
        return () if robot.coupling is None else (CoupledSeries(robot),)

    def columns(self, state: JointState) -> Float[Tensor, "*batch dof columns"]:
        """Return scaled values, sines and cosines of all axes, then derivatives with respect to bar lengths."""
        q = self.robot.to_controller(state.q)
        scaled = (q - self._middle.to(q)) / self._half.to(q)
        angles = [k * self._rate.to(q) * q for k in range(1, _HARMONICS + 1)]
        parts = [scaled, *(angle.sin() for angle in angles), *(angle.cos() for angle in angles)]
        values = torch.cat(parts, -1)
        columns = values.unsqueeze(-2).expand(*state.q.shape, values.shape[-1])
        if not self._bars:
            return columns
        lengths = q.new_zeros((*state.q.shape, 3))
        for joint, bar in self._bars:
            lengths[..., joint, :] = torch.stack(
                bar.length_derivatives(bar.crank_rotation(state.q[..., joint])), -1
            )
        return torch.cat([columns, lengths], -1)

    def is_periodic(self, weight: Float64[np.ndarray, "dof columns"]) -> bool:
        """Return False if a factor has an error, because a full turn of an axis then moves the joint differently."""
        return not weight[:, : len(self.robot.axes)].any()

    def factor_errors(self, weight: Float64[np.ndarray, "dof columns"]) -> Float64[np.ndarray, "dof axes"]:
        """Return the errors δC of the factors, [rad or m] of a joint per [rad or m] of an axis."""
        errors: Any = weight[:, : len(self.robot.axes)] / self._half.numpy()
        return np.asarray(errors)
