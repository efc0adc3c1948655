"""Observability indices O1 to O5 of a set of poses."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from pisigma.identification.information import Information


@dataclass(frozen=True)
class Observability:
    """How well a set of poses tells the chosen parameters, by the singular values s_1 ≥ ... ≥ s_L of their Jacobian.

    The scaling: parameters in mm and mrad, positions in mm, rotations in mrad; the Jacobian is not divided by noise.

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


def observability_of(information: Information, names: tuple[str, ...]) -> Observability:
    """The indices for the named parameters; all 0 where the data do not see one of them."""
    columns = [information.names.index(name) for name in names]
    J: Float64[np.ndarray, "rank chosen"] = information.jacobian[:, columns]
    s = np.linalg.svd(J, compute_uv=False)
    if len(s) < len(columns) or len(s) == 0 or s[-1] <= 1e-12 * s[0]:
        return Observability(0.0, 0.0, 0.0, 0.0, 0.0)
    return Observability(
        O1=float(np.exp(np.log(s).mean()) / np.sqrt(information.poses)),
        O2=float(s[-1] / s[0]),
        O3=float(s[-1]),
        O4=float(s[-1] ** 2 / s[0]),
        O5=float(1 / (1 / s).sum()),
    )
