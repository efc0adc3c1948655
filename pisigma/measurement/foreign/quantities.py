"""Targets of columns in exports: columns of measurement files, values of rotations, names and times."""

import functools
from collections.abc import Iterable
from dataclasses import dataclass

from pisigma.files.errors import MeasurementError, choice_remedy
from pisigma.measurement.csv.columns import RPY, find_column, number_fields
from pisigma.measurement.foreign.rotations import ROTATIONS
from pisigma.measurement.foreign.units import UNITS, UnitKind

LEFT_OUT = "-"
"""Target of a column that a mapping omits; in front of a target it reverses the sign: "-q4_deg"."""
_ALTHOUGH = "!"
"""Mark after a target in a mapping: the column is in this unit although its heading states another ("x_in!")."""
KEYS = ("point", "time")
"""Quantities by which rows of two files are joined; they are not in measurement files."""

_NOT_MEASURED = frozenset(
    (
        "sigma_position",
        "sigma_rotation",
        "payload",
        "temperature",
        "target",
        "frame",
        "set",
        "touch_axis",
        "pair",
    )
)
"""Quantities that are not measurements by themselves."""

_KINDS: dict[str, UnitKind] = {
    "mm": "length",
    "m": "length",
    "deg": "angle",
    "rad": "angle",
    "kg": "mass",
    "c": "temperature",
}


@dataclass(frozen=True)
class ColumnTarget:
    """The target of a column in a mapping.

    Attributes:
        quantity: quantity such as "q1", "x", "kuka_a" or "point"; `LEFT_OUT` if the column is left out.
        unit: symbol of the unit of the cells; "" if there is no unit or it is unknown.
        is_reversed: whether the cells have the opposite sign.
        overrides_unit: whether the unit applies although the file states another.
    """

    quantity: str
    unit: str = ""
    is_reversed: bool = False
    overrides_unit: bool = False

    @property
    def text(self) -> str:
        """Text of the target for `--map`."""
        named = measurement_column(self.quantity, self.unit)
        named = named or "_".join(filter(None, (self.quantity, self.unit)))
        return f"{LEFT_OUT * self.is_reversed}{named}{_ALTHOUGH * self.overrides_unit}"

    @property
    def missing_unit_kind(self) -> UnitKind | None:
        """Kind of the missing unit; None if no unit is missing."""
        return None if self.unit else unit_kind(self.quantity)


@dataclass(frozen=True)
class MappedColumn:
    """A column of an export and its target.

    Attributes:
        index: index of the column in its file, from 0.
        heading: heading of the column, or its number from 1.
        target: quantity and unit of the column.
        reason: reason for the target, in a few words.
        is_stated: whether the caller stated the target.
    """

    index: int
    heading: str
    target: ColumnTarget
    reason: str = ""
    is_stated: bool = False


def joints_of(quantities: Iterable[str]) -> list[str]:
    """Return the quantities that are joint values, in the order of the joints."""
    return sorted(filter(is_joint, quantities), key=lambda name: int(name[1:]))


def fits_unit(quantity: str, unit: str) -> bool:
    """Return whether a quantity can be in a unit; "" fits all quantities, and joints can be angles or lengths."""
    kinds = {unit_kind(quantity)} | ({"length"} if is_joint(quantity) else set())
    return not unit or UNITS[unit].kind in kinds


def is_measured(name: str) -> bool:
    """Return whether a measurement-file column contains measurements, not names, conditions or deviations."""
    column = find_column(name)
    return column is not None and not (
        column.joint or column.joint_field[1] or column.quantity in _NOT_MEASURED
    )


def unit_kind(quantity: str) -> UnitKind | None:
    """Return the kind of unit of a quantity; None if it has no unit. Joints without a unit are revolute."""
    if is_joint(quantity):
        return "angle"
    return _quantities().get(quantity)


def measurement_column(quantity: str, unit: str) -> str:
    """Return the column of measurement files for a quantity in a unit; "" if there is no such column."""
    names = (f"{quantity}_{unit}" if unit else quantity, f"{quantity.partition('_')[0]}_{unit}")
    return next((name for name in names if (column := find_column(name)) and column.quantity == quantity), "")


def parse_target(text: str, heading: str) -> ColumnTarget:
    """Parse the target of a column in a mapping, such as "q1_deg", "-q1_deg", "x_in", "x_in!", "point", or "-".

    Args:
        text: the target.
        heading: heading or number of the column, for messages.

    Raises:
        MeasurementError: there is no such column or unit.
    """
    if text in ("", LEFT_OUT):
        return ColumnTarget(LEFT_OUT)
    name, is_reversed = text.removeprefix(LEFT_OUT).removesuffix(_ALTHOUGH), text.startswith(LEFT_OUT)
    column = find_column(name)
    known = () if column is None else ((column.quantity, "", column.unit),)
    for quantity, _, unit in (*known, (name, "", ""), name.rpartition("_")):
        is_quantity = bool(known) or quantity in _quantities() or is_joint(quantity)
        has_sign = unit_kind(quantity) in ("angle", "length") or not is_reversed
        if is_quantity and has_sign and (not unit or unit in UNITS) and fits_unit(quantity, unit):
            return ColumnTarget(quantity, unit, is_reversed, text.endswith(_ALTHOUGH))
    choices = {"q1_deg", "x_mm", "y_mm", "z_mm", "time_s", LEFT_OUT, *_quantities()}
    raise MeasurementError(
        f"unknown target '{text}' of the column '{heading}'",
        option="--map",
        value=text,
        remedy=choice_remedy(text, choices),
    )


def is_joint(quantity: str) -> bool:
    """Return whether a quantity is the value of a joint."""
    column = find_column(f"{quantity}_deg")
    return column is not None and column.joint > 0


@functools.cache
def _quantities() -> dict[str, UnitKind | None]:
    """Return the kinds of unit of all quantities except joints, by name."""
    kinds: dict[str, UnitKind | None] = {"point": None, "time": "time"}
    for field in number_fields():
        kinds |= {column.quantity: _KINDS.get(column.unit) for column in field.columns}
    kinds |= dict.fromkeys(RPY, "angle")
    for encoding in ROTATIONS.values():
        kinds |= dict.fromkeys(encoding.quantities(), "angle" if encoding.is_angles else None)
    return kinds
