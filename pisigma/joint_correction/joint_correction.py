"""Joint correction: a Pi-Sigma network of the joint values, fitted through the kinematics."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from pisigma.joint_correction.feature import AbstractFeature, product_unit_inputs
from pisigma.measurement.conditions import APPROACH, JointState
from pisigma.measurement.dataset import Measurements
from pisigma.network.pi_sigma import sum_of_products, weigh_sums
from pisigma.robot.description import Robot


class JointCorrection(nn.Module):
    """Correction Δ_j(q) [rad or m]: a unit of order 1 on features, and product units on sines and cosines.

    For every joint j, with features f and φ = `product_unit_inputs` of all joints::

        Δ_j(q) = Σ_f Σ_m w_jm f_jm(q) + Σ_u Π_{s in unit u} (b_js + Σ_i v_jsi φ_i(q))

    This is a ridge polynomial network (Shin and Ghosh 1995, IEEE Transactions on Neural Networks 6(3), 610-622) of
    Pi-Sigma units, with the weights of the products fixed to 1.

    Attributes:
        robot: the nominal robot.
        features: features of the unit of order 1.
        orders: number of factors of every product unit; empty for an additive correction.
        linear: weights `(dof, columns)` of every feature.
        weight: `(dof, factors, inputs)`: weights v of the product units.
        bias: `(dof, factors)`: biases b of the product units.
        fixed: `(dof, factors)`: fixed weights of the products, all 1.
    """

    weight: nn.Parameter
    bias: nn.Parameter
    fixed: Tensor

    def __init__(self, robot: Robot, features: Sequence[AbstractFeature], orders: Sequence[int] = ()) -> None:
        """Create a correction that is 0 until weights are set.

        Raises:
            ValueError: an order is below 2.
        """
        super().__init__()
        if any(order < 2 for order in orders):
            raise ValueError(f"expected product units with at least two factors, got orders {tuple(orders)}.")
        self.robot = robot
        self.features = tuple(features)
        self.orders = tuple(orders)
        zeros = [torch.zeros(feature.used.shape, dtype=torch.float64) for feature in features]
        self.linear = nn.ParameterList([nn.Parameter(values) for values in zeros])
        factors = sum(orders)
        inputs = product_unit_inputs(robot, torch.zeros(robot.dof, dtype=torch.float64)).shape[-1]
        self.weight = nn.Parameter(torch.zeros(robot.dof, factors, inputs, dtype=torch.float64))
        self.bias = nn.Parameter(torch.zeros(robot.dof, factors, dtype=torch.float64))
        self.register_buffer("fixed", torch.ones(robot.dof, factors, dtype=torch.float64))

    @property
    def is_periodic(self) -> bool:
        """Whether the correction is the same after full turns of revolute joints."""
        pairs = zip(self.features, self.linear, strict=True)
        return all(feature.is_periodic(weight.detach().cpu().numpy()) for feature, weight in pairs)

    def for_rows(self, measurements: Measurements) -> Float[Tensor, "rows dof"]:
        """Compute the corrections of measured rows [rad or m], with usual values where a row states none."""
        delta: Tensor = self(JointState.from_measurements(measurements))
        return delta

    def forward(
        self,
        q: Float[Tensor, "*batch dof"] | JointState,
        approach: Float[Tensor, "*batch dof"] | None = None,
    ) -> Float[Tensor, "*batch dof"]:
        """Compute the corrections to add to joint values [rad or m].

        Args:
            q: joint values [rad or m], for usual conditions and the middle of all backlash, or joint states that
                include conditions.
            approach: approach direction of every joint for plain joint values: +1 if its value increases, -1 if it
                decreases, 0 if not stated.
        """
        stated = {} if approach is None else {APPROACH: approach}
        state = q if isinstance(q, JointState) else JointState(q, stated)
        total = torch.zeros_like(state.q)
        for feature, weight in zip(self.features, self.linear, strict=True):
            total = total + (feature.columns(state) * weight.to(state.q)).sum(-1)
        if not self.orders:
            return total
        return total + sum_of_products(self.factors(state.q), self.orders)

    def unstated_covariance_root(self, state: JointState) -> Float[Tensor, "*batch dof sources"]:
        """Compute a root R of the covariance R R^T of the corrections [rad or m] due to unstated conditions of rows."""
        roots = [
            feature.unstated_covariance_root(state, weight.detach().to(state.q))
            for feature, weight in zip(self.features, self.linear, strict=True)
        ]
        return torch.cat([state.q.new_zeros((*state.q.shape, 0)), *roots], -1)

    def factors(self, q: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch dof factors"]:
        """Compute the factors of the product units of all joints."""
        phi = product_unit_inputs(self.robot, q)
        return weigh_sums(phi, self.weight.to(q), self.bias.to(q), self.fixed.to(q))
