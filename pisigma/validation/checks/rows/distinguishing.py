"""What distinguishes some rows from the others: their position in the file, a name, a condition, or a joint value."""

import itertools
from collections.abc import Iterator, Sequence
from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool
from torch import Tensor

from pisigma.measurement.dataset import Measurements
from pisigma.validation.setup_faults.cause import joined

MAX_PLACES = 8
"""Rows that are listed one by one."""


class Distinction(NamedTuple):
    """What distinguishes some rows from the others.

    Attributes:
        by: "name", "range" (of the file), "period" (every n-th row), "value", or "nothing" if the rows are scattered.
        clause: such as "all rows after rows.csv, line 8".
    """

    by: Literal["name", "range", "period", "value", "nothing"]
    clause: str


def what_distinguishes(rows: Measurements, some: Bool[Tensor, " rows"]) -> Distinction:
    """Find a property that some rows have and all others do not."""
    for distinction in (*_by_name(rows, some), *_by_order(rows, some), *_by_value(rows, some)):
        return distinction
    numbers = some.nonzero()[:, 0].tolist()
    listed = joined(rows.place(number) for number in numbers[:MAX_PLACES])
    more = f" and {len(numbers) - MAX_PLACES} more" if len(numbers) > MAX_PLACES else ""
    return Distinction("nothing", f"{listed}{more}, which are scattered among the others")


def _by_name(rows: Measurements, some: Bool[Tensor, " rows"]) -> Iterator[Distinction]:
    """Compare the files, frames, targets and dates of the rows with those of the others."""
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
            yield Distinction("name", f"all rows of {what} {joined(sorted(here))}")


def _by_order(rows: Measurements, some: Bool[Tensor, " rows"]) -> Iterator[Distinction]:
    """Test whether the rows are a range of the file, or every n-th row."""
    numbers = some.nonzero()[:, 0].tolist()
    first, last = numbers[0], numbers[-1]
    if last - first + 1 == len(numbers) and len(numbers) > 1:
        if last == rows.rows - 1:
            yield Distinction("range", f"{rows.place(first)} and all later rows")
        elif first == 0:
            yield Distinction("range", f"all rows up to {rows.place(last)}")
        else:
            yield Distinction("range", f"all rows from {rows.place(first)} to {rows.place(last)}")
    steps = {later - earlier for earlier, later in itertools.pairwise(numbers)}
    if len(steps) == 1 and len(numbers) > 2 and (step := steps.pop()) > 1 and first < step:
        ordinal = {2: "second", 3: "third"}.get(step, f"{step}th")
        if last + step >= rows.rows:
            yield Distinction("period", f"every {ordinal} row, starting at {rows.place(first)}")


def _by_value(rows: Measurements, some: Bool[Tensor, " rows"]) -> Iterator[Distinction]:
    """Look for a temperature, a payload or a joint value that separates these rows from all others."""
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
                yield Distinction("value", f"all rows with {what} {side} that of the others")
