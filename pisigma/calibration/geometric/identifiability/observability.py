"""Observability of parameters by a set of poses: observability indices O1 to O5, and weak directions."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.geometric.problem.least_squares import Linearisation
from pisigma.calibration.geometric.problem.noise import contributions_and_noise_of
from pisigma.calibration.geometric.problem.problem import CalibrationProblem

_ROUNDING = 1e-12
"""Ratio of an eigenvalue of the information to the largest one below which it is zero up to rounding."""
_SHOWN = 0.25
"""Size of a component of a direction above which the sentence names its parameter."""


@dataclass(frozen=True)
class Observability:
    """Observability indices of the free parameters, from the singular values s_1 ≥ ... ≥ s_L of their Jacobian.

    Parameters are in mm and mrad, positions in mm and rotations in mrad; the Jacobian is not divided by the noise.

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
    """Compute the indices from a Gram matrix `J^T J`; all are 0 if the data do not determine every parameter.

    Args:
        gram: Gram matrix of the Jacobian, scaled as in `Observability`.
        poses: number of measured rows.
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


def find_weak_directions(
    problem: CalibrationProblem, linearisation: Linearisation[Tensor]
) -> tuple[str, ...]:
    """Return a sentence for every direction of the free arm parameters that the prior determines better than the data.

    Base and tool are marginalised. The directions are eigenvectors of the data's information in units of the prior
    standard deviations (1 mm and 1 mrad if there is no prior).

    Args:
        problem: the problem with its free parameters.
        linearisation: linearisation of the problem at the solution.
    """
    view, stated = contributions_and_noise_of(linearisation), problem.precision[problem.active]
    precision = view.scaled_precision(stated, problem.prior_group)
    held = bool((precision > 0).any())
    data = linearisation.normal - torch.diag(precision)
    wide = replace(view, prior_scale=view.prior_scale.clamp(min=1.0))
    precision = wide.scaled_precision(stated, problem.prior_group)
    usual = torch.where(precision > 0, precision.clamp(min=1e-30).rsqrt(), problem.step_scale)
    data = data * usual * usual[:, None]
    arm = problem.active < problem.space.arm_parameter_count
    if not bool(arm.any()):
        return ()
    # The Schur complement is the information on the arm with base and tool marginalised.
    cross = data[arm][:, ~arm]
    schur = (
        data[arm][:, arm]
        - cross @ torch.linalg.pinv(data[~arm][:, ~arm], rtol=1e-12, hermitian=True) @ cross.mT
    )
    values, vectors = torch.linalg.eigh((schur + schur.mT) / 2)
    names = [problem.space.names[i] for i in problem.active[arm].tolist()]
    end = "it stays near its nominal value" if held else "without a prior it is undetermined"
    sentences = []
    rounding = _ROUNDING * float(values[-1])
    for value, vector in zip(values.tolist(), vectors.t(), strict=True):
        if value >= max(1.0, rounding):
            break
        width = value**-0.5 if value > max(1e-12, rounding) else float("inf")
        sentences.append(
            f"{direction_in_words(vector, names)}: the data determine it only to {width:.2g} times its tolerance; {end}"
        )
    return tuple(sentences)


def direction_in_words(vector: Tensor, names: list[str]) -> str:
    """Return a text with the large components of a direction, in units of the tolerances."""
    order = vector.abs().argsort(descending=True).tolist()
    sign = 1.0 if float(vector[order[0]]) > 0 else -1.0
    text = ""
    for index in order:
        part = sign * float(vector[index])
        if text and abs(part) < _SHOWN:
            break
        term = names[index] if abs(part) > 0.97 else f"{abs(part):.2f} {names[index]}"
        text += f" {'-' if part < 0 else '+'} {term}" if text else term
    return text
