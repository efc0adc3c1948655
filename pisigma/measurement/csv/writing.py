"""Writing a measurement file that reads back as it was, whole or not at all."""

import csv
import io
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.errors import MeasurementError, OutputError
from pisigma.measurement.csv.header import ANCHOR_PLACE, POSITION, QUATERNION
from pisigma.measurement.csv.rows import first_of_equal_rows
from pisigma.measurement.fields import KINDS, TEXTS, MeasuredFields
from pisigma.measurement.readings import READINGS, Unit, from_si, reading_texts


def write_fields(data: MeasuredFields, path: str | os.PathLike[str], revolute: Sequence[bool]) -> None:
    """Write a measurement file; see `Measurements.write_csv`.

    Args:
        data: at least one row.
        path: the file; one that is there is replaced.
        revolute: per joint, whether it turns (degrees) or slides (millimetres).

    Raises:
        MeasurementError: the measurements would not read back.
        OutputError: the file cannot be written there.
    """
    if data.rows == 0:
        raise MeasurementError(f"{data.source}: holds no row to write; give at least one measurement.")
    columns = _columns(data, revolute)
    _check(data, columns)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*columns.numbers, *columns.texts])
    cells: list[list[object]] = [
        ["" if number != number else number for number in values.tolist()]
        for values in columns.numbers.values()
    ]
    writer.writerows(zip(*cells, *columns.texts.values(), strict=True))
    _put(Path(path), text.getvalue())


@dataclass(frozen=True)
class _Columns:
    """The columns by name: numbers in the file's units, and texts."""

    numbers: dict[str, Float64[np.ndarray, " rows"]] = field(default_factory=dict)
    texts: dict[str, tuple[str, ...]] = field(default_factory=dict)

    def add(self, name: str, values: Tensor, unit: Unit = "", *, even_if_empty: bool = False) -> None:
        """Add a column; one that would hold nothing is left away."""
        if even_if_empty or not bool(values.isnan().all()):
            self.numbers[f"{name}_{unit}" if unit else name] = from_si(values.detach().cpu().numpy(), unit)


def _columns(data: MeasuredFields, revolute: Sequence[bool]) -> _Columns:
    """What stands in the file; columns that would hold nothing are left away, but for the position."""
    columns, numbers = _Columns(), data.numbers
    for number, (q, turns) in enumerate(zip(numbers["q"].T, revolute, strict=True), start=1):
        columns.add(f"q{number}", q, "deg" if turns else "mm")
    nothing = torch.full((data.rows, 3), torch.nan, dtype=torch.float64)
    others = ("socket", "touch", "distance", *READINGS)
    alone = not any(bool(data.measured(kind).any()) for kind in others)
    position = numbers.get("position", nothing)
    for name, values in zip(POSITION, position.T, strict=True):
        columns.add(name, values, "mm", even_if_empty=alone or not bool(position.isnan().all()))
    for name in ("touch", "distance"):
        columns.add(name, numbers.get(name, nothing[:, 0]), "mm")
    place = numbers.get("anchor_place", nothing)
    for name, values in zip(ANCHOR_PLACE, place.T, strict=True):
        columns.add(name, values, "mm", even_if_empty=not bool(place.isnan().all()))
    if "rotation" in numbers:
        for name, values in zip(QUATERNION, _quaternions(numbers["rotation"]).T, strict=True):
            columns.add(name, values)
    _add_conditions(columns, data)
    for readings in READINGS.values():
        for column in readings.columns:
            if column.name in numbers:
                columns.add(column.name, numbers[column.name], column.units[0])
    for name in (
        "target",
        "frame",
        *(text for text in TEXTS if text not in ("target", "frame")),
        *reading_texts(),
    ):
        if any(data.text(name)):
            columns.texts["set" if name == "split" else name] = data.text(name)
    return columns


def _add_conditions(columns: _Columns, data: MeasuredFields) -> None:
    """Standard deviations, and what was different from row to row besides the joint values."""
    units: tuple[tuple[str, str, Unit], ...] = (
        ("sigma_position", "sigma", "mm"),
        ("sigma_rotation", "sigma", "deg"),
        ("payload", "payload", "kg"),
        ("temperature", "temperature", "c"),
    )
    for field_name, name, unit in units:
        if field_name in data.numbers:
            columns.add(name, data.numbers[field_name], unit)
    if "approach" in data.numbers:
        for number, approach in enumerate(data.numbers["approach"].T, start=1):
            columns.add(f"approach{number}", approach)


def _quaternions(R: Float64[Tensor, "rows 3 3"]) -> Float64[Tensor, "rows 4"]:
    """Quaternions (x, y, z, w) of rotations, w >= 0.

    The outer product 4·q·q^T is linear in R (Shepperd 1978, J. Guidance and Control 1(3)); its row with the
    largest diagonal entry is q up to length and sign, without cancellation for any angle.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = (row.unbind(-1) for row in R.unbind(-2))
    rows = [
        torch.stack([1 + xx - yy - zz, xy + yx, xz + zx, zy - yz], -1),
        torch.stack([xy + yx, 1 - xx + yy - zz, yz + zy, xz - zx], -1),
        torch.stack([xz + zx, yz + zy, 1 - xx - yy + zz, yx - xy], -1),
        torch.stack([zy - yz, xz - zx, yx - xy, 1 + xx + yy + zz], -1),
    ]
    outer = torch.stack(rows, -2)
    largest = outer.diagonal(dim1=-2, dim2=-1).argmax(-1)
    q = torch.take_along_dim(outer, largest[:, None, None], -2)[:, 0]
    sign = torch.where(q[:, 3:] < 0, -1.0, 1.0).to(q)
    length = (q * q).sum(-1, keepdim=True).sqrt()
    return sign * q / length


def _check(data: MeasuredFields, columns: _Columns) -> None:
    """Refuse what would not read back."""
    values = np.stack(list(columns.numbers.values()), axis=1)
    nothing = ~torch.stack([data.measured(kind) for kind in (*KINDS, *READINGS)]).any(0).cpu()
    if bool(nothing.any()):
        raise MeasurementError(
            f"{data.label(int(nothing.nonzero()[0]))}: nothing was measured in this row; leave it out with select "
            "before writing."
        )
    first = first_of_equal_rows(values, list(columns.texts.values()))
    equal = first != np.arange(len(first))
    if equal.any():
        row = int(equal.argmax())
        raise MeasurementError(
            f"{data.label(row)}: equals row {int(first[row])} in everything; leave one of them out "
            "with select before writing."
        )
    for name, texts in columns.texts.items():
        for text in set(texts):
            if not _fits_cell(text):
                place = data.label(texts.index(text))
                raise MeasurementError(
                    f"{place}, column '{name}': the name {text!r} cannot stand in a CSV cell; use one of a "
                    "single line without blanks around it."
                )


def _fits_cell(text: str) -> bool:
    """Whether a name reads back as it is."""
    try:
        text.encode("utf-8")
    except UnicodeEncodeError:
        return False
    return text == text.strip() and not set(text) & {"\n", "\r", "\0"}


def _put(path: Path, text: str) -> None:
    """Write a file beside `path` and move it there in one step."""
    path = Path(os.path.realpath(path))
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        try:
            with temporary.open("w", encoding="utf-8", newline="") as file:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as problem:
        raise OutputError(
            f"{path}: cannot be written ({problem.strerror}); check the folder and its rights."
        ) from None
