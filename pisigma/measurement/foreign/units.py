"""Units of exports: how they are spelt, and how values get from them into those of measurement files."""

import decimal
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from pisigma.files.errors import MeasurementError, nearest_choice

UnitKind = Literal["length", "angle", "time", "mass", "temperature"]
_FEWEST = 3
"""Rows from which on values that are all small tell their unit."""
_LONGEST_PLAIN = 40
"""Digits that a scaled number is written out with; longer ones keep their exponent."""


@dataclass(frozen=True)
class ForeignUnit:
    """A unit of exports.

    Attributes:
        kind: what is measured in it.
        column: the unit of measurement files that its values are written in.
        factor: exact number of those in one of these.
        spellings: of it besides its symbol, in small letters.
    """

    kind: UnitKind
    column: str
    factor: str = "1"
    spellings: str = ""


UNITS: dict[str, ForeignUnit] = {
    "mm": ForeignUnit("length", "mm", "1", "millimeter millimeters millimetre millimetres"),
    "m": ForeignUnit("length", "mm", "1e3", "meter meters metre metres"),
    "cm": ForeignUnit("length", "mm", "1e1", "centimeter centimeters centimetre centimetres"),
    "um": ForeignUnit("length", "mm", "1e-3", "µm μm micron microns micrometer micrometers"),
    "in": ForeignUnit("length", "mm", "25.4", 'inch inches "'),
    "ft": ForeignUnit("length", "mm", "304.8", "foot feet"),
    "deg": ForeignUnit("angle", "deg", "1", "° degree degrees deg."),
    "rad": ForeignUnit("angle", "rad", "1", "radian radians"),
    "mrad": ForeignUnit("angle", "rad", "1e-3", "milliradian milliradians"),
    "gon": ForeignUnit("angle", "deg", "0.9", "gons gradian gradians grads ᵍ"),
    "s": ForeignUnit("time", "s", "1", "sec second seconds"),
    "ms": ForeignUnit("time", "s", "1e-3", "msec millisecond milliseconds"),
    "kg": ForeignUnit("mass", "kg", "1", "kilogram kilograms"),
    "g": ForeignUnit("mass", "kg", "1e-3", "gram grams"),
    "c": ForeignUnit("temperature", "c", "1", "°c degc celsius"),
}
"""By symbol; a unit more is one line."""

AMBIGUOUS = {
    "grad": "degrees in German, gradians in other languages",
    "grade": "degrees in Italian, gradians in French",
}
"""Spellings that are units of several meanings, and which; `--unit` or `--map` has to say which one is meant."""
_LONGEST_COMMENT = 500
"""Characters of a comment that are looked at."""

_SYMBOLS = {name: symbol for symbol, unit in UNITS.items() for name in (symbol, *unit.spellings.split())}
_SAID = re.compile(
    r"(?i)\b(?:units?|einheit(?:en)?|lengths?|längen?|angles?|winkel|distances?|joints?|gelenke?|coordinates?|positions?|"
    r"values)\b(.*)"
)
_BETWEEN = frozenset(("", "in", "and", "und", "are", "is"))
"""Words between such a word and its unit; an inch has to be spelt out in a comment."""


def unit_symbol(text: str) -> str:
    """Give the symbol of a unit, however it is spelt; "" where it is none."""
    return _SYMBOLS.get(text.strip().strip("[]()<>{}").strip().lower(), "")


def ambiguous_unit(text: str) -> str:
    """Give the spelling of a unit with several meanings, see `AMBIGUOUS`; "" where it is none."""
    bare = text.strip().strip("[]()<>{}").strip().lower()
    return bare if bare in AMBIGUOUS else ""


def stated_units(comments: Sequence[str]) -> dict[UnitKind, str]:
    """Give the units that comments and titles state, such as "units mm, deg" or "angles: degrees".

    The units follow their word; of several for one kind the first counts. A unit of several meanings stays as it is
    spelt, see `AMBIGUOUS`.
    """
    stated: dict[UnitKind, str] = {}
    for comment in comments:
        rest = comment[:_LONGEST_COMMENT]
        while said := _SAID.search(rest):
            rest = said[1]
            for word in re.split(r"[\s,;:=/()\[\]]+", rest):
                if word.lower() in _BETWEEN:
                    continue
                if symbol := unit_symbol(word):
                    stated.setdefault(UNITS[symbol].kind, symbol)
                elif spelling := ambiguous_unit(word):
                    stated.setdefault("angle", spelling)
                else:
                    break
    return stated


def parse_units(text: str) -> dict[UnitKind, str]:
    """Read units such as "mm,deg": by what they measure, their symbols.

    Raises:
        MeasurementError: a unit is unknown, or two are for the same.
    """
    units: dict[UnitKind, str] = {}
    for word in filter(None, re.split(r"[\s,;]+", text)):
        symbol = unit_symbol(word)
        if not symbol:
            raise MeasurementError(f"--unit {text}: '{word}' is unknown; {nearest_choice(word, UNITS)}")
        if units.setdefault(UNITS[symbol].kind, symbol) != symbol:
            raise MeasurementError(
                f"--unit {text}: states two units of {UNITS[symbol].kind}; state one of each kind."
            )
    return units


def scaled(number: str, symbol: str) -> str:
    """Give a number in the unit of its column of measurement files, with every digit.

    Args:
        number: with a decimal point, or what stands in its cell and is no number.
        symbol: of its unit; "" where it has none.
    """
    factor = UNITS[symbol].factor if symbol else "1"
    if factor == "1":
        return number
    try:
        with decimal.localcontext(prec=2 * _LONGEST_PLAIN):
            value = decimal.Decimal(number) * decimal.Decimal(factor)
    except decimal.DecimalException:
        return number
    is_plain = value.is_finite() and abs(value.adjusted()) <= _LONGEST_PLAIN
    return "0" if not value else f"{value:f}" if is_plain else str(value)


def doubt(symbol: str, largest: float, rows: int) -> str:
    """Say why values can hardly be in their unit; "" where nothing speaks against it.

    A joint turns at most two or three times, nothing is measured from beyond 200 m, and a measured robot moves by
    more than three degrees and 20 mm.

    Args:
        symbol: of the unit.
        largest: absolute value among all joint values, or among all coordinates.
        rows: number of rows.
    """
    few = rows < _FEWEST
    doubts = {
        "rad": (largest > 4 * math.pi, "degrees"),
        "deg": (not few and 0 < largest <= math.pi, "radians"),
        "m": (largest > 200, "millimetres"),
        "in": (largest > 4000, "millimetres"),
        "mm": (not few and 0 < largest < 20, "metres"),
    }
    doubted, other = doubts.get(symbol, (False, ""))
    if symbol == "deg" and largest > 1000:
        doubted, other = True, "lengths"
    return f"values up to {largest:.6g} {symbol}, which look like {other}" if doubted else ""


def is_certain(symbol: str, largest: float) -> bool:
    """Say whether values can only be in a unit and not in the other one of its kind that is in use; see `doubt`."""
    bounds = {"deg": largest > 4 * math.pi, "rad": 0.2 < largest <= 2 * math.pi + 0.1}
    return bounds.get(symbol, {"mm": largest > 200, "m": 0.05 < largest < 20}.get(symbol, False))
