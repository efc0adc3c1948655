"""Where errors are largest: the worst row, and the worst region of the measured space."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from pisigma.validation.held_out.judged_rows import JudgedRows
from pisigma.validation.held_out.rank_tests import SIGNIFICANT, groups_differ
from pisigma.validation.report.dependence import MIN_ROWS, error_lengths, root_mean_square

CELLS = 4
"""Cells of the measured space along every axis."""


@dataclass(frozen=True)
class Region:
    """Cell of the measured space with the largest errors, in the robot's base frame.

    Attributes:
        low: lower corner [m].
        high: upper corner [m].
        rows: number of rows in it.
        rms: RMS of their errors, in the unit of the errors.
        ratio: `rms` over the RMS error of all rows.
        significant: whether errors in it are larger than elsewhere by more than chance.
    """

    low: tuple[float, ...]
    high: tuple[float, ...]
    rows: int
    rms: float
    ratio: float
    significant: bool


@dataclass(frozen=True)
class LargestErrors:
    """The worst row and the worst region of judged rows.

    Attributes:
        row: index of the row with the largest error.
        error: its error [`unit`].
        unit: "mm" of positions, "deg" of orientations.
        position: position of the tool at that row in the robot's base frame [m].
        region: the worst region; None if there are too few rows to compare regions.
    """

    row: int
    error: float
    unit: str
    position: tuple[float, ...]
    region: Region | None


def largest_errors(rows: JudgedRows) -> LargestErrors | None:
    """Find the worst row and the worst region; None if no error is known."""
    _, after, unit = error_lengths(rows)
    finite = np.isfinite(after)
    if not finite.any():
        return None
    place, errors = rows.place.numpy()[finite], after[finite]
    worst = int(errors.argmax())
    row = int(np.flatnonzero(finite)[worst])
    return LargestErrors(
        row, float(errors[worst]), unit, tuple(place[worst].tolist()), worst_region(place, errors)
    )


def worst_region(place: Float64[np.ndarray, "rows 3"], errors: Float64[np.ndarray, " rows"]) -> Region | None:
    """Find the cell of a grid over the measured space with the largest errors.

    Args:
        place: position of every row [m].
        errors: lengths of the errors, all finite.

    Returns:
        None if there are too few rows, or all are in one cell.
    """
    low, high = (place.min(0), place.max(0)) if len(place) else (np.zeros(3), np.zeros(3))
    width = np.where(high > low, (high - low) / CELLS, 1.0)
    cell = np.clip(((place - low) / width).astype(int), 0, CELLS - 1)
    number = (cell * [CELLS * CELLS, CELLS, 1]).sum(1)
    least = max(MIN_ROWS, len(errors) // 100)
    cells = [(int(k), errors[number == k]) for k in np.unique(number)]
    cells = [(k, inside) for k, inside in cells if len(inside) >= least]
    if len(cells) < 2:
        return None
    # compared one standard error lower, so that a cell of few rows is not the worst by luck
    worst, _ = max(cells, key=lambda one: root_mean_square(one[1]) * (1 - 1 / math.sqrt(len(one[1]))))
    inside = number == worst
    _, chance = groups_differ(inside.astype(int), errors)
    corner = low + width * cell[inside][0]
    rms = root_mean_square(errors[inside])
    return Region(
        low=tuple(corner.tolist()),
        high=tuple((corner + width).tolist()),
        rows=int(inside.sum()),
        rms=rms,
        ratio=rms / root_mean_square(errors),
        significant=chance < SIGNIFICANT / len(cells),  # Bonferroni: the worst of many cells
    )
