"""Solutions of many poses while they are being found."""

from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor


@dataclass(frozen=True, eq=False)
class FastRows:
    """What became of poses.

    Attributes:
        done: whether a pose is solved; elsewhere the other values are of no use.
        lost: whether it is known that a branch does not lead there.
        q: joint values to command [rad].
        q_nominal: those of the nominal arm, on the same turns.
        branch: index of the branch.
        status: a `Status`.
        measure: of the domain; NaN without a learned correction.
    """

    done: Bool[Tensor, " poses"]
    lost: Bool[Tensor, " poses"]
    q: Float64[Tensor, "poses dof"]
    q_nominal: Float64[Tensor, "poses dof"]
    branch: Int64[Tensor, " poses"]
    status: Int64[Tensor, " poses"]
    measure: Float64[Tensor, " poses"]

    @staticmethod
    def none(poses: int, dof: int) -> "FastRows":
        """Nothing solved yet."""
        nan = torch.full((poses, dof), torch.nan, dtype=torch.float64)
        zero = torch.zeros(poses, dtype=torch.int64)
        return FastRows(zero.bool(), zero.bool(), nan, nan.clone(), zero, zero.clone(), nan[:, 0].clone())

    def put(self, rows: Tensor, other: "FastRows") -> None:
        """Take other solutions over at some rows."""
        for field in fields(self):
            getattr(self, field.name)[rows] = getattr(other, field.name)

    def select(self, rows: Tensor | slice) -> "FastRows":
        """Some of the rows."""
        return FastRows(*(getattr(self, field.name)[rows] for field in fields(self)))
