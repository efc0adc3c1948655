"""Propose the quantities of an export's columns from their headings or, without headings, from their order."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from pisigma.files.errors import MeasurementError, Phrase, Place
from pisigma.measurement.csv.columns import POSITION, QUATERNION, RPY
from pisigma.measurement.foreign.export_file import ExportFile
from pisigma.measurement.foreign.headings import (
    JOINT_NAMES,
    MAKERS,
    MEANINGS,
    POSITIONS,
    Heading,
    MakerHeadings,
    joint_of,
    parse_heading,
)
from pisigma.measurement.foreign.quantities import LEFT_OUT, ColumnTarget, MappedColumn, joints_of
from pisigma.measurement.foreign.rotations import MATRIX_ROWS, ROTATIONS, encodings_of
from pisigma.measurement.foreign.time_stamps import is_like_time, seconds_of
from pisigma.measurement.foreign.units import UNITS, UnitKind

NO_ROTATION = "none"
"""The choice of `--rotation` that leaves out rotations."""
UNRECOGNISED = "not recognised"
"""Reason that is stated for columns whose headings have no known meaning."""

_JOINTS_WITHOUT_HEADINGS = (6, 7)
_Side = Literal["commanded", "measured"]


@dataclass(eq=False)
class Proposal:
    """A mapping of columns under construction.

    Attributes:
        file: the export.
        columns: mapped columns by index.
        maker: the manufacturer that uses these column names; None if several do.
        ambiguous_encodings: encodings of rotations that fit the headings, if there are several.
    """

    file: ExportFile
    columns: dict[int, MappedColumn] = field(default_factory=dict)
    maker: MakerHeadings | None = None
    ambiguous_encodings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Parse the headings."""
        texts = self.file.headings if self.file.has_header else ("",) * len(self.file.headings)
        self.headings: list[Heading] = [parse_heading(text) for text in texts]

    @property
    def quantities(self) -> set[str]:
        """Quantities of the columns mapped so far."""
        return {column.target.quantity for column in self.columns.values()}

    def set_quantity(self, index: int, quantity: str, reason: str) -> None:
        """Set the quantity of a column."""
        target = ColumnTarget(quantity, "" if quantity == LEFT_OUT else self.headings[index].unit)
        self.columns[index] = MappedColumn(index, self.file.headings[index], target, reason)

    def columns_by_name(self, *kinds: UnitKind) -> dict[str, list[int]]:
        """Return the columns not yet mapped, by name, without columns whose heading states a unit of another kind.

        Args:
            kinds: kinds of units; empty for all columns.
        """
        names: dict[str, list[int]] = {}
        for index, heading in enumerate(self.headings):
            fitting = not kinds or not heading.unit or UNITS[heading.unit].kind in kinds
            if index not in self.columns and fitting:
                names.setdefault(heading.name, []).append(index)
        return names

    def assign_columns(
        self, quantities: Mapping[str, str], indices: Mapping[str, list[int]], value_kind: _Side, reason: str
    ) -> None:
        """Map columns by their names; of commanded and measured columns, keep only one kind."""
        for name, quantity in quantities.items():
            sides = {self.headings[index].value_kind for index in indices[name]}
            chosen = next(one for one in (value_kind, "", *sides) if one in sides)
            for index in indices[name]:
                if self.headings[index].value_kind == chosen:
                    self.set_quantity(index, quantity, reason)
                else:
                    self.set_quantity(index, LEFT_OUT, f"the {value_kind} values are used")

    def leave_out(
        self, column_names: Mapping[str, object], indices: Mapping[str, list[int]], reason: str
    ) -> None:
        """Leave out columns by their names."""
        for index in (index for name in column_names for index in indices.get(name, ())):
            self.set_quantity(index, LEFT_OUT, reason)


def propose_quantities(proposal: Proposal, rotation: str | None) -> None:
    """Map all columns that are not yet mapped.

    Args:
        proposal: the mapping with the stated columns.
        rotation: encoding of rotations, `NO_ROTATION`, or None to determine it by the headings.

    Raises:
        MeasurementError: there are no headings, and the number of columns does not determine their meanings.
    """
    if not proposal.file.has_header:
        _take_by_order(proposal, rotation)
    for index, heading in enumerate(proposal.headings):
        of_rotation = heading.name in (*RPY, *QUATERNION)
        if heading.is_column_name and index not in proposal.columns and not of_rotation:
            proposal.set_quantity(index, heading.name, "heading")
    _take_joints(proposal)
    _take_position(proposal)
    _take_rotation(proposal, rotation)
    _take_third_coordinate(proposal)
    ranks = {name: rank for rank, name in enumerate(MEANINGS)}
    for name, indices in sorted(
        proposal.columns_by_name().items(), key=lambda one: ranks.get(one[0], len(ranks))
    ):
        for index in indices:
            _take_other(proposal, name, index)
    _take_names(proposal)


