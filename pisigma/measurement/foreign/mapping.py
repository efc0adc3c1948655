"""Which column of an export is what, and in which unit: as stated, else as proposed."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

from pisigma.errors import MeasurementError, nearest_choice
from pisigma.measurement.foreign.export_file import ExportFile
from pisigma.measurement.foreign.headings import Maker, parse_heading
from pisigma.measurement.foreign.proposal import NO_ROTATION, UNRECOGNISED, Proposal, propose
from pisigma.measurement.foreign.quantities import (
    KEYS,
    LEFT_OUT,
    MappedColumn,
    Target,
    fits,
    is_joint,
    joints_of,
    parse_target,
    unit_kind,
)
from pisigma.measurement.foreign.rotations import ROTATIONS
from pisigma.measurement.foreign.units import UNITS, UnitKind, doubt, is_certain, stated_units

_JOINT_LIKE = re.compile(r"e(?:ax|xt)?[1-6a-f]|[qj]\d.*")
"""How external axes are called, and what begins like a joint."""


@dataclass(frozen=True, eq=False)
class FileMapping:
    """A file and what its columns are.

    Attributes:
        file: the export.
        columns: all of them, in its order.
        rotations: encodings between which the headings do not decide; () where nothing is open.
    """

    file: ExportFile
    columns: tuple[MappedColumn, ...]
    rotations: tuple[str, ...] = ()

    @property
    def quantities(self) -> dict[str, MappedColumn]:
        """The columns that are kept, by what they are."""
        return {one.target.quantity: one for one in self.columns if one.target.quantity != LEFT_OUT}

    @property
    def has_joints(self) -> bool:
        """Whether it holds joint values."""
        return bool(joints_of(self.quantities))

    @property
    def has_measured(self) -> bool:
        """Whether it holds anything else that is kept, besides names and times of the rows."""
        return bool(set(self.quantities) - {*KEYS, *joints_of(self.quantities)})

    def key(self, column: MappedColumn) -> str:
        """Name a column as mappings do: by its heading, or by its number where several have that."""
        return column.heading if self.file.headings.count(column.heading) == 1 else str(column.index + 1)

    @property
    def without_unit(self) -> tuple[MappedColumn, ...]:
        """The columns whose unit is not known; a time without one is in s."""
        return tuple(one for one in self.columns if one.target.needs not in (None, "time"))

    @property
    def likely_units(self) -> dict[UnitKind, str]:
        """Likely units of the columns without, by what they measure."""
        kinds = {one.target.needs for one in self.without_unit}
        small_angles = is_certain("rad", largest(self.file, joint_columns(self.columns)))
        length = "m" if is_certain("m", largest(self.file, coordinates(self.columns))) else "mm"
        likely = (length, "rad" if small_angles else "deg", "kg", "c")
        return {UNITS[symbol].kind: symbol for symbol in likely if UNITS[symbol].kind in kinds}

    @property
    def title(self) -> str:
        """What was read, and how it is written."""
        return f"{self.file.source}: {len(self.file.records)} rows, {self.file.dialect}"

    def example(self, column: MappedColumn) -> str:
        """The first cell of a column that is not empty."""
        return next(filter(None, self.file.column(column.index)), "")

    @property
    def possible_joints(self) -> list[MappedColumn]:
        """The columns that are left out, but that are named as joints are."""
        left_out = [
            one for one in self.columns if one.target.quantity == LEFT_OUT and one.reason == UNRECOGNISED
        ]
        return [one for one in left_out if _JOINT_LIKE.fullmatch(parse_heading(one.heading).name)]

    @property
    def doubts(self) -> tuple[str, ...]:
        """Why its values can hardly be in their units, each a sentence."""
        sentences = [self._left_out(one) for one in self.possible_joints]
        for name, columns in (
            ("joint values", joint_columns(self.columns)),
            ("coordinates", coordinates(self.columns)),
        ):
            for symbol in dict.fromkeys(one.target.unit for one in columns):
                of_unit = [one for one in columns if one.target.unit == symbol]
                if reason := doubt(symbol, largest(self.file, of_unit), len(self.file.records)):
                    sentences.append(f"{self.file.source}: the {name} have {reason}; check their unit.")
        return tuple(filter(None, sentences))

    def _left_out(self, column: MappedColumn) -> str:
        """A sentence on an external axis that moves and is left out."""
        values = self.file.numbers(column.index)
        if not values or min(values) == max(values):
            return ""
        return (
            f"{self.file.source}: '{column.heading}' moves from {min(values):g} to {max(values):g} and is left out; "
            "if it is a joint of the robot, name it with --map."
        )


def map_columns(
    file: ExportFile, stated: Mapping[str, str], rotation: str | None, units: Mapping[UnitKind, str]
) -> FileMapping:
    """Find out what the columns of a file are and in which units.

    A unit is taken from the mapping, the heading, the unit row, the comments, from `units`, and last from the maker
    whose names these are, where the values can be in no other unit.

    Args:
        file: the export.
        stated: by heading, or by number of a column, what it is; see `parse_target`. Others are not looked at.
        rotation: encoding of the rotations, `NO_ROTATION` to leave them out, None to tell it by the headings.
        units: by what they measure, symbols of the units of columns for which the file states none.

    Raises:
        MeasurementError: a statement does not fit the file, or there are no headings that say what the columns are.
    """
    if rotation is not None and rotation not in (NO_ROTATION, *ROTATIONS):
        raise MeasurementError(
            f"--rotation {rotation}: {nearest_choice(rotation, (NO_ROTATION, *ROTATIONS))}"
        )
    proposal = Proposal(file)
    for name, text in stated.items():
        _take_stated(proposal, name, text)
    propose(proposal, rotation)
    columns = tuple(proposal.columns[index] for index in range(len(file.headings)))
    return FileMapping(file, _with_units(columns, proposal, units), proposal.rotations)


def _take_stated(proposal: Proposal, name: str, text: str) -> None:
    """Columns that the caller names, by heading or by number."""
    file = proposal.file
    indices = [index for index, heading in enumerate(file.headings) if heading == name]
    if not indices and name.isdigit() and 1 <= int(name[:9]) <= len(file.headings):
        indices = [int(name) - 1]
    for index in indices:
        target, written = parse_target(text, f"--map {name}={text}"), _written_unit(proposal, index)
        if target.unit and written and target.unit != written:
            raise MeasurementError(
                f"{file.source}, column '{name}': --map says {target.unit}, but the file says {written}; map it to "
                f"{Target(target.quantity, written).text}."
            )
        if target.needs and fits(target.quantity, written):
            target = replace(target, unit=written)
        proposal.columns[index] = MappedColumn(index, file.headings[index], target, "stated", True)


def _written_unit(proposal: Proposal, index: int) -> str:
    """The unit that heading or unit row state."""
    return proposal.headings[index].unit or proposal.file.units[index]


def _with_units(
    columns: tuple[MappedColumn, ...], proposal: Proposal, units: Mapping[UnitKind, str]
) -> tuple[MappedColumn, ...]:
    """The columns with the units that their targets lack, as far as they are to be had."""
    file = proposal.file
    written = stated_units(file.comments)
    for stated, symbol in units.items():
        if written.get(stated, symbol) != symbol:
            raise MeasurementError(
                f"{file.source}: --unit says {symbol}, but the file says {written[stated]}; leave {symbol} away, or "
                "state the units of single columns with --map."
            )
    of_maker = _units_of_maker(proposal.maker, file, columns)
    completed = []
    for column in columns:
        target, kind = column.target, column.target.needs
        unit_row = file.units[column.index]
        if kind is not None and unit_row and fits(target.quantity, unit_row):
            completed.append(replace(column, target=replace(target, unit=unit_row)))
            continue
        open_unit = not unit_row and not proposal.headings[column.index].unknown_unit
        for source, by_kind in (("a comment", written), ("--unit", units), ("the maker", of_maker)):
            if kind is not None and kind in by_kind and open_unit and not target.unit:
                target = replace(target, unit=by_kind[kind])
                column = replace(column, target=target, reason=f"{column.reason}; unit by {source}")
        completed.append(column)
    return tuple(completed)


def _units_of_maker(
    maker: Maker | None, file: ExportFile, columns: tuple[MappedColumn, ...]
) -> dict[UnitKind, str]:
    """The units that a maker always writes, where the values can be in no other one."""
    if maker is None:
        return {}
    kinds: tuple[tuple[UnitKind, str, list[MappedColumn]], ...] = (
        ("angle", maker.angle, joint_columns(columns) or angles(columns)),
        ("length", maker.length, coordinates(columns)),
    )
    return {
        kind: symbol for kind, symbol, group in kinds if symbol and is_certain(symbol, largest(file, group))
    }


def joint_columns(columns: tuple[MappedColumn, ...]) -> list[MappedColumn]:
    """The columns of joints that turn, or whose unit is not known."""
    turning = [one for one in columns if is_joint(one.target.quantity)]
    return [one for one in turning if not one.target.unit or UNITS[one.target.unit].kind == "angle"]


def coordinates(columns: tuple[MappedColumn, ...]) -> list[MappedColumn]:
    """The columns of the position."""
    return [one for one in columns if one.target.quantity in ("x", "y", "z")]


def angles(columns: tuple[MappedColumn, ...]) -> list[MappedColumn]:
    """The columns of angles of rotations."""
    return [
        one
        for one in columns
        if not is_joint(one.target.quantity) and unit_kind(one.target.quantity) == "angle"
    ]


def largest(file: ExportFile, columns: list[MappedColumn]) -> float:
    """The largest absolute value in columns, in the file's unit."""
    return max((abs(number) for column in columns for number in file.numbers(column.index)), default=0.0)
