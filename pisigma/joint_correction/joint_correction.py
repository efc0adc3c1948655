"""The Pi-Sigma network that is fitted through the kinematics: corrections of all joints by joint values."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from pisigma.joint_correction.features import AbstractFeatures, ConditionFeatures, unit_inputs
from pisigma.measurement.conditions import with_conditions
from pisigma.measurement.dataset import Measurements
from pisigma.network.pi_sigma import sum_of_products, weigh_sums
from pisigma.robot.description import Robot


class JointCorrection(nn.Module):
    """Δ_j(q) [rad or m]: a unit of order 1 on chosen features, and product units on sines and cosines.

    For every joint j, with features f and φ = `unit_inputs` of all joints::

        Δ_j(q) = Σ_f Σ_m w_jm f_jm(q) + Σ_u Π_{s in unit u} (b_js + Σ_i v_jsi φ_i(q))

    A ridge polynomial network (Shin and Ghosh 1995, IEEE Transactions on Neural Networks 6(3), 610-622) of
    Pi-Sigma units, the weights behind the products fixed to 1.

    Attributes:
        robot: the nominal robot.
        features: of the unit of order 1.
        orders: number of factors of every product unit; none for an additive correction.
        linear: per choice of features `(dof, columns)` weights.
        weight: `(dof, factors, inputs)`: v.
        bias: `(dof, factors)`: b.
        fixed: `(dof, factors)`: ones.
    """

    weight: nn.Parameter
    bias: nn.Parameter
    fixed: Tensor

    def __init__(
        self, robot: Robot, features: Sequence[AbstractFeatures], orders: Sequence[int] = ()
    ) -> None:
        """Build a correction that is 0 until its weights are set.

        Raises:
            ValueError: an order is below 2.
        """
        super().__init__()
        if any(order < 2 for order in orders):
            raise ValueError(f"product units have two factors or more, got orders {tuple(orders)}.")
        self.robot = robot
        self.features = tuple(features)
        self.orders = tuple(orders)
        zeros = [torch.zeros(chosen.used.shape, dtype=torch.float64) for chosen in features]
        self.linear = nn.ParameterList([nn.Parameter(values) for values in zeros])
        factors = sum(orders)
        inputs = unit_inputs(robot, torch.zeros(robot.dof, dtype=torch.float64)).shape[-1]
        self.weight = nn.Parameter(torch.zeros(robot.dof, factors, inputs, dtype=torch.float64))
        self.bias = nn.Parameter(torch.zeros(robot.dof, factors, dtype=torch.float64))
        self.register_buffer("fixed", torch.ones(robot.dof, factors, dtype=torch.float64))

    @property
    def conditions(self) -> tuple[str, ...]:
        """Names of the conditions, besides the joint values, that it depends on."""
        return next((c.names for c in self.features if isinstance(c, ConditionFeatures)), ())

    def of_rows(self, measurements: Measurements) -> Float[Tensor, "rows dof"]:
        """Corrections under the conditions of measured rows; where a row states none, under the usual ones."""
        found: Tensor = self(with_conditions(measurements, self.conditions))
        return found

    def forward(self, q: Float[Tensor, "*batch state"]) -> Float[Tensor, "*batch dof"]:
        """Corrections to add to joint values [rad or m].

        Args:
            q: joint values [rad or m], and behind them `conditions`; without these they are as usual when
                it was fitted.
        """
        total = torch.zeros_like(q[..., : self.robot.dof])
        for chosen, weight in zip(self.features, self.linear, strict=True):
            total = total + (chosen.columns(q) * weight.to(q)).sum(-1)
        if not self.orders:
            return total
        factors = self.factors(q)
        return total + sum_of_products(factors, self.orders)

    def factors(self, q: Float[Tensor, "*batch state"]) -> Float[Tensor, "*batch dof factors"]:
        """Values of all factors of the product units of all joints."""
        phi = unit_inputs(self.robot, q)
        return weigh_sums(phi, self.weight.to(q), self.bias.to(q), self.fixed.to(q))
