"""Numbers as instruments write them: decimal points or commas, grouped thousands; carried digit by digit."""

import functools
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, get_args

Decimal = Literal[".", ","]
MISSING = frozenset(("", "-", "--", "---", "*", "n/a", "na", "nan", "null", "none", "nil", "n.a.", "missing"))
"""What stands in the cell of a value that was not measured, in small letters."""
_BLANKS = " \u00a0\u2009\u202f'\u2019"
"""What sets groups of thousands apart besides points and commas."""
_PLAIN = {sign: re.compile(rf"[-+]?[0-9]+(?:\{sign}[0-9]+)?") for sign in get_args(Decimal)}
"""Numbers of the usual form, which are nearly all."""


@dataclass(frozen=True)
class NumberFormat:
    """How the numbers of a file are written.

    Attributes:
        decimal: the sign before the decimals; the other one may set thousands apart.
    """

    decimal: Decimal

    def text(self, cell: str) -> str | None:
        """Write a number with a decimal point and without groups, with every digit of the cell; None if it is none."""
        if _PLAIN[self.decimal].fullmatch(cell):
            return cell if self.decimal == "." else cell.replace(",", ".")
        cell = cell.strip().replace("\u2212", "-")
        match = _pattern(self.decimal).fullmatch(cell)
        if match is None:
            return None
        whole = re.sub(rf"[.,{_BLANKS}]", "", match["whole"] or "")
        decimals, exponent = (match["decimals"] or "").replace(",", "."), (match["exponent"] or "").upper()
        return f"{match['sign']}{whole}{decimals}{exponent.replace('D', 'E')}"

    def certainty(self, cell: str) -> float:
        """Say how surely a cell is a number of this format: 0 where it is none, less than 1 where it could be another.

        A group of thousands without decimals, such as 1,234, may as well be a number with three decimals.
        """
        text = self.text(cell)
        if text is None:
            return 0.0
        other = "," if self.decimal == "." else "."
        return 0.5 if cell.count(other) == 1 and self.decimal not in cell else 1.0

    def is_ambiguous(self, cells: Iterable[str]) -> bool:
        """Say whether the sign before decimals may set thousands apart in every cell that has it, such as 1,234."""
        sign = re.escape(self.decimal)
        signed = [cell for cell in cells if self.decimal in cell]
        return bool(signed) and all(
            re.fullmatch(rf"[-+]?[1-9]\d{{0,2}}{sign}\d{{3}}", cell) for cell in signed
        )


@functools.cache
def _pattern(decimal: Decimal) -> re.Pattern[str]:
    other = "," if decimal == "." else "."
    groups = rf"\d{{1,3}}(?P<group>[{other}{_BLANKS}])\d{{3}}(?:(?P=group)\d{{3}})*"
    return re.compile(
        rf"(?P<sign>[-+]?)(?=\d|\{decimal}\d)(?P<whole>{groups}|\d*)(?P<decimals>\{decimal}\d*)?"
        r"(?P<exponent>[eEdD][-+]?\d+)?",
        re.ASCII,
    )


def is_missing(cell: str) -> bool:
    """Say whether a cell states that nothing was measured."""
    return cell.strip().lower() in MISSING
