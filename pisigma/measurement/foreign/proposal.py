"""What the columns of an export probably are, by their headings, or by their order where there are none."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from pisigma.errors import MeasurementError
from pisigma.measurement.csv.columns import POSITION
from pisigma.measurement.foreign.export_file import ExportFile
from pisigma.measurement.foreign.headings import (
    JOINT_NAMES,
    MAKERS,
    MEANINGS,
    POSITIONS,
    Heading,
    Maker,
    joint_of,
    parse_heading,
)
from pisigma.measurement.foreign.quantities import LEFT_OUT, MappedColumn, Target, joints_of
from pisigma.measurement.foreign.rotations import MATRIX_ROWS, ROTATIONS, encodings_of
from pisigma.measurement.foreign.units import UNITS, UnitKind

NO_ROTATION = "none"
"""The encoding of rotations that are not wanted."""
UNRECOGNISED = "not recognised"
"""Why a column is left out whose heading means nothing."""

_JOINTS_WITHOUT_HEADINGS = (6, 7)
_Side = Literal["commanded", "measured"]


@dataclass(eq=False)
class Proposal:
    """A mapping of columns that is being made.

    Attributes:
        file: the export.
        columns: by index what is decided.
        maker: whose names the columns have; None where several makers write so.
        rotations: encodings between which the headings do not decide.
    """

    file: ExportFile
    columns: dict[int, MappedColumn] = field(default_factory=dict)
    maker: Maker | None = None
    rotations: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Take the headings apart."""
        texts = self.file.headings if self.file.has_header else ("",) * len(self.file.headings)
        self.headings: list[Heading] = [parse_heading(text) for text in texts]

    @property
    def quantities(self) -> set[str]:
        """What the decided columns are."""
        return {column.target.quantity for column in self.columns.values()}

    def put(self, index: int, quantity: str, reason: str) -> None:
        """Decide what a column is."""
        target = Target(quantity, "" if quantity == LEFT_OUT else self.headings[index].unit)
        self.columns[index] = MappedColumn(index, self.file.headings[index], target, reason)

    def names(self, *kinds: UnitKind) -> dict[str, list[int]]:
        """The columns that are not decided by their names; those whose heading states a unit of another kind are not.

        Args:
            kinds: of units; none of them for all columns.
        """
        names: dict[str, list[int]] = {}
        for index, heading in enumerate(self.headings):
            fitting = not kinds or not heading.unit or UNITS[heading.unit].kind in kinds
            if index not in self.columns and fitting:
                names.setdefault(heading.name, []).append(index)
        return names

    def put_group(
        self, group: Mapping[str, str], names: Mapping[str, list[int]], side: _Side, reason: str
    ) -> None:
        """Decide what columns are by their names; where some are commanded and some measured, those of one side."""
        for name, quantity in group.items():
            sides = {self.headings[index].side for index in names[name]}
            wanted = next(one for one in (side, "", *sides) if one in sides)
            for index in names[name]:
                if self.headings[index].side == wanted:
                    self.put(index, quantity, reason)
                else:
                    self.put(index, LEFT_OUT, f"the {side} values are taken")

    def leave_out(self, group: Mapping[str, object], names: Mapping[str, list[int]], reason: str) -> None:
        """Leave columns out by their names."""
        for index in (index for name in group for index in names.get(name, ())):
            self.put(index, LEFT_OUT, reason)


def propose(proposal: Proposal, rotation: str | None) -> None:
    """Decide what all columns are that are not decided.

    Args:
        proposal: with what is stated.
        rotation: encoding of rotations, `NO_ROTATION`, or None to tell it by the headings.

    Raises:
        MeasurementError: there are no headings, and the number of columns does not tell either.
    """
    if not proposal.file.has_header and not proposal.columns:
        _take_by_order(proposal, rotation)
    for index, heading in enumerate(proposal.headings):
        if heading.is_column and index not in proposal.columns:
            proposal.put(index, heading.name, "heading")
    _take_joints(proposal)
    _take_position(proposal)
    _take_rotation(proposal, rotation)
    ranks = {name: rank for rank, name in enumerate(MEANINGS)}
    for name, indices in sorted(proposal.names().items(), key=lambda one: ranks.get(one[0], len(ranks))):
        for index in indices:
            _take_other(proposal, name, index)


def _take_by_order(proposal: Proposal, rotation: str | None) -> None:
    """Columns without headings: joints and a position, a point and its position, or a position."""
    width, leading = len(proposal.headings), int(_is_counter(proposal.file))
    measured: tuple[str, ...] = POSITION
    if _ends_with_matrices(proposal.file, leading):
        measured = (*MATRIX_ROWS, *(LEFT_OUT,) * 4)
    elif rotation in ROTATIONS:
        measured = (*POSITION, *(ROTATIONS[rotation].columns or ROTATIONS[rotation].quantities()))
    joints = width - leading - len(measured)
    if joints not in _JOINTS_WITHOUT_HEADINGS and (joints != 0 or measured != POSITION):
        raise MeasurementError(
            f"{proposal.file.source}: the file has no headings, and its {width} columns are not six or seven joints "
            "and a position; say what they are by their numbers, such as --map 1=q1_deg,2=q2_deg,3=x_mm,4=-, and by "
            "--rotation where three angles or a quaternion follow the position."
        )
    quantities = (*("point",) * leading, *(f"q{number + 1}" for number in range(joints)), *measured)
    for index, quantity in enumerate(quantities):
        proposal.put(index, quantity, "its order, as there is no heading")


