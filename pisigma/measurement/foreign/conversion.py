"""The rows of an export in columns of measurement files; every number with all of its digits; and as their table."""

import csv
import io
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.files.errors import MeasurementError
from pisigma.measurement.csv.columns import POSITION, QUATERNION, RPY, find_column
from pisigma.measurement.csv.reading import fields_of
from pisigma.measurement.csv.table import Table
from pisigma.measurement.foreign.accounting import LeftOutRow, Place
from pisigma.measurement.foreign.dialect import is_missing
from pisigma.measurement.foreign.export_file import ExportFile
from pisigma.measurement.foreign.mapping import (
    FileMapping,
    ambiguous_spelling,
    angles,
    coordinates,
    joint_columns,
)
from pisigma.measurement.foreign.quantities import (
    KEYS,
    LEFT_OUT,
    MappedColumn,
    is_measured,
    measurement_column,
)
from pisigma.measurement.foreign.rotations import ROTATIONS, RotationEncoding
from pisigma.measurement.foreign.time_stamps import day_first, has_open_date, iso_day
from pisigma.measurement.foreign.units import AMBIGUOUS, UNITS, scaled
from pisigma.robot.se3 import quaternion_from_rotation


@dataclass(frozen=True, eq=False)
class ConvertedRows:
    """Rows of an export, or of several, in columns of measurement files.

    Attributes:
        source: the file.
        lines: where the rows stand in it.
        cells: texts of every row by column, such as "q1_deg", and by the keys "point" and "time".
        origins: the file of every row; () where all are of the source.
    """

    source: str
    lines: tuple[int, ...]
    cells: Mapping[str, tuple[str, ...]]
    origins: tuple[str, ...] = ()

    @property
    def places(self) -> tuple[Place, ...]:
        """File and line of every row."""
        return tuple(zip(self.origins or (self.source,) * len(self.lines), self.lines, strict=True))


def check_complete(mapping: FileMapping) -> None:
    """Make sure that every column that is kept is the only one of its quantity, and that units are stated and agree.

    Raises:
        MeasurementError: see above, or the encoding of a rotation is open.
    """
    source, kept = mapping.file.source, [one for one in mapping.columns if one.target.quantity != LEFT_OUT]
    for column in kept:
        other = mapping.quantities[column.target.quantity]
        if other != column:
            raise MeasurementError(
                f"{source}: the columns '{column.heading}' and '{other.heading}' are both {column.target.quantity}; "
                f"say which one is wanted, such as --map '{mapping.key(column)}=-'."
            )
    for group in (coordinates(mapping.columns), joint_columns(mapping.columns), angles(mapping.columns)):
        for column in group:
            if column.target.unit and group[0].target.unit not in ("", column.target.unit):
                raise MeasurementError(
                    f"{source}: '{group[0].heading}' is in {group[0].target.unit}, but '{column.heading}' in "
                    f"{column.target.unit}; give both in one unit."
                )
    if mapping.rotations:
        raise MeasurementError(
            f"{source}: the headings do not say how the rotation is written; state --rotation "
            f"{', '.join(mapping.rotations)}, or none to leave it out."
        )
    if mapping.incomplete:
        names = " and ".join(f"'{column.heading}'" for column in mapping.incomplete)
        raise MeasurementError(
            f"{source}, line {mapping.file.header_line}, columns {names}: expected all values of a rotation, got "
            f"{len(mapping.incomplete)}; add the missing column, or leave the rotation out with --rotation none."
        )
    if lacking := mapping.without_unit:
        names, many = ", ".join(f"'{one.heading}'" for one in lacking), "s" if len(lacking) > 1 else ""
        likely = mapping.likely_units
        first = next(replace(one.target, unit=likely[kind]) for one in lacking if (kind := one.target.needs))
        spellings = {ambiguous_spelling(mapping.file, one.index, one.target.needs) for one in lacking} - {""}
        meanings = "".join(f" ('{spelling}' means {AMBIGUOUS[spelling]})" for spelling in sorted(spellings))
        raise MeasurementError(
            f"{source}, line {mapping.file.header_line}: no unit is stated of the column{many} {names}{meanings}; "
            f"state it, --unit {','.join(likely.values())} if that is right, or "
            f"--map '{mapping.key(lacking[0])}={first.text}'."
        )


