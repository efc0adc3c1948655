"""Normal priors of unknowns, in groups with a common scale."""

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
    """Independent normal unknowns: precision `unit_precision / group_scales[group]²`.

    Attributes:
        unit_precision: 1 / variance at scale 1; 0 without a prior.
        group: index in `group_scales` of every unknown.
        group_scales: standard deviation of the unknowns of every group with `unit_precision` 1.
        geometric_class_count: number of leading groups that are classes of geometric parameters. Their scales, which
            are factors on the stated standard deviations, remain as estimated by the geometric calibration: over a
            narrow joint range, low harmonics resemble geometry, and if they could replace it, the arm would be wrong
            beyond this range.
    """

    unit_precision: Float64[Tensor, " unknowns"]
    group: Int64[Tensor, " unknowns"]
    group_scales: Float64[Tensor, " groups"]
    geometric_class_count: int

    @property
    def precision(self) -> Float64[Tensor, " unknowns"]:
        """Prior precision of every unknown, 1 / variance."""
        return self.unit_precision / self.group_scales[self.group].square()

    def sum_by_group(self, values: Float64[Tensor, " unknowns"]) -> Float64[Tensor, " groups"]:
        """Return the sum of values over the unknowns of every group; unknowns without a prior are excluded."""
        return torch.zeros_like(self.group_scales).index_add(
            0, self.group, values * (self.unit_precision > 0)
        )

    def updated(
        self, squared_unknowns: Float64[Tensor, " groups"], determined_unknowns: Float64[Tensor, " groups"]
    ) -> "GaussianPrior":
        """Update the sizes by MacKay's rule (1992, Neural Computation 4(3), eq. 4.7): size² = Σ p x² / Σ determined.

        p is `unit_precision`.

        The rule approaches its fixed point from one side in ever shorter steps and is therefore over-relaxed.
        """
        sizes = (squared_unknowns.clamp(min=0.0) / determined_unknowns.clamp(min=1e-12)).sqrt()
        sizes = (self.group_scales * (sizes / self.group_scales) ** _RELAXATION).clamp(min=SMALLEST_SIZE)
        is_fixed = (determined_unknowns <= 1e-9) | (
            torch.arange(len(sizes), device=sizes.device) < self.geometric_class_count
        )
        return replace(self, group_scales=torch.where(is_fixed, self.group_scales, sizes))