def _is_counter(file: ExportFile) -> bool:
    """Whether the first column holds names, or counts the rows."""
    cells = file.column(0)
    counts = [cell.isdigit() and len(cell) < 9 and int(cell) == i for i, cell in enumerate(cells, start=1)]
    return not any(map(file.dialect.is_number, cells)) or (len(cells) > 1 and all(counts))


def _ends_with_matrices(file: ExportFile, leading: int) -> bool:
    """Whether the last 16 columns are the rows of homogeneous transforms."""
    ends = {tuple(map(file.dialect.numbers.text, record[-4:])) for record in file.records}
    last = [0.0, 0.0, 0.0, 1.0]
    return len(file.headings) >= 16 + leading and all(
        None not in end and [float(text or 9) for text in end] == last for end in ends
    )


def _take_joints(proposal: Proposal) -> None:
    """The largest group of columns that are named as joints are; of equally large ones that with a maker's names.

    Joints that are stated count with the number in their heading, or else with their own.
    """
    stated = [one for one in proposal.columns.values() if joints_of([one.target.quantity])]
    if not all(one.is_stated for one in stated):
        return
    names = proposal.names("angle", "length")
    makers = [one for one in MAKERS if one.joints and (not one.position or one.position in names)]
    general = (Maker("", f"{name}#") for name in JOINT_NAMES)
    best: dict[str, int] = {}
    shift = 0
    for maker in (*makers, *general):
        numbers = {name: number for name in names if (number := joint_of(name, maker.joints)) is not None}
        beside = [joint_of(proposal.headings[one.index].name, maker.joints) for one in stated]
        others = [
            int(one.target.quantity[1:]) if number is None else number
            for one, number in zip(stated, beside, strict=True)
        ]
        counted = sorted([*numbers.values(), *others])
        consecutive = counted in (list(range(1, len(counted) + 1)), list(range(len(counted))))
        if consecutive and numbers and len(counted) > max(1, len(best)):
            best, proposal.maker = numbers, maker if maker.name else None
            shift = 1 - counted[0]
    reason = f"name of {proposal.maker.name}" if proposal.maker else "heading"
    reason += ", counted from 0" if shift else ""
    group = {name: f"q{number + shift}" for name, number in best.items()}
    proposal.put_group(group, names, "commanded", reason)


def _take_position(proposal: Proposal) -> None:
    """The coordinates that were measured; a position that was only commanded is none."""
    for group in POSITIONS:
        names = proposal.names("length")
        decided = {
            proposal.headings[index].name: column.target.quantity
            for index, column in proposal.columns.items()
            if column.target.quantity in POSITION
        }
        wanted = {name: one for name, one in zip(group, POSITION, strict=True) if decided.get(name) != one}
        there = {name: names[name] for name in wanted if name in names}
        if not there or len(there) < len(wanted) or len(wanted) + len(decided) > len(POSITION):
            continue
        if {proposal.headings[index].side for indices in there.values() for index in indices} == {
            "commanded"
        }:
            proposal.leave_out(there, names, "commanded, not measured")
        else:
            proposal.put_group(wanted, names, "measured", "heading")


def _take_rotation(proposal: Proposal, rotation: str | None) -> None:
    """The rotation by the names of its values, by the maker of the joints, or as stated."""
    columns = {name for one in ROTATIONS.values() for name in (*one.columns, *one.quantities())}
    names = {
        name: indices
        for name, indices in proposal.names("angle").items()
        if any(proposal.headings[index].side != "commanded" for index in indices)
    }
    matches = {} if columns & proposal.quantities else encodings_of(set(names))
    if rotation == NO_ROTATION:
        for group in matches.values():
            proposal.leave_out(group, names, "no rotation is wanted")
        return
    chosen = rotation or (proposal.maker.rotation if proposal.maker else "")
    if rotation is None and chosen not in matches and len(matches) == 1:
        chosen = next(iter(matches))
        makers = [one for one in MAKERS if not one.joints and one.rotation == chosen]
        proposal.maker = proposal.maker or next(iter(makers), None)
    if chosen in matches:
        encoding = ROTATIONS[chosen]
        quantities = encoding.columns or encoding.quantities()
        group = dict(zip(matches[chosen], quantities, strict=True))
        proposal.put_group(group, names, "measured", f"{chosen}: {encoding.meaning}")
    elif rotation is None:
        proposal.rotations = tuple(matches)


def _take_other(proposal: Proposal, name: str, index: int) -> None:
    """A column that is neither joint, position nor rotation."""
    unit = proposal.headings[index].unit
    of_unit = {"temperature": "temperature", "time": "time"}.get(UNITS[unit].kind if unit else "")
    quantity = of_unit or MEANINGS.get(name, LEFT_OUT)
    if quantity == LEFT_OUT:
        proposal.put(index, LEFT_OUT, UNRECOGNISED)
    elif quantity in proposal.quantities:
        proposal.put(index, LEFT_OUT, "there is another such column")
    else:
        proposal.put(index, quantity, "heading")
