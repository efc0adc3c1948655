"""Several data sets as one: files or simulations of different sensors."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from pisigma.errors import MeasurementError
from pisigma.measurement.consistency import NUMBERS, TEXTS, row_shape
from pisigma.measurement.dataset import Measurements


def join(parts: Sequence[Measurements]) -> Measurements:
    """All rows of several data sets, in their order; what a part lacks is NaN or "" in its rows.

    Frames, targets, sockets, anchors and pairs of one name are taken for the same.

    Args:
        parts: one or more, of robots with equally many joints.

    Raises:
        MeasurementError: there is no part, numbers of joints differ, only some parts say which rows are for
            the test, or rows contradict each other.
    """
    if not parts:
        raise MeasurementError("join: one or more data sets were wanted, got none.")
    dofs = sorted({part.dof for part in parts})
    if len(dofs) > 1:
        raise MeasurementError(
            f"join: data sets of {dofs[0]} and of {dofs[-1]} joints cannot be joined; give "
            "those of one robot."
        )
    if len({part.split is None for part in parts if part.rows}) > 1:
        raise MeasurementError(
            "join: some data sets have a split and some have none; give it to all or to none."
        )
    joined: dict[str, Any] = {"q": torch.cat([part.q for part in parts])}
    for name in NUMBERS:
        if any(getattr(part, name) is not None for part in parts):
            shape = row_shape(name, dofs[0])
            joined[name] = torch.cat([_filled(part, name, shape) for part in parts])
    for name in (*TEXTS, "line"):
        if name != "split" or parts[0].split is not None:
            joined[name] = tuple(text for part in parts for text in getattr(part, name) or ("",) * part.rows)
    sources = dict.fromkeys(part.source for part in parts)
    left_out = tuple(row for part in parts for row in part.left_out)
    return Measurements(**joined, source=" + ".join(sources), left_out=left_out)


def _filled(part: Measurements, name: str, shape: tuple[int, ...]) -> Tensor:
    values = getattr(part, name)
    if values is None:
        return part.q.new_full((part.rows, *shape), torch.nan)
    filled: Tensor = values
    return filled
