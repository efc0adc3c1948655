"""Convert the rows of an export to columns of measurement files, keeping all digits of every number."""

import csv
import io
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.files.errors import MeasurementError, Phrase, Place
from pisigma.measurement.csv.columns import POSITION, QUATERNION, RPY, find_column
from pisigma.measurement.csv.reading import fields_of
from pisigma.measurement.csv.table import Table
from pisigma.measurement.foreign.accounting import FileLine, LeftOutRow
from pisigma.measurement.foreign.dialect import is_missing
from pisigma.measurement.foreign.export_file import ExportFile
from pisigma.measurement.foreign.mapping import (
    FileMapping,
    ambiguous_spelling,
    joint_columns,
    position_columns,
    rotation_columns,
)
from pisigma.measurement.foreign.quantities import (
    KEYS,
    LEFT_OUT,
    MappedColumn,
    is_measured,
    measurement_column,
)
from pisigma.measurement.foreign.rotations import ROTATIONS, RotationEncoding
from pisigma.measurement.foreign.time_stamps import (
    ambiguous_date_error,
    day_first,
    has_ambiguous_date,
    iso_day,
)
from pisigma.measurement.foreign.units import AMBIGUOUS, UNITS, to_file_unit
from pisigma.robot.se3 import quaternion_from_rotation


@dataclass(frozen=True, eq=False)
class ConvertedRows:
    """Rows of one or several exports in columns of measurement files.

    Attributes:
        source: the file.
        lines: line numbers of the rows.
        cells: texts of every row by column, such as "q1_deg", and by the keys "point" and "time".
        origins: the file of every row; () if all rows come from the source.
    """

    source: str
    lines: tuple[int, ...]
    cells: Mapping[str, tuple[str, ...]]
    origins: tuple[str, ...] = ()

    @property
    def row_places(self) -> tuple[FileLine, ...]:
        """File and line of every row."""
        return tuple(zip(self.origins or (self.source,) * len(self.lines), self.lines, strict=True))


def check_quantities_and_units(mapping: FileMapping) -> None:
    """Check that quantities of the kept columns are unique, and that their units are stated and agree.

    Raises:
        MeasurementError: a quantity appears twice, a unit is missing or contradicts another, or the encoding of a
            rotation is unknown.
    """
    kept = [one for one in mapping.columns if one.target.quantity != LEFT_OUT]
    header = Place(mapping.file.source, mapping.file.header_line)
    for column in kept:
        other = mapping.quantities[column.target.quantity]
        if other != column:
            raise MeasurementError(
                f"the columns '{column.heading}' and '{other.heading}' are both {column.target.quantity}",
                at=mapping.place_of(column),
                value=column.target.quantity,
                remedy=f"omit one of them, for example with --map '{mapping.key(column)}=-'",
            )
    for group in (
        position_columns(mapping.columns),
        joint_columns(mapping.columns),
        rotation_columns(mapping.columns),
    ):
        for column in group:
            if column.target.unit and group[0].target.unit not in ("", column.target.unit):
                raise MeasurementError(
                    expected=f"the unit of '{group[0].heading}', {group[0].target.unit}",
                    value=column.target.unit,
                    at=mapping.place_of(column),
                    remedy="give both in one unit",
                )
    if mapping.ambiguous_encodings:
        raise MeasurementError(
            "the headings do not determine the encoding of the rotation",
            at=header,
            option="--rotation",
            value=", ".join(mapping.ambiguous_encodings),
            remedy=f"state one of {', '.join(mapping.ambiguous_encodings)}, or none to omit the rotation",
        )
    if mapping.incomplete_rotation:
        raise MeasurementError(
            expected="all values of a rotation",
            value=Phrase(", ".join(column.heading for column in mapping.incomplete_rotation)),
            at=header,
            remedy="add the missing column, or omit the rotation with --rotation none",
        )
    if lacking := mapping.columns_without_unit:
        names, many = ", ".join(f"'{one.heading}'" for one in lacking), "s" if len(lacking) > 1 else ""
        likely = mapping.likely_units
        first = next(
            replace(one.target, unit=likely[kind])
            for one in lacking
            if (kind := one.target.missing_unit_kind)
        )
        spellings = {
            ambiguous_spelling(mapping.file, one.index, one.target.missing_unit_kind) for one in lacking
        } - {""}
        meanings = "".join(f" ('{spelling}' means {AMBIGUOUS[spelling]})" for spelling in sorted(spellings))
        raise MeasurementError(
            f"the column{many} {names} have no unit{meanings}"
            if many
            else f"the column {names} has no unit{meanings}",
            at=mapping.place_of(lacking[0]),
            option="--unit",
            value=",".join(likely.values()),
            remedy=f"state the unit with --unit {','.join(likely.values())}, if that is right, or with "
            f"--map '{mapping.key(lacking[0])}={first.text}'",
        )


