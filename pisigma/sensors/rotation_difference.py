"""The turn from predicted to measured rotations, with the row index last."""

import torch
from jaxtyping import Float
from torch import Tensor

from pisigma.se3 import rotation_vector

NEARLY_OPPOSITE = -0.99
"""Cosine of the turn below which its axis comes from the symmetric part."""


def rotation_difference(
    measured: Float[Tensor, "3 3 rows"], predicted: Float[Tensor, "3 3 rows"]
) -> Float[Tensor, "3 rows"]:
    """Rotation vector of measured · predicted^T [rad], as `rotation_vector` has it.

    Of the product R only its trace and `R - R^T` are worked out, which tell every turn that is not nearly half
    a one: with m and p the columns of the rotations, the vector part of `R - R^T` is `Σ p × m`.
    """
    twice_sine_axis = torch.linalg.cross(predicted, measured, dim=0).sum(1)
    cosine = ((measured * predicted).sum((0, 1)) - 1) / 2
    if bool((cosine < NEARLY_OPPOSITE).any()):
        return rotation_vector(torch.einsum("ijn,kjn->nik", measured, predicted)).t()
    sine_square = twice_sine_axis.square().sum(0) / 4
    sine = sine_square.sqrt()
    factor = torch.where(sine_square > 1e-8, torch.atan2(sine, cosine) / (2 * sine), 0.5 + sine_square / 12)
    found: Tensor = twice_sine_axis * factor
    return found
