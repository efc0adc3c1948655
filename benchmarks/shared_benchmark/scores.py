"""Errors of held-out rows, and figures that are computed from them."""

import statistics
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch

from pisigma.measurement.groups import groups_of_equal_joints, placement_groups
from pisigma.robot.frame_fits import LEVER_SHARE, MeasuredPoses, best_base_and_tool
from shared_benchmark.public_series import Series
from shared_benchmark.rows import Array, Prediction, Rows

DRAWS = 2000
"""Number of bootstrap samples."""


@dataclass(frozen=True, eq=False)
class RowErrors:
    """Errors of held-out rows.

    Attributes:
        row: row numbers in the file of the held-out rows, from 0.
        group: number of the configuration or placement of every row; rows of a group are resampled together.
        fold: number of the fit that predicted every row.
        error: measured minus predicted position (rows, 3) [mm]; for a socket, its position according to the other rows
            minus that according to this row.
        sigma: predicted standard deviation of the error (rows, 3) [mm]; NaN where no value was predicted.
        angle: angle between measured and predicted rotation (rows,) [deg]; NaN where there is none.
    """

    row: Array
    group: Array
    fold: Array
    error: Array
    sigma: Array
    angle: Array

    @property
    def rms(self) -> float:
        """RMS length of the errors [mm]."""
        return float(np.sqrt(np.square(self.error).sum(1).mean()))

    def coverage(self, share: float) -> float:
        """Return the actual share of coordinates within the predicted interval of a nominal share."""
        return float(self._inside(share).mean()) if np.isfinite(self.sigma).all() else float("nan")

    def coverage_error(self, share: float) -> float:
        """Return the standard error of the coverage from its scatter between fits; NaN for a single fit.

        All rows that one fit predicts share the errors of its parameters, so they are not independent.
        """
        fits = np.unique(self.fold)
        ones = [self._inside(share)[self.fold == fit].mean() for fit in fits]
        return float(np.std(ones, ddof=1) / np.sqrt(len(fits))) if len(fits) > 1 else float("nan")

    def _inside(self, share: float) -> Array:
        return np.abs(self.error) <= normal_quantile(share) * self.sigma


def normal_quantile(share: float) -> float:
    """Return half the width of the interval that contains a share of a normal distribution, in standard deviations."""
    return statistics.NormalDist().inv_cdf((1 + share) / 2)


def row_errors(series: Series, prediction: Prediction, rows: Rows, numbers: Array, moved: bool) -> RowErrors:
    """Compare a prediction with held-out rows.

    Args:
        series: the series of the rows.
        prediction: the prediction.
        rows: the rows.
        numbers: numbers of the rows in the file.
        moved: whether base and tool are fitted to the rows first, because both have moved; the predicted standard
            deviations are then averaged over the axes.
    """
    T, sigma = prediction.T, prediction.sigma
    if sigma is None:
        sigma = np.full((len(T), 3), np.nan)
    if moved:
        T = _fitted(T, rows, series)
        sigma = np.sqrt((sigma**2).mean(1, keepdims=True)).repeat(3, 1)
    angle = np.full(len(T), np.nan)
    error = from_other_rows(T[:, :3, 3], rows) if rows.position is None else rows.position - T[:, :3, 3]
    if rows.rotation is not None:
        between = np.einsum("nij,nkj->nik", rows.rotation, T[:, :3, :3])
        skew = between - between.transpose(0, 2, 1)
        sine = np.sqrt((skew**2).sum((1, 2)) / 8)
        angle = np.rad2deg(np.arctan2(sine, (np.trace(between, axis1=1, axis2=2) - 1) / 2))
    return RowErrors(
        numbers, groups_of(series)[numbers], np.zeros_like(numbers), error * 1e3, sigma * 1e3, angle
    )


def groups_of(series: Series) -> Array:
    """Return the number of the configuration, or of the placement of the sockets, of every row of a series."""
    data = series.measurements
    groups: Array = (
        groups_of_equal_joints(data.q) if data.socket is None else placement_groups(data)
    ).numpy()
    return groups


def ratio_interval(first: RowErrors, second: RowErrors, share: float = 0.95) -> tuple[float, float]:
    """Return the interval of the ratio of two RMS errors on the same rows, by a paired bootstrap over groups.

    Efron and Tibshirani 1993, An Introduction to the Bootstrap, chapter 13 (percentiles).
    """
    assert np.array_equal(first.row, second.row)
    _, sums = _samples([first, second])
    low, high = np.quantile(np.sqrt(sums[0] / sums[1]), [(1 - share) / 2, (1 + share) / 2])
    return float(low), float(high)


def rms_interval(errors: RowErrors, share: float = 0.95) -> tuple[float, float]:
    """Return the interval of an RMS error [mm], by a bootstrap over groups."""
    counts, sums = _samples([errors])
    low, high = np.quantile(np.sqrt(sums[0] / counts), [(1 - share) / 2, (1 + share) / 2])
    return float(low), float(high)


def _samples(several: list[RowErrors]) -> tuple[Array, list[Array]]:
    """Return the number of rows of every bootstrap sample, and the sums of squared errors of every method."""
    number = np.unique(several[0].group, return_inverse=True)[1].ravel()
    draws = _draws(int(number.max()) + 1)
    return draws @ np.bincount(number), [
        draws @ np.bincount(number, np.square(one.error).sum(1)) for one in several
    ]


@lru_cache(maxsize=16)
def _draws(groups: int) -> Array:
    """Return how often every bootstrap sample contains every group; as floats, which are multiplied by BLAS."""
    draws = np.random.default_rng(0).multinomial(groups, np.full(groups, 1 / groups), DRAWS)
    return draws.astype(float)


def _fitted(T: Array, rows: Rows, series: Series) -> Array:
    """Return poses with base and tool fitted to the measured poses."""
    assert rows.position is not None
    position, poses = torch.from_numpy(rows.position), torch.from_numpy(T)
    rotation = None if rows.rotation is None else torch.from_numpy(rows.rotation)
    measured = MeasuredPoses.from_tensors(position, rotation, LEVER_SHARE * series.arm.reach)
    base, tool = best_base_and_tool(poses, measured)
    fitted: Array = (base @ poses @ tool).numpy()
    return fitted


def from_other_rows(position: Array, rows: Rows) -> Array:
    """Return the mean position of the other rows of the socket minus that of the row."""
    assert rows.socket is not None
    error = np.empty_like(position)
    for name in np.unique(rows.socket):
        here = rows.socket == name
        count = int(here.sum())
        error[here] = (position[here].mean(0) - position[here]) * count / max(count - 1, 1)
    return error


def errors_between_sockets(
    prediction: Prediction, rows: Rows, distances: Mapping[tuple[str, str], float]
) -> float | None:
    """Return the RMS error of the known distances of sockets [mm]; None if no distance is known.

    This error reveals a method that predicts the same position everywhere, whose other errors at sockets are 0.
    """
    if rows.socket is None or not distances:
        return None
    place = {str(name): prediction.T[rows.socket == name, :3, 3].mean(0) for name in np.unique(rows.socket)}
    wrong = [np.linalg.norm(place[a] - place[b]) - length for (a, b), length in distances.items()]
    return float(np.sqrt(np.mean(np.square(wrong)))) * 1e3
