"""Map the columns of an export to quantities and units, as stated or proposed, and warn about doubtful columns."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

from pisigma.files.errors import MeasurementError, Place, check_choice
from pisigma.measurement.csv.columns import POSITION
from pisigma.measurement.foreign.dialect import is_missing
from pisigma.measurement.foreign.export_file import ExportFile
from pisigma.measurement.foreign.headings import MakerHeadings, parse_heading
from pisigma.measurement.foreign.proposal import (
    NO_ROTATION,
    UNRECOGNISED,
    Proposal,
    incomplete_rotation,
    propose_quantities,
)
from pisigma.measurement.foreign.quantities import (
    KEYS,
    LEFT_OUT,
    ColumnTarget,
    MappedColumn,
    fits_unit,
    is_joint,
    joints_of,
    parse_target,
    unit_kind,
)
from pisigma.measurement.foreign.rotations import ROTATIONS
from pisigma.measurement.foreign.summary_rows import named_statistics, statistic_name
from pisigma.measurement.foreign.units import (
    AMBIGUOUS,
    UNITS,
    UnitKind,
    ambiguous_unit,
    is_unit_certain,
    reason_to_doubt,
    stated_units,
    unit_symbol,
)

_JOINT_LIKE = re.compile(r"e(?:ax|xt)?[1-6a-f]|[qj]\d.*")
"""Pattern of names of external axes, and of names that start like names of joints."""
_MIN_TILT = 0.2
"""Largest angle of rotations [deg or rad] below which the unit is uncertain, because the tool may hardly tilt."""


@dataclass(frozen=True, eq=False)
class FileMapping:
    """An exported file, and the meaning of its columns.

    Attributes:
        file: the export.
        columns: all columns, in the order of the file.
        ambiguous_encodings: encodings of rotations that fit the headings; () if at most one does.
        incomplete_rotation: columns that contain some but not all values of a rotation; () if there are none.
    """

    file: ExportFile
    columns: tuple[MappedColumn, ...]
    ambiguous_encodings: tuple[str, ...] = ()
    incomplete_rotation: tuple[MappedColumn, ...] = ()

    @property
    def quantities(self) -> dict[str, MappedColumn]:
        """Columns that are kept, by quantity."""
        return {one.target.quantity: one for one in self.columns if one.target.quantity != LEFT_OUT}

    @property
    def has_joints(self) -> bool:
        """Whether the file contains joint values."""
        return bool(joints_of(self.quantities))

    @property
    def has_measured_values(self) -> bool:
        """Whether the file contains kept columns other than joint values, names and times."""
        return bool(set(self.quantities) - {*KEYS, *joints_of(self.quantities)})

    def key(self, column: MappedColumn) -> str:
        """Return the name of a column in mappings: its heading, or its number if several columns have that heading."""
        return column.heading if self.file.headings.count(column.heading) == 1 else str(column.index + 1)

    @property
    def columns_without_unit(self) -> tuple[MappedColumn, ...]:
        """Columns whose unit is unknown; times without a unit are in seconds."""
        return tuple(one for one in self.columns if one.target.missing_unit_kind not in (None, "time"))

    @property
    def likely_units(self) -> dict[UnitKind, str]:
        """Likely units of the columns without a unit, by kind of unit."""
        kinds = {one.target.missing_unit_kind for one in self.columns_without_unit}
        small_angles = is_unit_certain("rad", largest_value(self.file, joint_columns(self.columns)))
        length = (
            "m" if is_unit_certain("m", largest_value(self.file, position_columns(self.columns))) else "mm"
        )
        likely = (length, "rad" if small_angles else "deg", "kg", "c")
        return {UNITS[symbol].kind: symbol for symbol in likely if UNITS[symbol].kind in kinds}

    @property
    def title(self) -> str:
        """Line of text with file, number of rows and format."""
        return f"{self.file.source}: {len(self.file.records)} rows, {self.file.dialect}"

    def place_of(self, column: MappedColumn, line: int = 0) -> Place:
        """Return file, line and column for messages, by default the line of the headings."""
        return Place(self.file.source, line or self.file.header_line, column.heading)

    def first_cell(self, column: MappedColumn) -> str:
        """Return the first cell of a column that is not empty."""
        return next(filter(None, self.file.column(column.index)), "")

    @property
    def left_out_joint_columns(self) -> list[MappedColumn]:
        """Columns that are left out although they are named like joints."""
        left_out = [
            one for one in self.columns if one.target.quantity == LEFT_OUT and one.reason == UNRECOGNISED
        ]
        return [one for one in left_out if _JOINT_LIKE.fullmatch(parse_heading(one.heading).name)]


def map_columns(
    file: ExportFile, targets: Mapping[str, str], rotation: str | None, units: Mapping[UnitKind, str]
) -> FileMapping:
    """Determine the quantities and units of the columns of a file.

    Units are taken, in this order, from the mapping, the heading, the unit row, the comments, `units`, the stated unit
    of the other coordinates (for a coordinate), and the manufacturer that uses these names, if the values cannot be in
    another unit.

    Args:
        file: the export.
        targets: targets by heading or number of a column, see `parse_target`; names of columns that the file does not
            have are ignored.
        rotation: encoding of the rotations, `NO_ROTATION` to leave them out, None to determine it from the headings.
        units: symbols by kind of unit, for columns for which the file does not state a unit.

    Raises:
        MeasurementError: a statement does not fit the file, or the headings do not determine the columns.
    """
    if rotation is not None:
        check_choice(MeasurementError, "--rotation", rotation, (NO_ROTATION, *ROTATIONS))
    proposal = Proposal(file)
    for name, text in targets.items():
        _take_stated(proposal, name, text)
    propose_quantities(proposal, rotation)
    columns = tuple(proposal.columns[index] for index in range(len(file.headings)))
    incomplete = (
        () if rotation == NO_ROTATION else tuple(columns[index] for index in incomplete_rotation(proposal))
    )
    return FileMapping(file, _with_units(columns, proposal, units), proposal.ambiguous_encodings, incomplete)


def _take_stated(proposal: Proposal, name: str, text: str) -> None:
    """Map the columns that the caller names by heading or number."""
    file = proposal.file
    indices = [index for index, heading in enumerate(file.headings) if heading == name]
    if not indices and name.isdigit() and 1 <= int(name[:9]) <= len(file.headings):
        indices = [int(name) - 1]
    for index in indices:
        target, written = parse_target(text, name), _written_unit(proposal, index)
        if target.unit and written and target.unit != written and not target.overrides_unit:
            raise MeasurementError(
                option="--map",
                expected=f"{written}, as the file states",
                value=target.unit,
                at=Place(file.source, file.header_line, name),
                remedy=f"map it to {ColumnTarget(target.quantity, written).text}, or to {text}! if the file is wrong",
            )
        if target.missing_unit_kind and fits_unit(target.quantity, written):
            target = replace(target, unit=written)
        proposal.columns[index] = MappedColumn(index, file.headings[index], target, "stated", True)


def _written_unit(proposal: Proposal, index: int) -> str:
    """Return the unit that the heading or the unit row states."""
    return proposal.headings[index].unit or unit_symbol(proposal.file.units[index])


def _with_units(
    columns: tuple[MappedColumn, ...], proposal: Proposal, units: Mapping[UnitKind, str]
) -> tuple[MappedColumn, ...]:
    """Return the columns, adding missing units as far as they can be determined."""
    file = proposal.file
    written = stated_units(file.comments)
    for stated, symbol in units.items():
        if written.get(stated, symbol) not in (symbol, *AMBIGUOUS):
            raise MeasurementError(
                option="--unit",
                expected=f"{written[stated]} as the file states",
                value=symbol,
                at=Place(file.source),
                remedy=f"omit {symbol}, or state the units of single columns with --map",
            )
    others = {one.target.unit for one in position_columns(columns) if one.is_stated and one.target.unit}
    of_others: dict[UnitKind, str] = {"length": next(iter(others))} if len(others) == 1 else {}
    of_comments = {kind: symbol for kind, symbol in written.items() if symbol not in AMBIGUOUS}
    of_maker = _units_of_maker(proposal.maker, file, columns)
    completed = []
    for column in columns:
        target, kind = column.target, column.target.missing_unit_kind
        unit_row, ambiguous = (
            unit_symbol(file.units[column.index]),
            ambiguous_spelling(file, column.index, kind),
        )
        if kind is not None and unit_row and fits_unit(target.quantity, unit_row):
            completed.append(replace(column, target=replace(target, unit=unit_row)))
            continue
        open_unit = not unit_row and (bool(ambiguous) or not proposal.headings[column.index].unknown_unit)
        sources = (
            ("a comment", of_comments),
            ("--unit", units),
            ("the other coordinates", of_others if target.quantity in POSITION else {}),
            ("the maker", of_maker),
        )
        for source, by_kind in sources:
            if ambiguous and source != "--unit":
                continue  # only the caller knows the intended unit
            if kind is not None and kind in by_kind and open_unit and not target.unit:
                target = replace(target, unit=by_kind[kind])
                column = replace(column, target=target, reason=f"{column.reason}; unit by {source}")
        completed.append(column)
    return tuple(completed)


def ambiguous_spelling(file: ExportFile, index: int, kind: UnitKind | None) -> str:
    """Return the ambiguous unit that a file states for a column; "" if there is none.

    Args:
        file: the export, with headings, unit row and comments.
        index: index of the column.
        kind: kind of unit that the column needs.
    """
    if kind is None:
        return ""
    stated = stated_units(file.comments).get(kind, "")
    spellings = (parse_heading(file.headings[index]).unknown_unit, file.units[index], stated)
    return next(filter(None, map(ambiguous_unit, spellings)), "")


def _units_of_maker(
    maker: MakerHeadings | None, file: ExportFile, columns: tuple[MappedColumn, ...]
) -> dict[UnitKind, str]:
    """Return the units that a manufacturer always uses, if the values cannot be in another unit."""
    if maker is None:
        return {}
    kinds: tuple[tuple[UnitKind, str, list[MappedColumn]], ...] = (
        ("angle", maker.angle_unit, joint_columns(columns) or rotation_columns(columns)),
        ("length", maker.length_unit, position_columns(columns)),
    )
    return {
        kind: symbol
        for kind, symbol, group in kinds
        if symbol and is_unit_certain(symbol, largest_value(file, group))
    }


def joint_columns(columns: tuple[MappedColumn, ...]) -> list[MappedColumn]:
    """Return the columns of revolute joints, or of joints whose unit is unknown."""
    joints = [one for one in columns if is_joint(one.target.quantity)]
    return [one for one in joints if not one.target.unit or UNITS[one.target.unit].kind == "angle"]


def position_columns(columns: tuple[MappedColumn, ...]) -> list[MappedColumn]:
    """Return the columns of the position."""
    return [one for one in columns if one.target.quantity in POSITION]


def rotation_columns(columns: tuple[MappedColumn, ...]) -> list[MappedColumn]:
    """Return the columns with angles of rotations."""
    return [
        one
        for one in columns
        if not is_joint(one.target.quantity) and unit_kind(one.target.quantity) == "angle"
    ]


def largest_value(file: ExportFile, columns: list[MappedColumn]) -> float:
    """Return the largest absolute value in columns, in the file's unit."""
    return max((abs(number) for column in columns for number in file.numbers(column.index)), default=0.0)


