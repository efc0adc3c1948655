"""The table of a measurement file, made of converted rows."""

import csv
import io
from dataclasses import dataclass

from pisigma.files.errors import MeasurementError
from pisigma.measurement.csv.columns import POSITION, QUATERNION, RPY, find_column
from pisigma.measurement.csv.reading import fields_of
from pisigma.measurement.csv.table import Table
from pisigma.measurement.foreign.accounting import LeftOutRow, Place
from pisigma.measurement.foreign.conversion import ConvertedRows
from pisigma.measurement.foreign.quantities import KEYS, is_measured


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