def _take_by_order(proposal: Proposal, rotation: str | None) -> None:
    """Map columns without headings: joints and a position, a point and its position, or a position.

    Columns that are stated as other quantities, such as a time, are skipped.
    """
    stated = {index: one.target.quantity for index, one in proposal.columns.items()}
    order = [index for index in range(len(proposal.headings)) if _has_place(stated.get(index))]
    width = len(order)
    leading = int(0 not in stated and _is_counter(proposal.file))
    measured: tuple[str, ...] = POSITION
    if _ends_with_matrices(proposal.file, leading):
        measured = (*MATRIX_ROWS, *(LEFT_OUT,) * 4)
    elif rotation in ROTATIONS:
        measured = (*POSITION, *(ROTATIONS[rotation].columns or ROTATIONS[rotation].quantities()))
    joints = width - leading - len(measured)
    quantities = (*("point",) * leading, *(f"q{number + 1}" for number in range(joints)), *measured)
    of_index = dict(zip(order, quantities, strict=False))
    is_usual = joints in _JOINTS_WITHOUT_HEADINGS or (joints == 0 and measured == POSITION)
    is_otherwise = any(of_index.get(index, quantity) != quantity for index, quantity in stated.items())
    if is_otherwise or (not is_usual and len(set(stated) & set(order)) > 1):
        return  # in any other order, all columns must be stated
    if joints > 0:
        _check_times(proposal, of_index)
    if not is_usual:
        raise MeasurementError(
            expected="headings, or columns of six or seven joints and a position",
            value=Phrase(f"{len(proposal.headings)} columns without headings"),
            at=Place(proposal.file.source),
            remedy="name them by their numbers, such as --map 1=q1_deg,2=q2_deg,3=x_mm,4=-, and with --rotation if "
            "three angles or a quaternion follow the position",
        )
    for index, quantity in of_index.items():
        if index not in proposal.columns:
            proposal.set_quantity(index, quantity, "order of the columns, because there is no heading")


def _has_place(stated: str | None) -> bool:
    """Return whether a column is counted in the order of joints, position and rotation."""
    rotations = {name for one in ROTATIONS.values() for name in (*one.columns, *one.quantities())}
    return stated is None or bool(joints_of([stated])) or stated in {*POSITION, *RPY, *QUATERNION, *rotations}


def _is_counter(file: ExportFile) -> bool:
    """Return whether the first column contains names or numbers the rows consecutively."""
    cells = file.column(0)
    numbers = [int(cell) if cell.isdigit() and len(cell) < 9 else -1 for cell in cells]
    counts = len(cells) > 1 and all(number == i for i, number in enumerate(numbers, start=numbers[0]))
    return not any(map(file.dialect.is_number, cells)) or (counts and numbers[0] >= 0)


def _check_times(proposal: Proposal, of_index: Mapping[int, str]) -> None:
    """Refuse a column whose numbers rise or fall from row to row, because it may contain times.

    Args:
        proposal: the mapping of a file without headings.
        of_index: quantities of its columns by their order.

    Raises:
        MeasurementError: the column may contain times.
    """
    file = proposal.file
    for index, quantity in of_index.items():
        numbers = file.numbers(index)
        if index in proposal.columns or quantity == "point" or len(numbers) < len(file.records):
            continue
        if not is_like_time(numbers, is_first_column=not index):
            continue
        unit = "mm" if quantity in POSITION else "deg"
        raise MeasurementError(
            f"the file has no headings, and this column runs from {numbers[0]:g} to {numbers[-1]:g}, like a time",
            at=Place(file.source, file.lines[0], index + 1),
            value=f"{numbers[0]:g} to {numbers[-1]:g}",
            remedy=f"map it with --map {index + 1}=time_s or --map {index + 1}={quantity}_{unit}",
        )


