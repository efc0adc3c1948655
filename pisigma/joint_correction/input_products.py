"""Products of the inputs of different joints, and the product units of a Pi-Sigma network that they make up."""

from itertools import combinations

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from pisigma.joint_correction.feature import AbstractFeature, unit_inputs
from pisigma.measurement.conditions import JointState
from pisigma.robot.description import Robot


class InputProducts(AbstractFeature):
    """Products φ_a φ_b of two inputs of different joints, to which a weight each is fitted.

    With φ = `unit_inputs`, `Σ_ab w_ab φ_a φ_b` is what product units of order 2 express; with its weights fitted, the
    sum is written as such units (see `factors`), which is how a model holds it.
    """

    name = "products"

    def __init__(self, robot: Robot) -> None:
        """Take all pairs of inputs that do not belong to the same joint."""
        super().__init__(robot)
        turning = [j for j, turns in enumerate(robot.revolute) if turns]
        sliding = [j for j, turns in enumerate(robot.revolute) if not turns]
        joint = [*turning, *turning, *sliding]
        pairs = [(a, b) for a, b in combinations(range(len(joint)), 2) if joint[a] != joint[b]]
        self.pairs = torch.tensor(pairs, dtype=torch.int64).reshape(-1, 2).t()
        self.inputs = len(joint)
        self.used = torch.ones(robot.dof, len(pairs), dtype=torch.bool)
        self.group = torch.arange(robot.dof)[:, None].expand(self.used.shape)
        self.group_names = tuple(f"products, {row.name}" for row in robot.joints)

    def columns(self, state: JointState) -> Float[Tensor, "*batch dof columns"]:
        """The products."""
        phi = unit_inputs(self.robot, state.q)
        first, second = self.pairs.to(phi.device)
        values = phi.index_select(-1, first) * phi.index_select(-1, second)
        return values.unsqueeze(-2).expand(*values.shape[:-1], len(self.used), values.shape[-1])

    def factors(self, weights: Float64[Tensor, " weights"]) -> Float64[Tensor, "dof factors inputs"]:
        """Weights of the factors of product units of order 2 whose sum is the same, two factors a unit.

        `Σ_ab w_ab φ_a φ_b = φ^T M φ` with a symmetric M. With its positive and negative eigenvalues λ and μ and their
        eigenvectors e and f, it is the sum over units of `λ (e·φ)² - |μ| (f·φ)² = (r·φ) (s·φ)` with
        r, s = √λ e ± √|μ| f. There are as many units as there are eigenvalues of one sign at most.
        """
        first, second = self.pairs
        M = weights.new_zeros((len(self.used), self.inputs, self.inputs))
        M[:, first, second] = weights.reshape(self.used.shape) / 2
        eigenvalues, vectors = torch.linalg.eigh(M + M.mT)
        scaled = eigenvalues.abs().sqrt()[:, None] * vectors
        minus, plus = scaled * (eigenvalues < 0)[:, None], (scaled * (eigenvalues > 0)[:, None]).flip(-1)
        units = int(torch.maximum((eigenvalues < 0).sum(1), (eigenvalues > 0).sum(1)).max())
        sides = torch.stack([plus + minus, plus - minus], -1)[:, :, :units]
        return sides.flatten(2).mT

    def weights(self, factors: Float64[Tensor, "dof factors inputs"]) -> Float64[Tensor, " weights"]:
        """Weights of the products that product units of order 2 add up to: the inverse of `factors`."""
        first, second = self.pairs
        M = factors[:, 0::2].mT @ factors[:, 1::2]
        return (M + M.mT)[:, first, second].flatten()