def convert(mapping: FileMapping) -> ConvertedRows:
    """Convert the rows of a file.

    Raises:
        MeasurementError: see `check_complete`, or the values of a row are no rotation; the message names the line.
    """
    check_complete(mapping)
    file, cells = mapping.file, {}
    for quantity, column in mapping.quantities.items():
        if quantity in KEYS:
            cells[quantity] = _key(file, quantity, file.column(column.index), column.target.unit)
        elif not any(quantity in one.quantities() for one in ROTATIONS.values()):
            name, texts = _column(file, quantity, column)
            cells[name] = texts
    for encoding in ROTATIONS.values():
        columns = [mapping.quantities.get(quantity) for quantity in encoding.quantities()]
        present = [column for column in columns if column is not None]
        if len(present) == len(columns):
            cells |= _rotation(file, encoding, present)
        elif present:
            raise MeasurementError(
                f"{file.source}: of a rotation in the way '{encoding.name}', only {len(present)} of {len(columns)} "
                f"values are mapped; map {', '.join(encoding.quantities())}."
            )
    return ConvertedRows(file.source, file.lines, cells)


def _key(file: ExportFile, quantity: str, texts: list[str], unit: str) -> tuple[str, ...]:
    """Names of points as they are; times in s where they are numbers."""
    if quantity == "point":
        return tuple(texts)
    numbers = [file.dialect.numbers.text(text) for text in texts]
    return tuple(
        text if number is None else scaled(number, unit) for text, number in zip(texts, numbers, strict=True)
    )


def _column(file: ExportFile, quantity: str, column: MappedColumn) -> tuple[str, tuple[str, ...]]:
    """A column of measurement files, and its cells."""
    unit = column.target.unit
    written = UNITS[unit].column if unit else ""
    if quantity in RPY and written == "rad":
        numbers = _numbers(file, column)
        return f"{quantity}_deg", tuple(repr(math.degrees(float(text))) if text else "" for text in numbers)
    if quantity == "date":
        return quantity, _dates(file, column)
    name = measurement_column(quantity, written)
    kept = find_column(name)
    assert kept is not None  # as parse_target and the proposals make it
    return name, _numbers(file, column) if kept.is_number else tuple(file.column(column.index))


def _dates(file: ExportFile, column: MappedColumn) -> tuple[str, ...]:
    """The days of a column as ISO 8601 writes them, in whatever order of day, month and year; the reader checks others.

    Raises:
        MeasurementError: the day or the month may be first.
    """
    texts = file.column(column.index)
    first, dates = day_first(texts), []
    for line, text in zip(file.lines, texts, strict=True):
        day = "" if is_missing(text) else iso_day(text, first)
        if day is None and has_open_date(text) and iso_day(text, True) is not None:
            raise MeasurementError(
                f"{file.source}, line {line}, column '{column.heading}': expected a date of one meaning, got '{text}', "
                "which may have the day or the month first; write dates as 2026-03-02 or 02.03.2026."
            )
        dates.append(text if day is None else day)
    return tuple(dates)


def _numbers(file: ExportFile, column: MappedColumn) -> tuple[str, ...]:
    """The numbers of a column in the unit of measurement files, "" where nothing was measured.

    Raises:
        MeasurementError: a cell holds something else; the message names its line.
    """
    numbers = []
    for line, cell in zip(file.lines, file.column(column.index), strict=True):
        number = "" if is_missing(cell) else file.dialect.numbers.text(cell)
        if number is None:
            sign = "point" if file.dialect.numbers.decimal == "." else "comma"
            raise MeasurementError(
                f"{file.source}, line {line}, column '{column.heading}': '{cell}' is no number with a decimal {sign}; "
                "correct it, leave it empty where nothing was measured, or remove the row."
            )
        numbers.append(scaled(number, column.target.unit) if number else "")
    return tuple(numbers)


