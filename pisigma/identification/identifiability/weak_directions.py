"""Directions of the parameters that the data hardly see, in words."""

from dataclasses import replace

import torch
from torch import Tensor

from pisigma.identification.problem.least_squares import Linearisation
from pisigma.identification.problem.noise import view_of
from pisigma.identification.problem.problem import CalibrationProblem

ROUNDING = 1e-12
"""Information of less than this share of the largest cannot be told from none."""
SHOWN = 0.25
"""Parameters with at least this share of a direction are named."""


def find_weak_directions(problem: CalibrationProblem, here: Linearisation[Tensor]) -> tuple[str, ...]:
    """Find directions of the free arm parameters that the data tell less well than the prior does.

    Base and tool are marginalised: what they can mimic does not count as seen. The directions are
    eigenvectors of the data's information in units of the prior's standard deviations (1 mm and 1 mrad
    where there is none).

    Args:
        problem: with its free parameters.
        here: its linearisation at the solution.
    """
    view, stated = view_of(here), problem.precision[problem.active]
    precision = view.widened(stated, problem.prior_group)
    held = bool((precision > 0).any())
    data = here.normal - torch.diag(precision)
    wide = replace(view, prior_scale=tuple(max(factor, 1.0) for factor in view.prior_scale))
    precision = wide.widened(stated, problem.prior_group)
    usual = torch.where(precision > 0, precision.clamp(min=1e-30).rsqrt(), problem.step_scale)
    data = data * usual * usual[:, None]
    arm = problem.active < problem.space.arm_size
    if not bool(arm.any()):
        return ()
    cross = data[arm][:, ~arm]
    seen = (
        data[arm][:, arm]
        - cross @ torch.linalg.pinv(data[~arm][:, ~arm], rtol=1e-12, hermitian=True) @ cross.mT
    )
    values, vectors = torch.linalg.eigh((seen + seen.mT) / 2)
    names = [problem.space.names[i] for i in problem.active[arm].tolist()]
    end = "it stays near its nominal value" if held else "without a prior it may be anything"
    sentences = []
    rounding = ROUNDING * float(values[-1])
    for value, vector in zip(values.tolist(), vectors.t(), strict=True):
        if value >= max(1.0, rounding):
            break
        width = value**-0.5 if value > max(1e-12, rounding) else float("inf")
        sentences.append(
            f"{_in_words(vector, names)}: the data tell it only to {width:.2g} times its tolerance; {end}"
        )
    return tuple(sentences)


def _in_words(vector: Tensor, names: list[str]) -> str:
    """The large parts of a direction, in units of the tolerances."""
    order = vector.abs().argsort(descending=True).tolist()
    sign = 1.0 if float(vector[order[0]]) > 0 else -1.0
    text = ""
    for index in order:
        part = sign * float(vector[index])
        if text and abs(part) < SHOWN:
            break
        term = names[index] if abs(part) > 0.97 else f"{abs(part):.2f} {names[index]}"
        text += f" {'-' if part < 0 else '+'} {term}" if text else term
    return text
