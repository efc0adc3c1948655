"""Rows that belong together: equal joint values, and the two rows of a pair."""

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.measurement.dataset import Measurements


def groups_of_equal_joints(q: Float64[Tensor, "rows dof"]) -> Int64[Tensor, " rows"]:
    """Number the different joint vectors in the order of their first row.

    Args:
        q: joint values [rad or m]; two rows belong together where they are exactly equal.

    Returns:
        For every row the number of its group, from 0.
    """
    if q.shape[0] == 0:
        return torch.zeros(0, dtype=torch.int64, device=q.device)
    return _numbered(torch.unique(q + 0.0, dim=0, return_inverse=True)[1])  # -0.0 becomes 0.0


def groups_to_keep_whole(measurements: Measurements) -> Int64[Tensor, " rows"]:
    """Number the groups of rows that training and test must not part, in the order of their first row.

    Rows of equal joint values belong together, and so do the two rows of a pair and everything that either of
    them belongs to.

    Args:
        measurements: the rows.

    Returns:
        For every row the number of its group, from 0.
    """
    group = groups_of_equal_joints(measurements.q)
    if measurements.pair is None:
        return group
    numbers = group.tolist()
    leader = list(range(max(numbers) + 1))

    def lead(number: int) -> int:
        while leader[number] != number:
            leader[number] = leader[leader[number]]
            number = leader[number]
        return number

    first: dict[str, int] = {}
    for row, name in enumerate(measurements.pair):
        if name:
            leader[lead(numbers[row])] = lead(numbers[first.setdefault(name, row)])
    return _numbered(torch.tensor([lead(number) for number in numbers], device=group.device))


def _numbered(label: Int64[Tensor, " rows"]) -> Int64[Tensor, " rows"]:
    """Equal labels as numbers from 0, in the order in which they appear."""
    values, group = torch.unique(label, return_inverse=True)
    rows = torch.arange(len(label), device=label.device)
    first = torch.full((len(values),), len(label), device=label.device).scatter_reduce(0, group, rows, "amin")
    return first.argsort().argsort()[group]
