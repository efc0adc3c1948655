"""Test cube in the workspace, and its five poses."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float64
from torch import Tensor
from torch.nn.functional import pad

from pisigma.files.errors import MeasurementError, check_choice

PLANES = {
    "C1-C2-C7-C8": (0, 1, 6, 7),
    "C2-C3-C8-C5": (1, 2, 7, 4),
    "C3-C4-C5-C6": (2, 3, 4, 5),
    "C4-C1-C6-C7": (3, 0, 5, 6),
}
"""Corners of the diagonal planes of the cube (ISO 9283:1998, 6.8). C1 to C4 are around the upper face, C5 to C8
below them; the third corner of a plane is opposite the first, and the fourth opposite the second."""

_FROM_THE_ENDS = (0.08, 0.12)
"""Smallest and largest distance of P2 to P5 from the ends of the diagonals, (10 ± 2) % of their length (ISO
9283:1998, 6.8)."""


@dataclass(frozen=True, eq=False)
class IsoCube:
    """A cube with edges along the axes of the base.

    Attributes:
        centre: centre in the robot's base frame [m].
        edge: length of an edge [m].
    """

    centre: Float64[Tensor, " 3"]
    edge: float

    @property
    def corners(self) -> Float64[Tensor, "8 3"]:
        """C1 to C8 [m]: the upper face starting at (+x, +y), counterclockwise about z, then the lower face."""
        around = torch.tensor([[1, 1], [-1, 1], [-1, -1], [1, -1]], dtype=torch.float64)
        upper = torch.cat([around, torch.ones(4, 1, dtype=torch.float64)], 1)
        lower = torch.cat([around, -torch.ones(4, 1, dtype=torch.float64)], 1)
        return self.centre + self.edge / 2 * torch.cat([upper, lower])

    def test_positions(
        self, plane: str = "C1-C2-C7-C8", diagonal_fraction: float = 0.1
    ) -> Float64[Tensor, "5 3"]:
        """Compute the positions of P1 to P5 [m] (ISO 9283:1998, 6.8).

        P1 is the intersection of the diagonals of the plane, the centre of the cube; P2 to P5 are on the diagonals near
        the plane's corners, in their order.

        Args:
            plane: one of `PLANES`.
            diagonal_fraction: distance from the end of the diagonal, divided by its length, 0.08 to 0.12.

        Raises:
            MeasurementError: the plane is unknown, or the standard does not allow this fraction.
        """
        check_choice(MeasurementError, "plane", plane, PLANES)
        low, high = _FROM_THE_ENDS
        if not low <= diagonal_fraction <= high:
            raise MeasurementError(
                option="diagonal_fraction",
                expected=f"a share of {low:g} to {high:g} of the diagonal",
                value=diagonal_fraction,
            )
        ends = self.corners[list(PLANES[plane])]
        return torch.cat([self.centre[None], ends + diagonal_fraction * (ends.roll(2, 0) - ends)])


def largest_cube(
    reaches: Callable[[Float64[Tensor, "points 3"]], Bool[Tensor, " points"]],
    low: Float64[Tensor, " 3"],
    high: Float64[Tensor, " 3"],
    spacing: float,
) -> IsoCube:
    """Find the largest cube within the workspace with edges along the axes (ISO 9283:1998, 6.8).

    A cube is within the workspace if every point of a grid in it is reachable. Of several equally large cubes, the one
    nearest to the middle of the region is returned.

    Args:
        reaches: function that returns whether positions in the base frame [m] are reachable with the orientation under
            test.
        low: lowest corner of the region to search [m].
        high: highest corner of the region to search [m].
        spacing: spacing of the grid [m]; the edge of the cube is a multiple of the spacing.

    Raises:
        MeasurementError: not even a cube with an edge of `spacing` is within the workspace.
    """
    counts = [int(count) + 1 for count in ((high - low) / spacing + 1e-9).floor().tolist()]
    axes = [low[i] + spacing * torch.arange(count, dtype=torch.float64) for i, count in enumerate(counts)]
    points = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)
    inside = reaches(points.reshape(-1, 3)).reshape(counts)
    # A summed-volume table counts the reachable points of any box in constant time; the size is found by bisection.
    held = inside.long().cumsum(0).cumsum(1).cumsum(2)
    held = pad(held, (1, 0, 1, 0, 1, 0))
    fits, fails = 0, min(counts)
    while fails - fits > 1:
        cells = (fits + fails) // 2
        fits, fails = (cells, fails) if _full(held, cells).any() else (fits, cells)
    if not fits:
        raise MeasurementError(
            f"no cube with an edge of {spacing:g} m is within the workspace",
            option="spacing",
            value=spacing,
            remedy="search another region, with another orientation, or on a finer grid",
        )
    edge = fits * spacing
    centres = low + spacing * _full(held, fits).nonzero().double() + edge / 2
    middle = low + spacing * (torch.tensor(counts, dtype=torch.float64) - 1) / 2
    nearest = (centres - middle).square().sum(-1).argmin()
    return IsoCube(centres[nearest], edge)


def _full(held: Tensor, cells: int) -> Tensor:
    """Return the start of cubes of `cells` cells with only reachable grid points; `held` is the cumulative count."""
    k = cells + 1
    sums = held
    for axis in range(3):
        length = sums.shape[axis] - k
        sums = sums.narrow(axis, k, length) - sums.narrow(axis, 0, length)
    return sums == k**3