def mapping_warnings(mapping: FileMapping) -> tuple[str, ...]:
    """Return warnings about values that are unlikely in their unit, external axes that move, and doubtful rows.

    Every sentence states file, line and column.
    """
    sentences = [_left_out(mapping, one) for one in mapping.left_out_joint_columns]
    groups = (
        ("joint values", joint_columns(mapping.columns)),
        ("coordinates", position_columns(mapping.columns)),
        ("angles of the orientation", rotation_columns(mapping.columns)),
    )
    for name, columns in groups:
        for unit in dict.fromkeys(one.target.unit for one in columns):
            sentences.append(
                _of_unit(mapping, name, [one for one in columns if one.target.unit == unit], unit)
            )
    sentences += [*_no_values(mapping), *_called_means(mapping)]
    return tuple(filter(None, sentences))


def _of_unit(mapping: FileMapping, name: str, columns: list[MappedColumn], unit: str) -> str:
    """Return a warning about values that are too large or too small for their unit; "" if there are none."""
    values = [
        (abs(float(number)), line, column)
        for column in columns
        for line, cell in zip(mapping.file.lines, mapping.file.column(column.index), strict=True)
        if (number := mapping.file.dialect.number_format.to_plain_number(cell)) is not None
    ]
    largest, line, column = max(values, key=lambda one: one[0], default=(0.0, 0, columns[0]))
    if name.startswith("angles") and largest < _MIN_TILT:
        return ""
    reason = reason_to_doubt(unit, largest, len(mapping.file.records))
    return f"{mapping.place_of(column, line)}: the {name} have {reason}; check their unit." if reason else ""


