"""The fixed splits, by row numbers of the file of a series, from 0; they never depend on a method."""

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch

from pisigma.files.errors import MeasurementError
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.splits import k_folds, with_fewer_training_rows
from shared_benchmark.public_series import Series

SEED = 0
BOX = (0.04, 0.96)
"""Quantiles of every joint's values between which the rows of a box lie."""


@dataclass(frozen=True, eq=False)
class Fold:
    """Row numbers to fit, and row numbers to predict."""

    train: np.ndarray
    test: np.ndarray


def _numbers(pairs: object) -> list[Fold]:
    return [Fold(train.numpy(), test.numpy()) for train, test in pairs]  # type: ignore[attr-defined]


def _random(data: Measurements) -> list[Fold]:
    """Return five random folds; rows with equal joint values stay together."""
    return _numbers(k_folds(data, 5, SEED))


def _sixths(data: Measurements) -> list[Fold]:
    """Return six random folds of configurations."""
    return _numbers(k_folds(data, 6, SEED))


def _placements(data: Measurements) -> list[Fold]:
    """Return one fold per placement of the sockets."""
    return _numbers(k_folds(data, None, SEED, "placement"))


def _space(data: Measurements) -> list[Fold]:
    """Return one fold for each of five blocks of the measured positions, which is predicted from the others."""
    return _numbers(k_folds(data, 5, SEED, "space"))


def _box(data: Measurements) -> list[Fold]:
    """Return one fold: rows with all joints between their 4 % and 96 % quantiles are fitted, all others predicted."""
    low, high = (torch.quantile(data.q, share, 0) for share in BOX)
    inside = ((data.q >= low) & (data.q <= high)).all(1)
    return [Fold(inside.nonzero()[:, 0].numpy(), (~inside).nonzero()[:, 0].numpy())]


def _session(data: Measurements) -> list[Fold]:
    """Return one fold: all rows are fitted, and all rows of a session with other base and tool are predicted."""
    every = np.arange(data.rows)
    return [Fold(every, every[:0])]


def _few(rows: int) -> Callable[[Measurements], list[Fold]]:
    def draw(data: Measurements) -> list[Fold]:
        return _numbers(with_fewer_training_rows(data, k_folds(data, 5, SEED), rows, SEED))

    return draw


SPLITS: Mapping[str, tuple[str, Callable[[Measurements], list[Fold]]]] = {
    "random": ("5 random folds of joint vectors", _random),
    "configurations": ("6 random folds of configurations", _sixths),
    "placements": ("one placement of the sockets held out", _placements),
    "space": ("5 blocks of the workspace, each held out", _space),
    "box": ("rows outside the 4 % to 96 % quantiles of the joints", _box),
    "session": ("another session, with base and tool fitted to it", _session),
    "rows_30": ("5 random folds, 30 training rows", _few(30)),
    "rows_100": ("5 random folds, 100 training rows", _few(100)),
    "rows_300": ("5 random folds, 300 training rows", _few(300)),
}
"""Description of the held-out rows, and function that returns the folds, by name of the split."""


def split_hash(folds: list[Fold]) -> str:
    """Return the SHA-256 of the row numbers."""
    numbers = [[fold.train.tolist(), fold.test.tolist()] for fold in folds]
    return hashlib.sha256(json.dumps(numbers).encode()).hexdigest()


def folds_of(series: Series, split: str) -> list[Fold]:
    """Return the folds of a split of a series.

    Raises:
        MeasurementError: the folds differ from those of the benchmark because a random generator gave other numbers.
    """
    folds = SPLITS[split][1](series.measurements)
    found = split_hash(folds)
    if found != series.splits[split]:
        raise MeasurementError(
            expected=f"row numbers of the split '{split}' of '{series.name}' with SHA-256 {series.splits[split]}",
            value=found,
            remedy="use the row numbers of the tested version of torch (constraints.txt)",
        )
    return folds
