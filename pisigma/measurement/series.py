"""Parting measurements by series: what was measured on one day, from one place or with one payload against another."""

from collections.abc import Sequence
from typing import Literal, get_args

import torch

from pisigma.errors import MeasurementError, nearest_choice
from pisigma.measurement.conditions import CONDITIONS, conditions_of
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.groups import groups_to_keep_whole
from pisigma.measurement.splits import TrainTest

SeriesColumn = Literal["frame", "target", "set", "payload_kg", "temperature_c"]
"""Columns of a measurement file that may tell series apart."""


def series_of(measurements: Measurements, column: SeriesColumn) -> tuple[str, ...]:
    """Name of the series that every row belongs to, as a column says; "" where it says nothing.

    Of several files, name the rows of each instead: `("monday",) * a.rows + ("friday",) * b.rows` for `join([a, b])`.

    Raises:
        MeasurementError: the column is unknown or no row has a value in it.
    """
    if column not in get_args(SeriesColumn):
        raise MeasurementError(
            f"series by '{column}' are unknown; {nearest_choice(column, get_args(SeriesColumn))}"
        )
    if column in CONDITIONS:
        values = conditions_of(measurements, (column,))[:, 0].tolist()
        names = tuple("" if value != value else f"{value:g}" for value in values)
    else:
        given = measurements.split if column == "set" else getattr(measurements, column)
        names = tuple(given or ("",) * measurements.rows)
    if not any(names):
        raise MeasurementError(f"{measurements.source}: no row has a value in the column '{column}'.")
    return names


def one_against_another(
    measurements: Measurements, names: Sequence[str], test: str, train: str | None = None
) -> TrainTest:
    """Train on one series and test on another.

    Rows whose joint values, or whose pair, occur in the tested series too are not trained with, so that no
    configuration is judged that was learned.

    Args:
        measurements: what to part.
        names: series of every row; rows of "" are in neither part.
        test: the series to test on.
        train: the series to train on; all others where none is given.

    Returns:
        The rows to train on and the rows to test on.

    Raises:
        MeasurementError: there is no such series, both are the same, there is not a name per row, or no row is left
            to train on.
    """
    if len(names) != measurements.rows:
        raise MeasurementError(
            f"{measurements.source}: a series for each of {measurements.rows} rows was wanted, got {len(names)}."
        )
    known = {name for name in names if name}
    for wanted in (test,) if train is None else (test, train):
        if wanted not in known:
            raise MeasurementError(
                f"{measurements.source}: there is no series '{wanted}'; {nearest_choice(wanted, known)}"
            )
    if train == test:
        raise MeasurementError(
            f"{measurements.source}: series '{test}' cannot be tested on itself; choose two."
        )
    device = measurements.q.device
    tested = torch.tensor([name == test for name in names], device=device)
    others = [bool(name) and name != test and train in (None, name) for name in names]
    group = groups_to_keep_whole(measurements)
    trained = torch.tensor(others, device=device) & ~torch.isin(group, group[tested])
    if not trained.any():
        raise MeasurementError(
            f"{measurements.source}: no row is left to train on when series '{test}' is tested, as all others have "
            "joint values that occur in it; measure other poses."
        )
    return trained.nonzero()[:, 0], tested.nonzero()[:, 0]


def leave_one_series_out(measurements: Measurements, names: Sequence[str]) -> tuple[TrainTest, ...]:
    """Test on every series once, each time training on all others, in the order in which they appear.

    For what is raised see `one_against_another`.

    Raises:
        MeasurementError: there are not two series.
    """
    found = [name for name in dict.fromkeys(names) if name]
    if len(found) < 2:
        raise MeasurementError(f"{measurements.source}: two series or more were wanted, got {len(found)}.")
    return tuple(one_against_another(measurements, names, name) for name in found)
