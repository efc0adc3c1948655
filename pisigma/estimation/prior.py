"""Normal priors of unknowns, in groups with a common size."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

SMALLEST_SIZE = 1e-9
"""Prior scale [rad] below which a group of weights is excluded."""
FIRST_SIZE = 2e-5
"""Initial prior standard deviation of weights [rad]."""
_RELAXATION = 1.5
"""Over-relaxation of MacKay's rule, in logarithms; above about 1.8 it overshoots."""


@dataclass(frozen=True, eq=False)
class GaussianPrior:
    """Independent normal unknowns: precision `unit_precision / sizes[group]²`.

    Attributes:
        unit_precision: 1 / variance at size 1; 0 without a prior.
        group: index in `sizes` of every unknown.
        sizes: standard deviation of the unknowns of every group with `unit_precision` 1.
        class_count: number of leading groups that are classes of geometric parameters. Their sizes, which are factors
            on the stated sizes, remain as estimated by the geometric calibration: over a narrow joint range, low
            harmonics resemble geometry, and if they could replace it, the arm would be wrong beyond this range.
    """

    unit_precision: Float64[Tensor, " unknowns"]
    group: Int64[Tensor, " unknowns"]
    sizes: Float64[Tensor, " groups"]
    class_count: int

    @property
    def precision(self) -> Float64[Tensor, " unknowns"]:
        """Prior precision of every unknown, 1 / variance."""
        return self.unit_precision / self.sizes[self.group].square()

    def sum_by_group(self, values: Float64[Tensor, " unknowns"]) -> Float64[Tensor, " groups"]:
        """Return the sum of values over the unknowns of every group; unknowns without a prior are excluded."""
        return torch.zeros_like(self.sizes).index_add(0, self.group, values * (self.unit_precision > 0))

    def updated(
        self, squared_unknowns: Float64[Tensor, " groups"], determined_unknowns: Float64[Tensor, " groups"]
    ) -> "GaussianPrior":
        """Update the sizes by MacKay's rule (1992, Neural Computation 4(3), eq. 4.7): size² = Σ p x² / Σ determined.

        p is `unit_precision`.

        The rule approaches its fixed point from one side in ever shorter steps and is therefore over-relaxed.
        """
        sizes = (squared_unknowns.clamp(min=0.0) / determined_unknowns.clamp(min=1e-12)).sqrt()
        sizes = (self.sizes * (sizes / self.sizes) ** _RELAXATION).clamp(min=SMALLEST_SIZE)
        is_fixed = (determined_unknowns <= 1e-9) | (
            torch.arange(len(sizes), device=sizes.device) < self.class_count
        )
        return replace(self, sizes=torch.where(is_fixed, self.sizes, sizes))