def convert_rows(mapping: FileMapping) -> ConvertedRows:
    """Convert the rows of a file.

    Raises:
        MeasurementError: see `check_quantities_and_units`, or the values of a row are not a rotation.
    """
    check_quantities_and_units(mapping)
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
                expected=f"all {len(columns)} values of a rotation in the encoding '{encoding.name}'",
                value=len(present),
                at=Place(file.source),
                remedy=f"map {', '.join(encoding.quantities())}",
            )
    return ConvertedRows(file.source, file.lines, cells)


def _key(file: ExportFile, quantity: str, texts: list[str], unit: str) -> tuple[str, ...]:
    """Return names of points unchanged, and numeric times converted to seconds."""
    if quantity == "point":
        return tuple(texts)
    numbers = [file.dialect.number_format.to_plain_number(text) for text in texts]
    return tuple(
        text if number is None else to_file_unit(number, unit)
        for text, number in zip(texts, numbers, strict=True)
    )


def _column(file: ExportFile, quantity: str, column: MappedColumn) -> tuple[str, tuple[str, ...]]:
    """Return the name and the cells of a column of measurement files."""
    unit = column.target.unit
    written = UNITS[unit].file_unit if unit else ""
    if quantity in RPY and written == "rad":
        numbers = _numbers(file, column)
        return f"{quantity}_deg", tuple(repr(math.degrees(float(text))) if text else "" for text in numbers)
    if quantity == "date":
        return quantity, _dates(file, column)
    name = measurement_column(quantity, written)
    kept = find_column(name)
    assert kept is not None  # parse_target and the proposals ensure that this does not happen
    return name, _numbers(file, column) if kept.is_number else tuple(file.column(column.index))


def _dates(file: ExportFile, column: MappedColumn) -> tuple[str, ...]:
    """Return the dates of a column in the form of ISO 8601; other texts are unchanged, and the reader checks them.

    Raises:
        MeasurementError: it is ambiguous whether day or month comes first.
    """
    texts = file.column(column.index)
    first, dates = day_first(texts), []
    for line, text in zip(file.lines, texts, strict=True):
        day = "" if is_missing(text) else iso_day(text, first)
        if day is None and has_ambiguous_date(text) and iso_day(text, True) is not None:
            raise ambiguous_date_error(Place(file.source, line, column.heading), text)
        dates.append(text if day is None else day)
    return tuple(dates)


def _numbers(file: ExportFile, column: MappedColumn) -> tuple[str, ...]:
    """Return the numbers of a column, as strings in the unit of measurement files; "" if nothing was measured.

    Raises:
        MeasurementError: a cell is not a number.
    """
    numbers = []
    for line, cell in zip(file.lines, file.column(column.index), strict=True):
        number = "" if is_missing(cell) else file.dialect.number_format.to_plain_number(cell)
        if number is None:
            sign = "point" if file.dialect.number_format.decimal == "." else "comma"
            raise MeasurementError(
                expected=f"a number with a decimal {sign}",
                value=cell,
                at=Place(file.source, line, column.heading),
                remedy="correct it, leave it empty if nothing was measured, or remove the row",
            )
        converted = to_file_unit(number, column.target.unit) if number else ""
        if converted and column.target.is_reversed:
            converted = converted[1:] if converted.startswith("-") else f"-{converted}"
        numbers.append(converted)
    return tuple(numbers)


