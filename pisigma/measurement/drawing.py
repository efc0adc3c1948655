"""Fewer rows of measurements: drawn at random, whole configurations at a time."""

from collections.abc import Sequence

import torch
from jaxtyping import Int64
from torch import Tensor

from pisigma.errors import MeasurementError
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.groups import groups_to_keep_whole
from pisigma.measurement.splits import TrainTest


def draw_rows(measurements: Measurements, rows: int, seed: int) -> Int64[Tensor, " _drawn"]:
    """Draw rows at random; those of equal joint values, and of a pair, come together.

    With one seed a smaller draw is part of every larger one.

    Args:
        measurements: to draw from.
        rows: how many are wanted; it is met as closely as whole configurations allow.
        seed: of the draw.

    Returns:
        Numbers of the rows in the order of the measurements.

    Raises:
        MeasurementError: there are fewer rows, or less than one is wanted.
    """
    if not 1 <= rows <= measurements.rows:
        raise MeasurementError(
            f"{measurements.source}: {rows} training rows were wanted, but there are {measurements.rows} to draw "
            f"from; ask for 1 to {measurements.rows}."
        )
    group = groups_to_keep_whole(measurements).cpu()
    sizes = torch.bincount(group)
    order = torch.randperm(len(sizes), generator=torch.Generator().manual_seed(seed))
    count = int((sizes[order].cumsum(0) - rows).abs().argmin()) + 1
    return torch.isin(group, order[:count]).nonzero()[:, 0].to(measurements.q.device)


def with_fewer(
    measurements: Measurements, parts: Sequence[TrainTest], rows: int, seed: int
) -> tuple[TrainTest, ...]:
    """Draw the training rows of every part of a cross-validation; its test rows stay. See `draw_rows`.

    Raises:
        MeasurementError: a part has fewer training rows.
    """
    return tuple((train[draw_rows(measurements.select(train), rows, seed)], test) for train, test in parts)
