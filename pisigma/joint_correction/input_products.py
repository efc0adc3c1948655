"""Feature of products of the inputs of different joints, and its conversion to product units of a Pi-Sigma network."""

from itertools import combinations

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from pisigma.joint_correction.feature import AbstractFeature, product_unit_inputs
from pisigma.measurement.conditions import JointState
from pisigma.robot.description import Robot


class InputProducts(AbstractFeature):
    """Products φ_a φ_b of two inputs of different joints, with one weight per product.

    With φ = `product_unit_inputs`, product units of order 2 express the sum `Σ_ab w_ab φ_a φ_b`. After the weights are
    fitted, the sum is converted to such units (see `factors`), which models contain.
    """

    name = "products"

    def __init__(self, robot: Robot) -> None:
        """Create the feature with all pairs of inputs of different joints."""
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
        """Return the products as columns, the same for every joint."""
        phi = product_unit_inputs(self.robot, state.q)
        first, second = self.pairs.to(phi.device)
        values = phi.index_select(-1, first) * phi.index_select(-1, second)
        return values.unsqueeze(-2).expand(*values.shape[:-1], len(self.used), values.shape[-1])

    def factors(self, weights: Float64[Tensor, " weights"]) -> Float64[Tensor, "dof factors inputs"]:
        """Convert the weights to factors of product units of order 2 with the same sum, two factors per unit.

        `Σ_ab w_ab φ_a φ_b = φ^T M φ` with a symmetric M. With its positive and negative eigenvalues λ and μ and their
        eigenvectors e and f, it is the sum over units of `λ (e·φ)² - |μ| (f·φ)² = (r·φ) (s·φ)` with
        r, s = √λ e ± √|μ| f. The number of units equals the number of eigenvalues of the more frequent sign.
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
        """Convert factors of product units of order 2 to weights of products; the inverse of `factors`."""
        first, second = self.pairs
        M = factors[:, 0::2].mT @ factors[:, 1::2]
        return (M + M.mT)[:, first, second].flatten()
