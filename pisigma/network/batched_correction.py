"""A joint correction prepared for many joint values: what does not depend on them is computed once."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from pisigma.kinematics.components import Vector
from pisigma.kinematics.forward import Geometry, iterate_rows
from pisigma.network.features import (
    AbstractFeatures,
    ConditionFeatures,
    FourierSeries,
    GravityTorques,
    SharedFeatures,
    turning_rate,
)
from pisigma.network.joint_correction import JointCorrection
from pisigma.network.pi_sigma import sum_of_products
from pisigma.network.series_evaluation import SeriesTable
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
        self._others: list[tuple[AbstractFeatures, Tensor]] = []
        inputs = correction.weight.shape[-1]
        self._units = torch.zeros(self._robot.dof, inputs, dtype=torch.float64)
        self._angles_only = all(self._robot.revolute)
        for features, parameter in zip(correction.features, correction.linear, strict=True):
            self._add(features, parameter.detach().double())

    def _add(self, features: AbstractFeatures, weight: Tensor) -> None:
        if isinstance(features, FourierSeries):
            self._series.append(SeriesTable(*torch.split(weight, features.harmonics, 1)))
        elif isinstance(features, GravityTorques):
            self._gravity.append(BatchedTorques(self._robot, features, weight))
        elif isinstance(features, SharedFeatures) and features.name == "sin_cos" and self._angles_only:
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
            total = total + (features.columns(q.T) * weight).sum(-1).T
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
    joint `Δ_j = z_j · g Σ_k w_0`.
    """

    def __init__(self, robot: Robot, features: GravityTorques, weight: Float[Tensor, "dof columns"]) -> None:
        """Scale the weights of a choice of features."""
        self._robot = robot
        self._g = features.gravity
        self._geometry = Geometry(robot.dh.tolist(), [0.0] * 6, [0.0] * 6)
        used = weight * features.used.to(weight)
        masses = used.reshape(robot.dof, robot.dof, 4)
        self._force = masses[:, :, 0].sum(1).tolist()
        scale = masses.new_tensor([1 / robot.reach, *[features.ARM] * 3])
        self._masses = (masses * scale).flatten(1)
        self._all = self._masses[:, ::4].sum(1, keepdim=True)

    def __call__(self, q: Float[Tensor, "dof poses"]) -> Float[Tensor, "dof poses"]:
        """The weighted torques."""
        carried, joints = [], []
        for row, step in zip(
            self._robot.rows, iterate_rows(self._robot, self._geometry, q.unbind(0)), strict=True
        ):
            if row.type != "fixed":
                joints.append((step.before[2], step.before[3]))
                carried += [step.after[3], *step.after[:3]]
        A = self._sums(carried, q[0])
        axes, origins = (_stacked([pair[i] for pair in joints], q[0]) for i in range(2))
        A = A - self._all.to(q)[..., None] * origins
        g = self._g
        moment = (
            (g[1] * axes[:, 2] - g[2] * axes[:, 1]) * A[:, 0]
            + (g[2] * axes[:, 0] - g[0] * axes[:, 2]) * A[:, 1]
            + (g[0] * axes[:, 1] - g[1] * axes[:, 0]) * A[:, 2]
        )
        moment = moment * q.new_tensor(self._robot.directions)[:, None]
        if all(self._robot.revolute):
            return moment
        along = sum(value * axes[:, i] for i, value in enumerate(g)) * q.new_tensor(self._force)[:, None]
        turning = torch.tensor(self._robot.revolute, device=q.device)[:, None]
        return torch.where(turning, moment, along * q.new_tensor(self._robot.directions)[:, None])

    def _sums(self, carried: list[Vector], like: Tensor) -> Float[Tensor, "dof 3 poses"]:
        columns = _stacked(carried, like)
        return (self._masses.to(like) @ columns.flatten(1)).reshape(len(self._masses), *columns.shape[1:])


def _stacked(vectors: list[Vector], like: Tensor) -> Float[Tensor, "vectors 3 poses"]:
    """Vectors one under the other."""
    found = like.new_empty(len(vectors), 3, len(like))
    for place, vector in zip(found, vectors, strict=True):
        for row, value in zip(place, vector, strict=True):
            row.copy_(value) if isinstance(value, Tensor) else row.fill_(value)
    return found
