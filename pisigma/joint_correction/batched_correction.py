"""A joint correction prepared for many joint values: what does not depend on them is computed once."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from pisigma.joint_correction.conditions import ConditionFeatures
from pisigma.joint_correction.feature import AbstractFeature, turning_rate
from pisigma.joint_correction.fourier_series import FourierSeries
from pisigma.joint_correction.gravity_torques import GravityTorques
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.joint_correction.series_evaluation import SeriesTable
from pisigma.joint_correction.shared_features import SinesCosines
from pisigma.kinematics.components import Vector, add_product, product
from pisigma.kinematics.forward import Geometry, iterate_rows
from pisigma.measurement.conditions import JointState
from pisigma.network.pi_sigma import sum_of_products
from pisigma.robot.description import Robot


class BatchedCorrection:
    """Δ(q) of a `JointCorrection` under the usual conditions, some ten times as fast; no gradients flow.

    Joint values and corrections are `(dof, poses)`: the last axis is that of the poses. Features without a fast form
    are computed as they are.
    """

    def __init__(self, correction: JointCorrection) -> None:
        """Take the weights as they are now."""
        self._correction = correction
        self._robot = correction.robot
        self._rate = torch.from_numpy(turning_rate(correction.robot))[:, None]
        self._series: list[SeriesTable] = []
        self._gravity: list[BatchedTorques] = []
        self._others: list[tuple[AbstractFeature, Tensor]] = []
        inputs = correction.weight.shape[-1]
        self._units = torch.zeros(self._robot.dof, inputs, dtype=torch.float64)
        self._angles_only = all(self._robot.revolute)
        for features, parameter in zip(correction.features, correction.linear, strict=True):
            self._add(features, parameter.detach().double())

    def _add(self, features: AbstractFeature, weight: Tensor) -> None:
        if isinstance(features, FourierSeries):
            self._series.append(SeriesTable(*torch.split(weight, features.harmonics, 1)))
        elif isinstance(features, GravityTorques):
            self._gravity.append(BatchedTorques(self._robot, features, weight))
        elif isinstance(features, SinesCosines) and self._angles_only:
            self._units += weight
        elif not isinstance(features, ConditionFeatures):  # which are 0 under the usual conditions
            self._others.append((features, weight))

    def __call__(
        self, q: Float[Tensor, "dof poses"], slope: bool = False
    ) -> tuple[Float[Tensor, "dof poses"], Float[Tensor, "dof poses"]]:
        """Corrections [rad or m], and the slope of every joint's own series, the steepest part; 0 if not wanted."""
        angle = q * self._rate.to(q)
        sine, cosine = angle.sin(), angle.cos()
        total, steep = torch.zeros_like(q), torch.zeros_like(q)
        for series in self._series:
            if slope:
                value, rise = series.with_slope(angle)
                total, steep = total + value, steep + rise * self._rate.to(q)
            else:
                total = total + series(angle)
        for torques in self._gravity:
            total = total + torques(q)
        for features, weight in self._others:
            total = total + (features.columns(JointState(q.T)) * weight).sum(-1).T
        if self._angles_only:
            return self._with_units(total, torch.cat([sine, cosine])), steep
        if self._correction.orders:
            total = total + sum_of_products(self._correction.factors(q.T), self._correction.orders).T
        return total, steep

    def _with_units(self, total: Tensor, phi: Float[Tensor, "inputs poses"]) -> Tensor:
        """Add what is linear in the sines and cosines of all joints, and the products of sums of them."""
        own = self._correction
        if self._units.any():
            total = torch.addmm(total, self._units, phi)
        if not own.orders:
            return total
        weight = (
            (own.weight * own.fixed[..., None]).detach().movedim(1, 0).flatten(0, 1)
        )  # all joints of a factor
        bias = (own.bias * own.fixed).detach().T.reshape(-1, 1)
        factors = iter(torch.addmm(bias, weight, phi).reshape(sum(own.orders), *total.shape))
        for order in own.orders:
            total = total + math.prod(next(factors) for _ in range(order))
        return total


class BatchedTorques:
    """Weighted `GravityTorques`: `Δ_j = (g × z_j) · Σ_k A_jk`, with all masses of a joint summed before the product.

    `A_jk` is `(w_0 / reach) (p_k - p_j) + ARM (w_1 x_k + w_2 y_k + w_3 z_k)` with the weights of mass k; on a prismatic
    joint `Δ_j = z_j · g Σ_k w_0`. All is computed in a frame whose z axis gravity falls along, where only the other
    two components of the arms turn anything.
    """

    def __init__(self, robot: Robot, features: GravityTorques, weight: Float[Tensor, "dof columns"]) -> None:
        """Scale the weights of a choice of features."""
        self._robot = robot
        base, self._fall = _upright(features.gravity)
        self._geometry = Geometry(robot.dh.tolist(), base, [0.0] * 6)
        used = weight * features.used.to(weight)
        masses = used.reshape(robot.dof, robot.dof, 4)
        self._force = masses[:, :, 0].sum(1).tolist()
        scale = masses.new_tensor([1 / robot.reach, *[features.ARM] * 3])
        columns = (masses * scale).flatten(1)
        self._all = columns[:, ::4].sum(1).tolist()
        self._kept = (columns != 0).any(0).nonzero()[:, 0].tolist()
        self._masses = columns[:, self._kept]

    def __call__(self, q: Float[Tensor, "dof poses"]) -> Float[Tensor, "dof poses"]:
        """The weighted torques."""
        carried, joints = [], []
        for row, step in zip(
            self._robot.rows, iterate_rows(self._robot, self._geometry, q.unbind(0)), strict=True
        ):
            if row.type != "fixed":
                joints.append((row.type == "revolute", float(row.direction), step.before[2], step.before[3]))
                carried += [step.after[3], *step.after[:3]]
        found = torch.zeros_like(q)
        arms = self._sums([carried[place] for place in self._kept], q)
        for j, (turns, direction, axis, origin) in enumerate(joints):
            if not turns:
                found[j] += product(self._fall * direction * self._force[j], axis[2])
                continue
            x, y = (add_product(arms[j, i], -self._all[j], origin[i]) for i in range(2))
            turned = add_product(product(axis[0], y), axis[1], x, -1.0)
            found[j] += product(self._fall * direction, turned)
        return found

    def _sums(self, carried: list[Vector], q: Tensor) -> Float[Tensor, "dof 2 poses"]:
        """Weighted sums of the first two components of vectors."""
        columns = q.new_empty(len(carried), 2, q.shape[1])
        for place, vector in zip(columns, carried, strict=True):
            for row, value in zip(place, vector[:2], strict=True):
                row.copy_(value) if isinstance(value, Tensor) else row.fill_(value)
        return (self._masses.to(q) @ columns.flatten(1)).reshape(len(q), *columns.shape[1:])


def _upright(gravity: tuple[float, ...]) -> tuple[list[float], float]:
    """A base, as xyzrpy, in which a direction is ±z, and which of the two; no turn where it is that already."""
    x, y, z = gravity
    sign = math.copysign(1.0, z)
    yaw = math.atan2(sign * y, sign * z)
    across = math.hypot(y, z)
    return [0.0, 0.0, 0.0, 0.0, math.atan2(-sign * x, across), yaw], sign * math.hypot(x, across)
