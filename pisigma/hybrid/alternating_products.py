"""Product units with all factors fixed but one: linear in that one."""

from collections.abc import Sequence
from itertools import combinations

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from pisigma.joint_correction.feature import AbstractFeature, unit_inputs
from pisigma.measurement.conditions import JointState
from pisigma.robot.description import Robot


class AlternatingProducts(AbstractFeature):
    """Columns `Π_{others} h · [1, φ]` of the free factor of every unit: alternating least squares.

    Attributes:
        orders: number of factors of every unit.
        factors: weights of all of them, the bias first.
        turn: whose turn it is.
        free: per unit, number of its free factor among all.
        fixed: per unit, numbers of its other factors.
    """

    name = "products"

    def __init__(
        self, robot: Robot, orders: Sequence[int], factors: Float64[Tensor, "dof factors inputs"], turn: int
    ) -> None:
        """Fix all factors but those whose turn it is: factor `turn` modulo its unit's order."""
        super().__init__(robot)
        self.orders = tuple(orders)
        self.factors = factors
        self.turn = turn
        units = [range(sum(orders[:u]), sum(orders[: u + 1])) for u in range(len(orders))]
        self.free = tuple(unit[turn % len(unit)] for unit in units)
        self.fixed = tuple([factor for factor in unit if factor not in self.free] for unit in units)
        dof, inputs = factors.shape[0], factors.shape[2]
        self.used = torch.ones(dof, len(orders) * inputs, dtype=torch.bool)
        self.group = torch.arange(dof)[:, None].expand(self.used.shape)
        self.group_names = tuple(f"products, {joint.name}" for joint in robot.joints)

    def columns(self, state: JointState) -> Float[Tensor, "*batch dof columns"]:
        """The inputs of the free factors times the product of the fixed ones."""
        x = with_bias(self.robot, state.q)
        values = torch.einsum("...i,jsi->...js", x, self.factors.to(x))
        parts = []
        for fixed in self.fixed:
            product = torch.ones_like(values[..., 0])
            for factor in fixed:
                product = product * values[..., factor]
            parts.append(product[..., None] * x[..., None, :])
        return torch.cat(parts, -1)

    def solved(self, weights: Float64[Tensor, " weights"]) -> Float64[Tensor, "dof factors inputs"]:
        """All factors, the free ones as solved."""
        dof, _, inputs = self.factors.shape
        factors = self.factors.clone()
        factors[:, list(self.free)] = weights.reshape(dof, len(self.orders), inputs)
        return factors


class InputPairs(AbstractFeature):
    """Products of two inputs of different joints: from their weights the product units start."""

    name = "pairs"

    def __init__(self, robot: Robot) -> None:
        """All pairs of inputs that do not belong to the same joint."""
        super().__init__(robot)
        turning = [j for j, turns in enumerate(robot.revolute) if turns]
        sliding = [j for j, turns in enumerate(robot.revolute) if not turns]
        joint = [*turning, *turning, *sliding]
        self.pairs = tuple((a, b) for a, b in combinations(range(len(joint)), 2) if joint[a] != joint[b])
        self.inputs = len(joint)
        self.used = torch.ones(robot.dof, len(self.pairs), dtype=torch.bool)
        self.group = torch.arange(robot.dof)[:, None].expand(self.used.shape)
        self.group_names = tuple(f"pairs, {row.name}" for row in robot.joints)

    def columns(self, state: JointState) -> Float[Tensor, "*batch dof columns"]:
        """The products."""
        phi = unit_inputs(self.robot, state.q)
        first, second = (torch.tensor(side, device=phi.device) for side in zip(*self.pairs, strict=True))
        values = phi.index_select(-1, first) * phi.index_select(-1, second)
        return values.unsqueeze(-2).expand(*values.shape[:-1], len(self.used), values.shape[-1])

    def factors(
        self, weights: Float64[Tensor, " weights"], orders: Sequence[int]
    ) -> Float64[Tensor, "dof factors inputs"]:
        """Factors of product units that come nearest to `Σ weight · φ_a φ_b`, the largest parts first.

        A symmetric matrix with eigenvalues of both signs is a sum of products: of the largest positive and the
        largest negative one, `λ₊ (e₊·φ)² - |λ₋| (e₋·φ)²` is `(r · φ)(s · φ)` with r, s = √λ₊ e₊ ± √|λ₋| e₋.
        Further factors of a unit start as the constant 1.
        """
        dof, size = self.used.shape[0], self.inputs
        factors = weights.new_zeros((dof, sum(orders), size + 1))
        first, second = (torch.tensor(side) for side in zip(*self.pairs, strict=True))
        for j, values in enumerate(weights.reshape(dof, -1)):
            M = weights.new_zeros((size, size))
            M[first, second] = values / 2
            eigenvalues, vectors = torch.linalg.eigh(M + M.t())
            start = 0
            for u, order in enumerate(orders):
                low, high = min(u, size - 1), max(size - 1 - u, 0)
                plus = eigenvalues[high].clamp(min=0).sqrt() * vectors[:, high]
                minus = (-eigenvalues[low]).clamp(min=0).sqrt() * vectors[:, low]
                factors[j, start, 1:], factors[j, start + 1, 1:] = plus + minus, plus - minus
                factors[j, start + 2 : start + order, 0] = 1.0
                start += order
        return factors


def with_bias(robot: Robot, q: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch inputs"]:
    """1, and the inputs of the product units."""
    phi = unit_inputs(robot, q)
    return torch.cat([torch.ones_like(phi[..., :1]), phi], -1)


def normalised(factors: Float64[Tensor, "dof factors inputs"]) -> Float64[Tensor, "dof factors inputs"]:
    """Factors of length 1; those of no length are the constant 1."""
    length = factors.norm(dim=-1, keepdim=True)
    constant = torch.zeros_like(factors)
    constant[..., 0] = 1.0
    return torch.where(length > 1e-12, factors / length.clamp(min=1e-12), constant)
