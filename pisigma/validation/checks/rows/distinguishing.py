"""What distinguishes some rows from the others: where they are in the file, a name, a condition, or a joint."""

import itertools
from collections.abc import Iterator, Sequence

import torch
from jaxtyping import Bool
from torch import Tensor

from pisigma.measurement.dataset import Measurements
from pisigma.validation.setup_faults.cause import joined

MOST_PLACES = 8
"""Rows that are listed one by one."""


def what_distinguishes(rows: Measurements, some: Bool[Tensor, " rows"]) -> str:
    """Say in a clause what rows have that the others do not, such as "all rows from rows.csv, line 9 on"."""
    for clause in (*_by_name(rows, some), *_by_order(rows, some), *_by_value(rows, some)):
        return clause
    numbers = some.nonzero()[:, 0].tolist()
    listed = joined(rows.place(number) for number in numbers[:MOST_PLACES])
    more = f" and {len(numbers) - MOST_PLACES} more" if len(numbers) > MOST_PLACES else ""
    return f"{listed}{more}, which are scattered among the others"


def _by_name(rows: Measurements, some: Bool[Tensor, " rows"]) -> Iterator[str]:
    """Files, frames, targets and days that only these rows have."""
    named: tuple[tuple[str, Sequence[str] | None], ...] = (
        ("file", rows.origin),
        ("frame", rows.frame),
        ("target", rows.target),
        ("date", rows.date),
    )
    for what, names in named:
        if not names:
            continue
        here = {name for name, one in zip(names, some.tolist(), strict=True) if one}
        there = {name for name, one in zip(names, some.tolist(), strict=True) if not one}
        if here and there and not here & there:
            yield f"all rows of {what} {joined(sorted(here))}"


def _by_order(rows: Measurements, some: Bool[Tensor, " rows"]) -> Iterator[str]:
    """A stretch of the file, or every second row."""
    numbers = some.nonzero()[:, 0].tolist()
    first, last = numbers[0], numbers[-1]
    if last - first + 1 == len(numbers) and len(numbers) > 1:
        if last == rows.rows - 1:
            yield f"all rows from {rows.place(first)} on"
        elif first == 0:
            yield f"all rows up to {rows.place(last)}"
        else:
            yield f"all rows from {rows.place(first)} to {rows.place(last)}"
    steps = {later - earlier for earlier, later in itertools.pairwise(numbers)}
    if len(steps) == 1 and len(numbers) > 2 and (step := steps.pop()) > 1 and first < step:
        ordinal = {2: "second", 3: "third"}.get(step, f"{step}th")
        if last + step >= rows.rows:
            yield f"every {ordinal} row from {rows.place(first)} on"


def _by_value(rows: Measurements, some: Bool[Tensor, " rows"]) -> Iterator[str]:
    """A temperature, a payload or a joint value beyond which all of these rows are, and no other."""
    columns: list[tuple[str, Tensor]] = []
    if rows.temperature is not None:
        columns.append(("a temperature", rows.temperature))
    if rows.payload is not None:
        columns.append(("a payload", rows.payload))
    columns += [(f"joint {number}", one) for number, one in enumerate(rows.q.t(), 1)]
    for what, values in columns:
        here, there = values[some], values[~some]
        if len(here) < 3 or len(there) < 3 or not bool(torch.isfinite(values).all()):
            continue
        for side, beyond in (("above", here.min() > there.max()), ("below", here.max() < there.min())):
            if bool(beyond):
                yield f"all rows with {what} {side} that of the others"