def _ends_with_matrices(file: ExportFile, leading: int) -> bool:
    """Return whether the last 16 columns are the rows of homogeneous transforms."""
    ends = {tuple(map(file.dialect.number_format.to_plain_number, record[-4:])) for record in file.records}
    last = [0.0, 0.0, 0.0, 1.0]
    return len(file.headings) >= 16 + leading and all(
        None not in end and [float(text or 9) for text in end] == last for end in ends
    )


def _take_joints(proposal: Proposal) -> None:
    """Map the joints: the largest group of columns with names of joints, preferring a manufacturer's names.

    Stated joints have the number in their heading, otherwise the number of their target.
    """
    stated = [one for one in proposal.columns.values() if joints_of([one.target.quantity])]
    if not all(one.is_stated for one in stated):
        return
    names = proposal.columns_by_name("angle", "length")
    makers = [one for one in MAKERS if one.joints and (not one.x_heading or one.x_heading in names)]
    general = (MakerHeadings("", f"{name}#") for name in JOINT_NAMES)
    best: dict[str, int] = {}
    shift, most = 0, 1
    for maker in (*makers, *general):
        numbers = {name: number for name in names if (number := joint_of(name, maker.joints)) is not None}
        in_heading = [joint_of(proposal.headings[one.index].name, maker.joints) for one in stated]
        others = [
            int(one.target.quantity[1:]) if number is None else number
            for one, number in zip(stated, in_heading, strict=True)
        ]
        counted = sorted([*numbers.values(), *others])
        consecutive = counted in (list(range(1, len(counted) + 1)), list(range(len(counted))))
        if consecutive and numbers and len(counted) > most:
            best, most, proposal.maker = numbers, len(counted), maker if maker.name else None
            shift = 1 - counted[0]
    reason = f"name of {proposal.maker.name}" if proposal.maker else "heading"
    reason += ", counted from 0" if shift else ""
    group = {name: f"q{number + shift}" for name, number in best.items()}
    proposal.assign_columns(group, names, "commanded", reason)


def _take_position(proposal: Proposal) -> None:
    """Map the measured coordinates; a position that is only commanded is left out."""
    for group in POSITIONS:
        names, taken = proposal.columns_by_name("length"), proposal.quantities
        missing = {name: one for name, one in zip(group, POSITION, strict=True) if one not in taken}
        if not missing or not set(missing) <= set(names):
            continue
        if {proposal.headings[index].value_kind for name in missing for index in names[name]} == {
            "commanded"
        }:
            proposal.leave_out(missing, names, "commanded, not measured")
        else:
            proposal.assign_columns(missing, names, "measured", "heading")


def _take_rotation(proposal: Proposal, rotation: str | None) -> None:
    """Map the rotation by the names of its values, by the manufacturer of the joints, or as stated.

    Columns such as roll_deg have the meaning of measurement files only in a file whose joints and position have names
    of measurement files too, because elsewhere roll is often the angle about x.

    Raises:
        MeasurementError: the headings are those of another encoding than the stated one.
    """
    placed = [
        proposal.headings[index].is_column_name
        for index, one in proposal.columns.items()
        if not one.is_stated and (one.target.quantity in POSITION or joints_of([one.target.quantity]))
    ]
    for index, heading in enumerate(proposal.headings):
        of_file = rotation is None and all(placed) and heading.is_column_name
        if of_file and index not in proposal.columns and heading.name in (*RPY, *QUATERNION):
            proposal.set_quantity(index, heading.name, "heading")
    columns = {name for one in ROTATIONS.values() for name in (*one.columns, *one.quantities())}
    names = {
        name: indices
        for name, indices in proposal.columns_by_name("angle").items()
        if any(proposal.headings[index].value_kind != "commanded" for index in indices)
    }
    matches = {} if columns & proposal.quantities else encodings_of(set(names))
    if rotation == NO_ROTATION:
        for group in matches.values():
            proposal.leave_out(group, names, "--rotation none")
        return
    chosen = rotation or (proposal.maker.rotation_encoding if proposal.maker else "")
    if rotation is None and chosen not in matches and len(matches) == 1:
        chosen = next(iter(matches))
        makers = [one for one in MAKERS if not one.joints and one.rotation_encoding == chosen]
        proposal.maker = proposal.maker or next(iter(makers), None)
    if chosen in matches:
        encoding = ROTATIONS[chosen]
        quantities = encoding.columns or encoding.quantities()
        group = dict(zip(matches[chosen], quantities, strict=True))
        proposal.assign_columns(group, names, "measured", f"{chosen}: {encoding.meaning}")
    elif rotation is None:
        proposal.ambiguous_encodings = tuple(matches)
    elif matches:
        headings = ", ".join(next(iter(matches.values())))
        raise MeasurementError(
            option="--rotation",
            expected=f"{', '.join(matches)} or {NO_ROTATION}, which fit the headings {headings}",
            value=rotation,
            at=Place(proposal.file.source, proposal.file.header_line),
            remedy="state it, or name the columns with --map",
        )


