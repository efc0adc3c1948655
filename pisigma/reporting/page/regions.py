"""Where errors are largest: by place, by joint value, by name."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from pisigma.judging.rank_tests import SIGNIFICANT, groups_differ

CELLS = 4
"""Parts of the measured space along every axis."""
BINS = 12
"""Parts of a joint's measured values."""
LEAST_ROWS = 8
"""Fewer rows say too little of a region."""


@dataclass(frozen=True)
class Region:
    """The part of the space with the largest errors.

    Attributes:
        low: its corner [m].
        high: the opposite corner [m].
        rows: how many are in it.
        rms: of their errors.
        ratio: RMS over that of all rows.
        significant: whether errors there are larger than elsewhere more than by chance.
    """

    low: tuple[float, ...]
    high: tuple[float, ...]
    rows: int
    rms: float
    ratio: float
    significant: bool


def root_mean_square(values: Float64[np.ndarray, " values"]) -> float:
    """Root mean square; NaN of nothing."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else math.nan


def worst_region(place: Float64[np.ndarray, "rows 3"], errors: Float64[np.ndarray, " rows"]) -> Region | None:
    """The cell of a grid over the places whose errors are largest for sure.

    Args:
        place: of every row [m].
        errors: their lengths, all finite.

    Returns:
        None where there are too few rows, or all are in one cell.
    """
    low, high = (place.min(0), place.max(0)) if len(place) else (np.zeros(3), np.zeros(3))
    width = np.where(high > low, (high - low) / CELLS, 1.0)
    cell = np.clip(((place - low) / width).astype(int), 0, CELLS - 1)
    number = (cell * [CELLS * CELLS, CELLS, 1]).sum(1)
    best: tuple[float, int] | None = None
    counted = [(k, errors[number == k]) for k in np.unique(number)]
    counted = [(k, own) for k, own in counted if len(own) >= max(LEAST_ROWS, len(errors) // 100)]
    if len(counted) < 2:
        return None
    for k, own in counted:
        surely = root_mean_square(own) * (1 - 1 / math.sqrt(len(own)))
        best = max(best, (surely, int(k))) if best else (surely, int(k))
    assert best is not None
    inside = number == best[1]
    _, chance = groups_differ(inside.astype(int), errors)
    corner = low + width * cell[inside][0]
    rms = root_mean_square(errors[inside])
    return Region(
        tuple(corner.tolist()),
        tuple((corner + width).tolist()),
        int(inside.sum()),
        rms,
        rms / root_mean_square(errors),
        chance < SIGNIFICANT / len(counted),
    )


@dataclass(frozen=True, eq=False)
class Binned:
    """Errors in parts of a quantity's values.

    Attributes:
        edges: of the parts, one more than there are parts.
        rms: of every part; NaN where there are too few rows.
        number: of every row, in which part it is.
    """

    edges: Float64[np.ndarray, " edges"]
    rms: Float64[np.ndarray, " bins"]
    number: Int64[np.ndarray, " rows"]


def binned(
    values: Float64[np.ndarray, " rows"], errors: Float64[np.ndarray, " rows"], bins: int = BINS
) -> Binned:
    """Errors in parts of equal width; of few rows in fewer parts."""
    bins = int(np.clip(len(values) // LEAST_ROWS, 1, bins))
    low, high = float(values.min()), float(values.max())
    edges = np.linspace(low, high if high > low else low + 1.0, bins + 1)
    number = np.clip(np.searchsorted(edges, values, "right") - 1, 0, bins - 1)
    parts = [errors[number == k] for k in range(bins)]
    rms = [root_mean_square(part) if len(part) >= 3 else math.nan for part in parts]
    return Binned(edges, np.array(rms), number)
