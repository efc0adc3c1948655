"""Observability indices O1 to O5 of a set of poses."""

from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor


@dataclass(frozen=True)
class Observability:
    """How well poses tell the chosen parameters: from the singular values s_1 ≥ ... ≥ s_L of their Jacobian.

    The scaling: parameters in mm and mrad, positions in mm, rotations in mrad; the Jacobian is not divided
    by noise.

    Attributes:
        O1: `(s_1 · ... · s_L)^(1/L) / sqrt(poses)` (Borm and Menq 1991).
        O2: `s_L / s_1`, the inverse condition number (Driels and Pathre 1990).
        O3: `s_L` (Nahvi et al. 1994).
        O4: `s_L² / s_1`, the noise amplification index (Nahvi and Hollerbach 1996).
        O5: `1 / (1/s_1 + ... + 1/s_L)` (Sun and Hollerbach 2008).
    """

    O1: float
    O2: float
    O3: float
    O4: float
    O5: float

    @property
    def condition_number(self) -> float:
        """`s_1 / s_L`."""
        return float("inf") if self.O2 == 0 else 1 / self.O2


def observability_of(gram: Float64[Tensor, "chosen chosen"], poses: int) -> Observability:
    """The indices for the parameters of a Gram matrix `J^T J`; all 0 where the data do not see one of them.

    Args:
        gram: of the Jacobian scaled as said above.
        poses: number of rows measured.
    """
    square = torch.linalg.eigvalsh(gram).flip(0)
    if len(square) == 0 or float(square[-1]) <= 1e-15 * float(square[0]):
        return Observability(0.0, 0.0, 0.0, 0.0, 0.0)
    s = square.sqrt()
    return Observability(
        O1=float(s.log().mean().exp()) / poses**0.5,
        O2=float(s[-1] / s[0]),
        O3=float(s[-1]),
        O4=float(s[-1] ** 2 / s[0]),
        O5=float(1 / (1 / s).sum()),
    )
