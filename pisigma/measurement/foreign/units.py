"""Units of exports, their spellings, and their conversion to the units of measurement files."""

import decimal
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from pisigma.files.errors import MeasurementError, choice_remedy

UnitKind = Literal["length", "angle", "time", "mass", "temperature"]
_MIN_ROWS = 3
"""Smallest number of rows in which small values raise doubts about their unit; fewer rows may all be close to 0."""
_MAX_DIGITS = 40
"""Largest number of digits of a converted number that is written without an exponent."""


@dataclass(frozen=True)
class ForeignUnit:
    """A unit of exports.

    Attributes:
        kind: the measured quantity.
        file_unit: unit of measurement files to which values are converted.
        factor: exact conversion factor to that unit.
        spellings: spellings in addition to the symbol, in lower case.
    """

    kind: UnitKind
    file_unit: str
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
"""Units of exports by symbol."""

AMBIGUOUS = {
    "grad": "degrees in German, gradians in other languages",
    "grade": "degrees in Italian, gradians in French",
}
"""Ambiguous spellings of units and their meanings; `--unit` or `--map` has to state the meaning."""
_MAX_COMMENT = 500
"""Largest number of characters of a comment that are searched for units."""

_SYMBOLS = {name: symbol for symbol, unit in UNITS.items() for name in (symbol, *unit.spellings.split())}
_STATEMENT = re.compile(
    r"(?i)\b(?:units?|einheit(?:en)?|lengths?|längen?|angles?|winkel|distances?|joints?|gelenke?|coordinates?|positions?|"
    r"values)\b(.*)"
)
_BETWEEN = frozenset(("", "in", "and", "und", "are", "is"))
"""Words that may occur between a word of `_STATEMENT` and its unit; comments must spell out inches."""


def unit_symbol(text: str) -> str:
    """Return the symbol of a unit in any spelling; "" if it is not a unit."""
    return _SYMBOLS.get(text.strip().strip("[]()<>{}").strip().lower(), "")


def ambiguous_unit(text: str) -> str:
    """Return the spelling of an ambiguous unit, see `AMBIGUOUS`; "" if the text is not an ambiguous unit."""
    bare = text.strip().strip("[]()<>{}").strip().lower()
    return bare if bare in AMBIGUOUS else ""


def stated_units(comments: Sequence[str]) -> dict[UnitKind, str]:
    """Return the units that comments and titles state, such as "units mm, deg" or "angles: degrees".

    A unit follows a word such as "units"; of several units of one kind the first is used. Ambiguous units keep their
    spelling, see `AMBIGUOUS`.
    """
    stated: dict[UnitKind, str] = {}
    for comment in comments:
        text = comment[:_MAX_COMMENT]
        while match := _STATEMENT.search(text):
            text = match[1]
            for word in re.split(r"[\s,;:=/()\[\]]+", text):
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
    """Parse units such as "mm,deg" and return their symbols by kind.

    Raises:
        MeasurementError: a unit is unknown, or two units are of the same kind.
    """
    units: dict[UnitKind, str] = {}
    for word in filter(None, re.split(r"[\s,;]+", text)):
        symbol = unit_symbol(word)
        if not symbol:
            raise MeasurementError(
                f"unknown unit '{word}'", option="--unit", value=word, remedy=choice_remedy(word, UNITS)
            )
        if units.setdefault(UNITS[symbol].kind, symbol) != symbol:
            raise MeasurementError(option="--unit", expected=f"one unit of {UNITS[symbol].kind}", value=text)
    return units


def to_file_unit(number: str, symbol: str) -> str:
    """Return the text of a number converted to the unit of measurement files, with all digits.

    Args:
        number: text of the number with a decimal point, or another text, which is returned unchanged.
        symbol: symbol of the number's unit; "" if it has no unit.
    """
    factor = UNITS[symbol].factor if symbol else "1"
    if factor == "1":
        return number
    try:
        with decimal.localcontext(prec=2 * _MAX_DIGITS):
            value = decimal.Decimal(number) * decimal.Decimal(factor)
    except decimal.DecimalException:
        return number
    is_plain = value.is_finite() and abs(value.adjusted()) <= _MAX_DIGITS
    return "0" if not value else f"{value:f}" if is_plain else str(value)


def reason_to_doubt(symbol: str, largest: float, rows: int) -> str:
    """Return the reason why values are unlikely to be in the stated unit; "" if they are plausible.

    Joints rotate by at most two or three turns, instruments measure at distances of up to 200 m, and a measured robot
    moves by more than three degrees and 20 mm.

    Args:
        symbol: symbol of the unit.
        largest: largest absolute value of all joint values, or of all coordinates.
        rows: number of rows.
    """
    few = rows < _MIN_ROWS
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


def is_unit_certain(symbol: str, largest: float) -> bool:
    """Return whether values cannot be in the other usual unit of the same kind (see `reason_to_doubt`)."""
    bounds = {"deg": largest > 4 * math.pi, "rad": 0.2 < largest <= 2 * math.pi + 0.1}
    return bounds.get(symbol, {"mm": largest > 200, "m": 0.05 < largest < 20}.get(symbol, False))
