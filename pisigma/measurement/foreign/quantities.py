"""What columns of exports can be mapped to: columns of measurement files, values of rotations, names and times."""

import functools
from collections.abc import Iterable
from dataclasses import dataclass

from pisigma.files.errors import MeasurementError, nearest_choice
from pisigma.measurement.csv.columns import RPY, find_column, number_fields
from pisigma.measurement.foreign.rotations import ROTATIONS
from pisigma.measurement.foreign.units import UNITS, UnitKind

LEFT_OUT = "-"
"""In mappings, what a column is mapped to that is not wanted."""
KEYS = ("point", "time")
"""Quantities by which rows of two files are joined; no measurement file keeps them."""

_BESIDE = frozenset(
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
"""Quantities that are no measurement by themselves."""

_KINDS: dict[str, UnitKind] = {
    "mm": "length",
    "m": "length",
    "deg": "angle",
    "rad": "angle",
    "kg": "mass",
    "c": "temperature",
}


@dataclass(frozen=True)
class Target:
    """What a column is mapped to.

    Attributes:
        quantity: such as "q1", "x", "kuka_a" or "point"; `LEFT_OUT` where it is not wanted.
        unit: symbol of the unit of the cells; "" where it has none or is not known.
    """

    quantity: str
    unit: str = ""

    @property
    def text(self) -> str:
        """As `--map` takes it."""
        named = measurement_column(self.quantity, self.unit)
        return named or "_".join(filter(None, (self.quantity, self.unit)))

    @property
    def needs(self) -> UnitKind | None:
        """Kind of the unit that it needs and lacks; None where nothing is missing."""
        return None if self.unit else unit_kind(self.quantity)


@dataclass(frozen=True)
class MappedColumn:
    """A column of an export and what it is.

    Attributes:
        index: of the column in its file, from 0.
        heading: of the column, or its number from 1.
        target: what it is mapped to.
        reason: why, in a few words.
        is_stated: whether the caller said so.
    """

    index: int
    heading: str
    target: Target
    reason: str = ""
    is_stated: bool = False


def joints_of(quantities: Iterable[str]) -> list[str]:
    """Those of some quantities that are joint values, in the order of the joints."""
    return sorted(filter(is_joint, quantities), key=lambda name: int(name[1:]))


def fits(quantity: str, unit: str) -> bool:
    """Say whether values of a quantity can be in a unit; "" fits all. Joints turn or slide."""
    kinds = {unit_kind(quantity)} | ({"length"} if is_joint(quantity) else set())
    return not unit or UNITS[unit].kind in kinds


def is_measured(name: str) -> bool:
    """Say whether a column of measurement files holds a measurement, and not what is only stated beside one."""
    column = find_column(name)
    return column is not None and not (column.joint or column.approach or column.quantity in _BESIDE)


def unit_kind(quantity: str) -> UnitKind | None:
    """Give what the unit of a quantity measures; None where it has none. A joint without a unit turns."""
    if is_joint(quantity):
        return "angle"
    return _quantities().get(quantity)


def measurement_column(quantity: str, unit: str) -> str:
    """Name of the column of measurement files for a quantity in a unit of such files; "" where there is none."""
    names = (f"{quantity}_{unit}" if unit else quantity, f"{quantity.partition('_')[0]}_{unit}")
    return next((name for name in names if (column := find_column(name)) and column.quantity == quantity), "")


def parse_target(text: str, place: str) -> Target:
    """Read what a column is mapped to, such as "q1_deg", "x_in", "ur_rx_rad", "point", or "-".

    Raises:
        MeasurementError: there is no such column or unit; `place` says where it stands.
    """
    if text in ("", LEFT_OUT):
        return Target(LEFT_OUT)
    column = find_column(text)
    if column is not None:
        return Target(column.quantity, column.unit)
    for quantity, _, unit in ((text, "", ""), text.rpartition("_")):
        is_quantity = quantity in _quantities() or is_joint(quantity)
        if is_quantity and (not unit or unit in UNITS) and fits(quantity, unit):
            return Target(quantity, unit)
    choices = {"q1_deg", "x_mm", "y_mm", "z_mm", "time_s", LEFT_OUT, *_quantities()}
    raise MeasurementError(f"{place}: '{text}' is unknown; {nearest_choice(text, choices)}")


def is_joint(quantity: str) -> bool:
    """Whether a quantity is the value of a joint."""
    column = find_column(f"{quantity}_deg")
    return column is not None and column.joint > 0


@functools.cache
def _quantities() -> dict[str, UnitKind | None]:
    """All quantities but joints by name, with what their units measure."""
    kinds: dict[str, UnitKind | None] = {"point": None, "time": "time"}
    for field in number_fields():
        kinds |= {column.quantity: _KINDS.get(column.unit) for column in field.columns}
    kinds |= dict.fromkeys(RPY, "angle")
    for encoding in ROTATIONS.values():
        kinds |= dict.fromkeys(encoding.quantities(), "angle" if encoding.is_angles else None)
    return kinds
