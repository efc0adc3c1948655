"""Number rows that repeat a pose."""

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.calibration.geometric.problem.noise import renumber

_MULTIPLIER, _FACTOR = 6_364_136_223_846_793_005, 1_442_695_040_888_963_407
"""Constants of the linear congruential generator that hashes joint values (Knuth, MMIX)."""


def number_repeats(q: Tensor, *names: Tensor) -> Tensor | None:
    """Return an index for every row that is equal for equal joint values (with payload, to 1e-9) and names.

    Returns:
        The indices; None if all rows differ.
    """
    numbers = renumber(_mixed_keys(q, *names))
    return None if int(numbers.max()) + 1 == len(q) else numbers


def _mixed_keys(q: Float64[Tensor, "rows dof"], *names: Tensor) -> Int64[Tensor, " rows"]:
    """Return a hash of every row's joint values (to 1e-9) and names."""
    keys, dof = (q * 1e9).round().long(), q.shape[1]
    factors = [_FACTOR * pow(_MULTIPLIER, dof - 1 - joint, 2**64) for joint in range(dof)]
    signed = [(factor + 2**63) % 2**64 - 2**63 for factor in factors]
    mixed: Tensor = (keys * torch.tensor(signed, device=q.device)).sum(1)  # integers wrap around
    for name in names:
        mixed = mixed * _MULTIPLIER + name * _FACTOR
    return mixed
