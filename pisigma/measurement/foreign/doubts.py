"""Why the values of an export can hardly be what its columns are read as."""

from pisigma.measurement.foreign.mapping import FileMapping, angles, coordinates, joint_columns
from pisigma.measurement.foreign.number_format import is_missing
from pisigma.measurement.foreign.quantities import MappedColumn
from pisigma.measurement.foreign.summary_rows import named_statistics, statistic
from pisigma.measurement.foreign.units import doubt

_TILTED = 0.2
"""Angles of rotations in degrees that are all smaller are those of a tool that hardly tilts."""


def doubts(mapping: FileMapping) -> tuple[str, ...]:
    """Name values that can hardly be in their units, external axes that move, and rows that may be no measurements.

    Every sentence names file, line and column.
    """
    sentences = [_left_out(mapping, one) for one in mapping.possible_joints]
    groups = (
        ("joint values", joint_columns(mapping.columns)),
        ("coordinates", coordinates(mapping.columns)),
        ("angles of the orientation", angles(mapping.columns)),
    )
    for name, columns in groups:
        for unit in dict.fromkeys(one.target.unit for one in columns):
            sentences.append(
                _of_unit(mapping, name, [one for one in columns if one.target.unit == unit], unit)
            )
    sentences += [*_no_values(mapping), *_called_means(mapping)]
    return tuple(filter(None, sentences))


def _of_unit(mapping: FileMapping, name: str, columns: list[MappedColumn], unit: str) -> str:
    """A sentence on values that are too large or too small for their unit."""
    values = [
        (abs(float(number)), line, column)
        for column in columns
        for line, cell in zip(mapping.file.lines, mapping.file.column(column.index), strict=True)
        if (number := mapping.file.dialect.numbers.text(cell)) is not None
    ]
    largest, line, column = max(values, key=lambda one: one[0], default=(0.0, 0, columns[0]))
    if name.startswith("angles") and largest < _TILTED:
        return ""
    reason = doubt(unit, largest, len(mapping.file.records))
    return f"{mapping.place(column, line)}: the {name} have {reason}; check their unit." if reason else ""


def _left_out(mapping: FileMapping, column: MappedColumn) -> str:
    """A sentence on an external axis that moves and is left out."""
    values = mapping.file.numbers(column.index)
    if not values or min(values) == max(values):
        return ""
    return (
        f"{mapping.place(column)}: it moves from {min(values):g} to {max(values):g} and is left out; if it is a "
        "joint of the robot, name it with --map."
    )


def _no_values(mapping: FileMapping) -> list[str]:
    """Sentences on positions all of whose coordinates are one number, as where nothing was measured."""
    columns = coordinates(mapping.columns)
    if len(columns) != 3:
        return []
    cells = zip(*(mapping.file.column(column.index) for column in columns), strict=True)
    return [
        f"{mapping.place(columns[0], line)}: all coordinates of the position are {row[0]}; leave the cells empty where "
        "nothing was measured."
        for line, row in zip(mapping.file.lines, cells, strict=True)
        if len(set(row)) == 1 and not is_missing(row[0])
    ]


def _called_means(mapping: FileMapping) -> list[str]:
    """A sentence on rows that are called means, where others are not, and are taken for measurements nevertheless."""
    records = mapping.file.records
    named = named_statistics(records)
    if not named or len(named) == len(records):
        return []
    row, name = next(iter(named.items()))
    column = next(one for one in mapping.columns if statistic(records[row][one.index]) == name)
    return [
        f"{mapping.place(column, mapping.file.lines[row])}: {len(named)} rows are called "
        f"'{records[row][column.index]}' and taken for measurements, as none is the mean of the rows before it; remove "
        "them if they summarise others."
    ]
