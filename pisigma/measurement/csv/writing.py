"""Write a measurement file, completely or not at all, that is read back unchanged."""

import csv
import io
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.files.errors import MeasurementError, Place
from pisigma.files.output_file import write_atomically
from pisigma.measurement.csv.columns import number_fields
from pisigma.measurement.fields import KINDS, TEXTS, MeasuredFields
from pisigma.measurement.readings import READINGS, Unit, from_si, reading_texts
from pisigma.robot.se3 import quaternion_from_rotation


def write_fields(data: MeasuredFields, path: str | os.PathLike[str], revolute: Sequence[bool]) -> None:
    """Write a measurement file; see `Measurements.write_csv`.

    Args:
        data: at least one row.
        path: the file; an existing file is replaced.
        revolute: per joint, whether it is revolute (degrees) or prismatic (millimetres).

    Raises:
        MeasurementError: the file could not be read back unchanged.
        OutputError: the file cannot be written there.
    """
    if data.rows == 0:
        raise MeasurementError(
            "there is no row to write", at=Place(data.source), remedy="give at least one measurement"
        )
    numbers = _numbers(data, revolute)
    names = (*TEXTS, *reading_texts())
    texts = {"set" if name == "split" else name: data.text(name) for name in names if any(data.text(name))}
    _check(data, texts)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*numbers, *texts])
    cells: list[list[object]] = [
        ["" if number != number else number for number in values.tolist()] for values in numbers.values()
    ]
    writer.writerows(zip(*cells, *texts.values(), strict=True))
    write_atomically(Path(path), text.getvalue())


def _numbers(data: MeasuredFields, revolute: Sequence[bool]) -> dict[str, Float64[np.ndarray, " rows"]]:
    """Return the numeric columns in the file's units, without columns that would be empty.

    The columns of the position are written, even empty, if there is no other length, because the file could not be read
    without them.
    """
    columns: dict[str, Float64[np.ndarray, " rows"]] = {}

    def add(name: str, values: Tensor, unit: Unit, needed: bool = False) -> None:
        if needed or not bool(values.isnan().all()):
            columns[name] = from_si(values.detach().cpu().numpy(), unit)

    for number, (q, is_revolute) in enumerate(zip(data.numbers["q"].T, revolute, strict=True), start=1):
        unit: Unit = "deg" if is_revolute else "mm"
        add(f"q{number}_{unit}", q, unit)
    nothing = torch.full((data.rows, 3), torch.nan, dtype=torch.float64)
    fields = {"position": nothing, **data.numbers}
    if "rotation" in fields:
        fields["rotation"] = quaternion_from_rotation(fields["rotation"])
    alone = not any(bool(data.is_measured(kind).any()) for kind in ("socket", "touch", "distance", *READINGS))
    for field in number_fields(len(revolute)):
        if field.name in fields:
            values = fields[field.name].reshape(data.rows, -1).T
            for column, of_column in zip(field.columns, values, strict=False):
                add(column.name, of_column, column.unit, needed=alone and field.name == "position")
    return columns


def _check(data: MeasuredFields, texts: Mapping[str, Sequence[str]]) -> None:
    """Refuse values that could not be read back unchanged."""
    nothing = ~torch.stack([data.is_measured(kind) for kind in (*KINDS, *READINGS)]).any(0).cpu()
    if bool(nothing.any()):
        raise MeasurementError(
            "nothing was measured in this row",
            at=data.place_of(int(nothing.nonzero()[0])),
            remedy="omit it with select before writing",
        )
    for name, names in texts.items():
        for text in set(names):
            if not _fits_cell(text):
                raise MeasurementError(
                    expected="a name that a CSV cell can contain",
                    value=text,
                    at=data.place_of(names.index(text), name),
                    remedy="use a single line without leading or trailing spaces",
                )


def _fits_cell(text: str) -> bool:
    """Return whether a name can be read back unchanged from a CSV cell."""
    try:
        text.encode("utf-8")
    except UnicodeEncodeError:
        return False
    return text == text.strip() and not set(text) & {"\n", "\r", "\0"}
