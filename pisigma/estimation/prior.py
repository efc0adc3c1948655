"""Normal priors of unknowns, in groups of one size each."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

SMALLEST_SIZE = 1e-9
"""Prior size [rad] below which a group of weights is off."""
FIRST_SIZE = 2e-5
"""Prior size [rad] that weights start with."""
RELAXATION = 1.5
"""Steps of MacKay's rule are longer by this, in logarithms; from about 1.8 on they overshoot."""


@dataclass(frozen=True, eq=False)
class GaussianPrior:
    """Independent normal unknowns: precision `base / sizes[group]²`.

    Attributes:
        base: 1 / variance at size 1; 0 where there is no prior knowledge.
        group: number of every unknown's size.
        sizes: standard deviations.
        classes: the first so many groups are classes of geometric parameters. Their sizes, factors on what was
            stated, stand as the geometric calibration found them: over a narrow range of a joint low harmonics look
            like geometry, and where they may take its part the arm errs beyond that range.
    """

    base: Float64[Tensor, " unknowns"]
    group: Int64[Tensor, " unknowns"]
    sizes: Float64[Tensor, " groups"]
    classes: int

    @property
    def precision(self) -> Float64[Tensor, " unknowns"]:
        """1 / variance."""
        return self.base / self.sizes[self.group].square()

    def of_groups(self, values: Float64[Tensor, " unknowns"]) -> Float64[Tensor, " groups"]:
        """Sum over the unknowns of every group of which there is prior knowledge."""
        return torch.zeros_like(self.sizes).index_add(0, self.group, values * (self.base > 0))

    def updated(
        self, square: Float64[Tensor, " groups"], determined: Float64[Tensor, " groups"]
    ) -> "GaussianPrior":
        """Sizes by MacKay's rule (1992, Neural Computation 4(3), eq. 4.7), `size² = Σ x² base / Σ determined`.

        As the rule comes near to its fixed point from one side, in ever shorter steps, these are lengthened.
        """
        sizes = (square.clamp(min=0.0) / determined.clamp(min=1e-12)).sqrt()
        sizes = (self.sizes * (sizes / self.sizes) ** RELAXATION).clamp(min=SMALLEST_SIZE)
        stands = (determined <= 1e-9) | (torch.arange(len(sizes), device=sizes.device) < self.classes)
        return replace(self, sizes=torch.where(stands, self.sizes, sizes))