def _rotation(
    file: ExportFile, encoding: RotationEncoding, columns: list[MappedColumn]
) -> dict[str, tuple[str, ...]]:
    """Return the quaternions of all rows as strings, by column; "" in rows without a rotation."""
    rows = list(zip(*(_numbers(file, column) for column in columns), strict=True))
    values = torch.tensor([[float(text or "nan") for text in row] for row in rows], dtype=torch.float64)
    if columns[0].target.unit and UNITS[columns[0].target.unit].file_unit == "deg":
        values = values.deg2rad()
    measured = torch.tensor([any(row) for row in rows], dtype=torch.bool)
    wrong = measured & ~encoding.is_rotation(values)
    if bool(wrong.any()):
        row = int(wrong.nonzero()[0, 0])
        raise MeasurementError(
            expected=f"a rotation in the encoding '{encoding.name}' ({encoding.meaning})",
            value=", ".join(file.column(column.index)[row] for column in columns),
            at=Place(file.source, file.lines[row], columns[0].heading),
            remedy="correct its cells, leave them empty, or state another --rotation",
        )
    quaternions = _quaternion_texts(encoding, values, measured)
    return dict(zip(QUATERNION, zip(*quaternions, strict=True), strict=True))


def _quaternion_texts(
    encoding: RotationEncoding, values: Float64[Tensor, "rows values"], measured: Tensor
) -> list[tuple[str, ...]]:
    """Return the quaternion of every row as strings, empty if nothing was measured."""
    texts: list[tuple[str, ...]] = [("",) * 4] * len(values)
    quaternions = quaternion_from_rotation(encoding.to_rotation(values[measured]))
    for row, quaternion in zip(measured.nonzero()[:, 0].tolist(), quaternions.tolist(), strict=True):
        texts[row] = tuple(map(repr, quaternion))
    return texts


@dataclass(frozen=True, eq=False)
class MeasurementTable:
    """The table of a measurement file.

    Attributes:
        table: table of the rows in which a value was measured.
        places: file and line of these rows.
        left_out: the rows that were left out, with the reasons.
    """

    table: Table
    places: tuple[FileLine, ...]
    left_out: tuple[LeftOutRow, ...]

    def text(self) -> str:
        """Return the text of the measurement file."""
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows([self.table.header, *self.table.records])
        return text.getvalue()


def measurement_table(rows: ConvertedRows) -> MeasurementTable:
    """Build the table of a measurement file, checking every row as the reader of measurement files does.

    Raises:
        MeasurementError: the rows are not valid measurements; `line` is the line of the export.
    """
    names = sorted((name for name in rows.cells if name not in KEYS), key=_order)
    measured = [rows.cells[name] for name in names if is_measured(name)]
    filled = [any(texts) for texts in zip(*measured, strict=True)]
    if not names:
        raise MeasurementError(
            expected="columns of joint values or measurements",
            value=Phrase("none"),
            at=Place(rows.source),
            remedy="name them with --map, such as --map HEADING=q1_deg,OTHER=x_mm",
        )
    if not any(filled):
        raise MeasurementError(
            expected="measurements",
            value=Phrase("joint values only"),
            at=Place(rows.source),
            remedy="name their columns with --map, or join the file that contains them with --join point, order or "
            "time",
        )
    if _order(names[0])[0]:
        raise MeasurementError(
            expected="joint values",
            value=Phrase("measurements only"),
            at=Place(rows.source),
            remedy="name their columns with --map HEADING=q1_deg and so on, or join the file that contains them with "
            "--join point, order or time",
        )
    records = [list(record) for record in zip(*(rows.cells[name] for name in names), strict=True)]
    table = Table(
        source=rows.source,
        header=tuple(names),
        header_line=1,
        records=[record for record, used in zip(records, filled, strict=True) if used],
        lines=tuple(line for line, used in zip(rows.lines, filled, strict=True) if used),
        invalid_rows={},
    )
    fields_of(table)
    places = list(zip(rows.row_places, filled, strict=True))
    left_out = (LeftOutRow(place[0], place[1], "nothing was measured") for place, used in places if not used)
    return MeasurementTable(table, tuple(place for place, used in places if used), tuple(left_out))


def _order(name: str) -> tuple[int, int]:
    """Return the sort key of a column: joints, position, orientation, others."""
    column = find_column(name)
    assert column is not None
    if column.joint:
        return 0, column.joint
    measured = (*POSITION, *RPY, *QUATERNION)
    return 1, measured.index(column.quantity) if column.quantity in measured else len(measured)
