"""Square root R of the covariance of all unknowns, `C = R R^T`, and of unknowns conditioned on linear equations."""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.estimation.rounded_root import RoundedRoot


@dataclass(frozen=True, eq=False)
class ImplicitCovarianceRoot:
    """Covariance root of the weights after n values: `D (I - Z^T L^-T (L + 1)^-1 Z)` with `L L^T = Z Z^T + 1`.

    Its product with its transpose is `D (Z^T Z + 1)^-1 D`: this is the update of Andrews 1968 (AIAA Journal 6(6),
    1165-1166) for all values at once.

    Attributes:
        prior_sigma: prior standard deviation of every weight, the diagonal of D.
        Z: derivatives of the values with respect to the weights, multiplied by D and divided by the noise.
        factor: L, lower triangular.
    """

    prior_sigma: Float64[Tensor, " weights"]
    Z: Float64[Tensor, "values weights"]
    factor: Float64[Tensor, "values values"]

    def left_multiply(self, columns: Float64[Tensor, "*batch weights"]) -> Float64[Tensor, "*batch weights"]:
        """Return the product `columns @ root`."""
        scaled = columns.flatten(0, -2) * self.prior_sigma
        once = self.factor + torch.eye(len(self.factor)).to(self.factor)
        inner = torch.linalg.solve_triangular(self.factor, self.Z @ scaled.t(), upper=False)
        inner = torch.linalg.solve_triangular(once.t(), inner, upper=True)
        result: Tensor = scaled - inner.t() @ self.Z
        return result.reshape(columns.shape)

    def right_multiply(
        self, matrix: Float64[Tensor, "weights columns"]
    ) -> Float64[Tensor, "weights columns"]:
        """Return the product `root @ matrix`."""
        once = self.factor + torch.eye(len(self.factor)).to(self.factor)
        inner = torch.linalg.solve_triangular(once, self.Z @ matrix, upper=False)
        inner = torch.linalg.solve_triangular(self.factor.t(), inner, upper=True)
        result: Tensor = self.prior_sigma[:, None] * (matrix - self.Z.t() @ inner)
        return result


def multiply_updated_root(
    columns: Float64[Tensor, "*batch directions"], B: Float64[Tensor, "values directions"]
) -> Float64[Tensor, "*batch directions"]:
    """Return `A R'` for the root R' after a measurement of any values: `A R L^-T` with `L L^T = 1 + B^T B`.

    Args:
        columns: `A R` with the root R before the measurement.
        B: derivatives of the values along the columns of R, divided by the noise of the values.
    """
    lower = torch.linalg.cholesky(torch.eye(B.shape[1]).to(B) + B.t() @ B)
    after: Tensor = torch.linalg.solve_triangular(lower, columns.flatten(0, -2).t(), upper=False).t()
    return after.reshape(columns.shape)


@dataclass(frozen=True, eq=False)
class CovarianceRoot:
    """Covariance root R, with columns for all unknowns and optionally columns, in factors, for the weights only.

    Attributes:
        directions: columns of R for all unknowns.
        weights: additional columns, which are 0 for the parameters; None if there are none.
        rounded: form of R that a model folder stores instead of R and from which R was made; None if R is stored.
    """

    directions: Float64[Tensor, "unknowns directions"]
    weights: ImplicitCovarianceRoot | None = None
    rounded: RoundedRoot | None = None

    @staticmethod
    def from_rounded(rounded: RoundedRoot) -> "CovarianceRoot":
        """Make R from its rounded form."""
        return CovarianceRoot(rounded.as_matrix, rounded=rounded)

    @cached_property
    def as_matrix(self) -> Float64[Tensor, "unknowns directions"]:
        """R as a matrix."""
        if self.weights is None:
            return self.directions
        count = len(self.weights.prior_sigma)
        below = self.weights.left_multiply(torch.eye(count).to(self.directions))
        above = self.directions.new_zeros((len(self.directions) - count, count))
        return torch.cat([self.directions, torch.cat([above, below])], 1)

    def left_multiply(
        self, columns: Float64[Tensor, "*batch unknowns"]
    ) -> Float64[Tensor, "*batch directions"]:
        """Return the product `columns @ R`."""
        # one product of two matrices, because torch would read R once for every row of a non-contiguous view
        result = columns.flatten(0, -2) @ self.directions
        if self.weights is not None:
            first = self.directions.shape[0] - len(self.weights.prior_sigma)
            result = torch.cat([result, self.weights.left_multiply(columns.flatten(0, -2)[:, first:])], -1)
        return result.reshape(*columns.shape[:-1], result.shape[-1])

    def covariance_times(
        self, matrix: Float64[Tensor, "unknowns columns"]
    ) -> Float64[Tensor, "unknowns columns"]:
        """Return the product `C @ matrix` with the covariance C."""
        result = self.directions @ (self.directions.t() @ matrix)
        if self.weights is not None:
            first = len(result) - len(self.weights.prior_sigma)
            result[first:] += self.weights.right_multiply(self.weights.left_multiply(matrix[first:].t()).t())
        return result

    def with_columns(
        self,
        added: Float64[Tensor, "unknowns columns"],
        sigma_factor: float,
        coordinate_change: Float64[Tensor, "parameters active"],
    ) -> "CovarianceRoot":
        """Return a root with more columns, scaled standard deviations, and the first unknowns in other coordinates.

        Args:
            added: columns to add.
            sigma_factor: factor on the standard deviations.
            coordinate_change: matrix that converts the first unknowns to the other coordinates.
        """
        (parameters, active), (unknowns, columns) = coordinate_change.shape, self.directions.shape
        directions = coordinate_change.new_empty((parameters + unknowns - active, columns + added.shape[1]))
        for block, place in ((self.directions, slice(columns)), (added, slice(columns, None))):
            directions[:parameters, place] = coordinate_change @ block[:active].cpu()
            directions[parameters:, place] = block[active:]
        directions.mul_(sigma_factor)
        few = self.weights
        return CovarianceRoot(
            directions, None if few is None else replace(few, prior_sigma=few.prior_sigma * sigma_factor)
        )