def _left_out(mapping: FileMapping, column: MappedColumn) -> str:
    """Return a warning about an external axis that moves and is left out; "" if it does not move."""
    values = mapping.file.numbers(column.index)
    if not values or min(values) == max(values):
        return ""
    return (
        f"{mapping.place_of(column)}: the column varies from {min(values):g} to {max(values):g} and is left out; if "
        "it is a joint of the robot, name it with --map."
    )


def _no_values(mapping: FileMapping) -> list[str]:
    """Return warnings about positions with three equal coordinates, which may mark rows without a measurement."""
    columns = position_columns(mapping.columns)
    if len(columns) != 3:
        return []
    cells = zip(*(mapping.file.column(column.index) for column in columns), strict=True)
    return [
        f"{mapping.place_of(columns[0], line)}: all coordinates of the position are {row[0]}; leave the cells empty if "
        "nothing was measured."
        for line, row in zip(mapping.file.lines, cells, strict=True)
        if len(set(row)) == 1 and not is_missing(row[0])
    ]


def _called_means(mapping: FileMapping) -> list[str]:
    """Return a warning about rows that are named as means but are used as measurements."""
    records = mapping.file.records
    named = named_statistics(records)
    if not named or len(named) == len(records):
        return []
    row, name = next(iter(named.items()))
    column = next(one for one in mapping.columns if statistic_name(records[row][one.index]) == name)
    return [
        f"{mapping.place_of(column, mapping.file.lines[row])}: {len(named)} rows are named "
        f"'{records[row][column.index]}' and used as measurements, because none is the mean of the rows before it; "
        "remove "
        "them if they summarise others."
    ]