def _rotation(
    file: ExportFile, encoding: RotationEncoding, columns: list[MappedColumn]
) -> dict[str, tuple[str, ...]]:
    """Quaternions of rotations; "" in rows without."""
    rows = list(zip(*(_numbers(file, column) for column in columns), strict=True))
    values = torch.tensor([[float(text or "nan") for text in row] for row in rows], dtype=torch.float64)
    if columns[0].target.unit and UNITS[columns[0].target.unit].column == "deg":
        values = values.deg2rad()
    measured = torch.tensor([any(row) for row in rows], dtype=torch.bool)
    wrong = measured & ~encoding.is_rotation(values)
    if bool(wrong.any()):
        names = ", ".join(f"'{column.heading}'" for column in columns)
        raise MeasurementError(
            f"{file.source}, line {file.lines[int(wrong.nonzero()[0, 0])]}, columns {names}: are no rotation in "
            f"the way '{encoding.name}' ({encoding.meaning}); correct or empty them, or state another --rotation."
        )
    quaternions = _quaternion_texts(encoding, values, measured)
    return dict(zip(QUATERNION, zip(*quaternions, strict=True), strict=True))


def _quaternion_texts(
    encoding: RotationEncoding, values: Float64[Tensor, "rows values"], measured: Tensor
) -> list[tuple[str, ...]]:
    """The quaternion of every row as texts, empty where nothing was measured."""
    texts: list[tuple[str, ...]] = [("",) * 4] * len(values)
    quaternions = quaternion_from_rotation(encoding.to_rotation(values[measured]))
    for row, quaternion in zip(measured.nonzero()[:, 0].tolist(), quaternions.tolist(), strict=True):
        texts[row] = tuple(map(repr, quaternion))
    return texts


@dataclass(frozen=True, eq=False)
class MeasurementTable:
    """The table of a measurement file.

    Attributes:
        table: of the rows in which something was measured.
        places: file and line of these rows.
        left_out: the other rows, and why.
    """

    table: Table
    places: tuple[Place, ...]
    left_out: tuple[LeftOutRow, ...]

    def text(self) -> str:
        """The measurement file."""
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows([self.table.header, *self.table.records])
        return text.getvalue()


def measurement_table(rows: ConvertedRows) -> MeasurementTable:
    """Make the table of a measurement file; the reader of such files checks every row.

    Raises:
        MeasurementError: the rows are no measurements; the message names the line of the export.
    """
    names = sorted((name for name in rows.cells if name not in KEYS), key=_order)
    measured = [rows.cells[name] for name in names if is_measured(name)]
    filled = [any(texts) for texts in zip(*measured, strict=True)]
    if not names:
        raise MeasurementError(
            f"{rows.source}: no column was recognised as a joint value or a measurement; say what they are with --map, "
            "such as --map HEADING=q1_deg,OTHER=x_mm."
        )
    if not any(filled):
        raise MeasurementError(
            f"{rows.source}: holds joint values, but no measurement; name its columns with --map, or join the file "
            "that holds them with --join point, order or time."
        )
    if _order(names[0])[0]:
        raise MeasurementError(
            f"{rows.source}: holds no joint values; name their columns with --map HEADING=q1_deg and so on, or join "
            "the file that holds them with --join point, order or time."
        )
    records = [list(record) for record in zip(*(rows.cells[name] for name in names), strict=True)]
    table = Table(
        source=rows.source,
        header=tuple(names),
        header_line=1,
        records=[record for record, used in zip(records, filled, strict=True) if used],
        lines=tuple(line for line, used in zip(rows.lines, filled, strict=True) if used),
        broken={},
    )
    fields_of(table)
    places = list(zip(rows.places, filled, strict=True))
    left_out = (LeftOutRow(place[0], place[1], "nothing was measured") for place, used in places if not used)
    return MeasurementTable(table, tuple(place for place, used in places if used), tuple(left_out))


def _order(name: str) -> tuple[int, int]:
    """Where a column stands: joints, position, orientation, others as they come."""
    column = find_column(name)
    assert column is not None
    if column.joint:
        return 0, column.joint
    measured = (*POSITION, *RPY, *QUATERNION)
    return 1, measured.index(column.quantity) if column.quantity in measured else len(measured)