def _take_names(proposal: Proposal) -> None:
    """Map the names of points; without a heading, this is the first column with a different name in every row."""
    file = proposal.file
    if "point" in proposal.quantities:
        return
    for index, column in sorted(proposal.columns.items()):
        cells = file.column(index)
        is_open = column.reason == UNRECOGNISED or (
            column.target.quantity == "target" and not column.is_stated
        )
        is_name = all(
            cell and not file.dialect.is_number(cell) and seconds_of(cell) is None for cell in cells
        )
        if file.has_header and is_open and is_name and len(set(cells)) == len(cells) > 1:
            proposal.columns[index] = MappedColumn(
                index, file.headings[index], ColumnTarget("point"), "a different name in every row"
            )
            return


def _take_third_coordinate(proposal: Proposal) -> None:
    """Map the third coordinate if two are stated: the only remaining length, or else the column in its place."""
    place = {
        one.target.quantity: index
        for index, one in proposal.columns.items()
        if one.target.quantity in POSITION and one.is_stated
    }
    missing = [one for one in POSITION if one not in proposal.quantities]
    if len(place) != 2 or len(missing) != 1:
        return
    open_rotations = [
        name
        for one in proposal.ambiguous_encodings
        for names in (ROTATIONS[one].values, *ROTATIONS[one].aliases)
        for name in names
    ]
    free = {
        index: proposal.headings[index].unit
        for name, indices in proposal.columns_by_name("length").items()
        if name not in (*MEANINGS, *open_rotations)
        for index in indices
        if proposal.file.numbers(index)
    }
    lengths = [index for index, unit in free.items() if unit]
    number, (first, second) = POSITION.index(missing[0]), sorted(place.items())
    step = (second[1] - first[1]) / (POSITION.index(second[0]) - POSITION.index(first[0]))
    in_place = first[1] + step * (number - POSITION.index(first[0]))
    if len(lengths) == 1:
        proposal.set_quantity(lengths[0], missing[0], "the only other length, with two stated coordinates")
    elif abs(step) == 1 and in_place in free:
        proposal.set_quantity(int(in_place), missing[0], "next to two stated coordinates")


def incomplete_rotation(proposal: Proposal) -> list[int]:
    """Return columns that have the names of all values of a rotation except one, with no other numbers in between.

    Args:
        proposal: the complete mapping; stated and used columns are ignored.
    """
    headings, file = proposal.headings, proposal.file
    free = [
        index
        for index, column in proposal.columns.items()
        if column.target.quantity == LEFT_OUT and column.reason == UNRECOGNISED and file.numbers(index)
    ]
    index_of = {headings[index].name: index for index in sorted(free)}
    numeric = [index for index in range(len(headings)) if file.numbers(index)]
    for encoding in ROTATIONS.values():
        for names in (encoding.values, *encoding.aliases):
            there = sorted(index_of[name] for name in names if name in index_of)
            apart = numeric.index(there[-1]) - numeric.index(there[0]) if there else 0
            if len(there) == len(names) - 1 and apart == len(there) - 1:
                return there
    return []


def _take_other(proposal: Proposal, name: str, index: int) -> None:
    """Map a column that is neither joint, position nor rotation."""
    unit = proposal.headings[index].unit
    of_unit = {"temperature": "temperature", "time": "time"}.get(UNITS[unit].kind if unit else "")
    quantity = of_unit or MEANINGS.get(name, LEFT_OUT)
    if quantity == LEFT_OUT:
        proposal.set_quantity(index, LEFT_OUT, UNRECOGNISED)
    elif quantity in proposal.quantities:
        proposal.set_quantity(index, LEFT_OUT, "another column has the same meaning")
    else:
        proposal.set_quantity(index, quantity, "heading")
