"""What the columns of a measurement file mean: quantity and unit, from the name alone."""

import re
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from pisigma.errors import nearest_choice

POSITION = ("x", "y", "z")
RPY = ("roll", "pitch", "yaw")
QUATERNION = ("qx", "qy", "qz", "qw")
ANCHOR_PLACE = ("anchor_x", "anchor_y", "anchor_z")
TEXTS = ("target", "frame", "set", "socket", "touch_axis", "anchor", "pair")

REVOLUTE_UNITS = ("deg", "rad")
PRISMATIC_UNITS = ("mm", "m")

_PER_SI = {"deg": 180 / np.pi, "mm": 1e3}

_JOINT = re.compile(r"q([1-9][0-9]{0,2})_(deg|rad|mm|m)")
_APPROACH = re.compile(r"approach([1-9][0-9]{0,2})")


@dataclass(frozen=True)
class Column:
    """A column of a measurement file.

    Attributes:
        name: as in the header, such as "q1_deg".
        quantity: what stands in it, such as "q1"; no two columns of a file have the same.
        unit: "deg", "rad", "mm", "m", "kg", "c", or "" where there is none.
    """

    name: str
    quantity: str
    unit: str

    @property
    def is_number(self) -> bool:
        """Whether its cells hold numbers."""
        return self.quantity not in TEXTS

    @property
    def joint(self) -> int:
        """Number of the joint, from 1; 0 where it is no joint column."""
        match = _JOINT.fullmatch(self.name)
        return int(match[1]) if match else 0

    @property
    def approach(self) -> int:
        """Number of the joint whose direction of approach it holds, from 1; 0 where it holds none."""
        match = _APPROACH.fullmatch(self.name)
        return int(match[1]) if match else 0


_COLUMNS = {
    column.name: column
    for column in (
        *(Column(f"{name}_mm", name, "mm") for name in POSITION),
        *(Column(f"{name}_m", name, "m") for name in POSITION),
        *(Column(f"{name}_deg", name, "deg") for name in RPY),
        *(Column(name, name, "") for name in QUATERNION),
        *(
            Column(f"{name}_{unit}", name, unit)
            for name in ("touch", "distance", *ANCHOR_PLACE)
            for unit in PRISMATIC_UNITS
        ),
        *(Column(name, name, "") for name in TEXTS),
        Column("sigma_mm", "sigma_position", "mm"),
        Column("sigma_deg", "sigma_rotation", "deg"),
        Column("payload_kg", "payload", "kg"),
        Column("temperature_c", "temperature", "c"),
    )
}


def find_column(name: str) -> Column | None:
    """The column of a name, or None where there is no such column."""
    match = _JOINT.fullmatch(name)
    if match:
        return Column(name, f"q{match[1]}", match[2])
    return Column(name, name, "") if _APPROACH.fullmatch(name) else _COLUMNS.get(name)


def column_choices(name: str) -> str:
    """Say which columns there are and which is nearest to an unknown `name`.

    Joint columns are listed for one joint: the one that `name` seems to mean, else the first.
    """
    number = re.search(r"[1-9][0-9]?", name)
    joint = number[0] if number else "1"
    joints = (f"q{joint}_{unit}" for unit in (*REVOLUTE_UNITS, *PRISMATIC_UNITS))
    meant = name.lower()
    if re.fullmatch(r"q[1-9][0-9]?", meant):  # most joints turn
        meant += "_deg"
    return nearest_choice(meant, (*joints, *_COLUMNS, f"approach{joint}"))


def quoted(columns: Iterable[Column]) -> str:
    """Names of columns as complaints list them."""
    return ", ".join(f"'{column.name}'" for column in columns)


def to_si(values: Float64[np.ndarray, "*shape"], unit: str) -> Float64[np.ndarray, "*shape"]:
    """Values of a column in SI units (temperature stays in deg C)."""
    return values / _PER_SI.get(unit, 1.0)


def from_si(values: Float64[np.ndarray, "*shape"], unit: str) -> Float64[np.ndarray, "*shape"]:
    """Values in the unit of a column; inverse of `to_si`."""
    return values * _PER_SI.get(unit, 1.0)