@dataclass(frozen=True, eq=False)
class ConditionedUnknowns:
    """Unknowns z with a standard normal prior and x without a prior, given `B z + G x + e = r`.

    Attributes:
        z: most probable z.
        x: most probable x.
        z_root: root of the covariance of z, in the directions (z, e) of the prior.
        x_root: root of the covariance of x, in the same directions.
        misfit: `|z|² + |e|²` at the solution, which has a chi-squared distribution.
        degrees_of_freedom: degrees of freedom of the misfit, the number of equations that x does not absorb.
    """

    z: Float64[Tensor, " directions"]
    x: Float64[Tensor, " unknowns"]
    z_root: Float64[Tensor, "directions prior"]
    x_root: Float64[Tensor, "unknowns prior"]
    misfit: float
    degrees_of_freedom: int


def condition_on_equalities(
    B: Float64[Tensor, "equations directions"],
    G: Float64[Tensor, "equations unknowns"],
    r: Float64[Tensor, " equations"],
    equation_sigma: Float64[Tensor, " equations"],
) -> ConditionedUnknowns:
    """Condition a standard normal z on `B z + G x + e = r`: least squares for x with the covariance of the equations.

    With `C = B B^T + E²` and `M = (G^T C^-1 G)^-1 G^T C^-1`, `x = M r` and `z = B^T C^-1 (r - G x)` (Koch 1999,
    Parameter Estimation and Hypothesis Testing in Linear Models, section 3.5). x then has the covariance
    `(G^T C^-1 G)^-1`.

    Args:
        B: derivatives of the equations with respect to z.
        G: derivatives with respect to x, of full column rank.
        r: misclosure of the equations at z = 0 and x = 0.
        equation_sigma: standard deviation > 0 of e, with which the equations hold. It also keeps C positive definite if
            the prior of the values on both sides is exact.
    """
    E = equation_sigma.diag()
    along = torch.cat([B, E], 1)
    # QR of the transposed root instead of the Cholesky factor of C, which has the square of its condition number.
    half = torch.linalg.qr(along.mT, mode="r").R
    whiten = torch.linalg.solve_triangular(half.mT, torch.cat([G, r[:, None], along], 1), upper=False)
    count = G.shape[1]
    G_white, r_white, along_white = whiten[:, :count], whiten[:, count], whiten[:, count + 1 :]
    Q, R = torch.linalg.qr(G_white)
    x_root = torch.linalg.solve_triangular(R, Q.mT @ along_white, upper=True)
    x = torch.linalg.solve_triangular(R, (Q.mT @ r_white)[:, None], upper=True)[:, 0]
    missed = r_white - Q @ (Q.mT @ r_white)
    # Projection onto the directions that the redundant equations determine.
    seen = along_white - Q @ (Q.mT @ along_white)
    size = B.shape[1]
    z_root = torch.eye(along.shape[1]).to(B)[:size] - along_white[:, :size].mT @ seen
    return ConditionedUnknowns(
        along_white[:, :size].mT @ missed, x, z_root, -x_root, float(missed.square().sum()), len(r) - count
    )
