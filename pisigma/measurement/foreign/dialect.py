"""How the lines of an export are divided into cells, and how its numbers are written."""

import contextlib
import csv
import functools
import itertools
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

from pisigma.files.errors import MeasurementError
from pisigma.measurement.csv.table import SPREADSHEET_ERRORS

SEPARATORS = ("\t", ";", ",", "|", " ")
"""A blank stands for any number of blanks and tabs."""
SAMPLE = 300
"""Lines that are looked at."""
MOST_COLUMNS = 2000
_BLANKS = 0.8
"""Blanks stand in names, too: they separate cells only where no other separator explains nearly as much."""
_SMALL, _FAR = 20.0, 200.0
"""A number such as 2.104 that is below may be a length in mm with a group of thousands; 20,000 mm and more is none of a
robot, and 200,000 mm and more none of a position alone."""
COMMENT = re.compile(r"\s*(?://|#|%|!|\*\*|--|;|'|REM\b)\s*")
"""What begins lines that are no rows; a line of cells may begin so, too."""
Decimal = Literal[".", ","]
MISSING = frozenset(("", "-", "--", "---", "*", "n/a", "na", "nan", "null", "none", "nil", "n.a.", "missing"))
"""What stands in the cell of a value that was not measured, in small letters."""
_SPACES = " \u00a0\u2009\u202f'\u2019"
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
        whole = re.sub(rf"[.,{_SPACES}]", "", match["whole"] or "")
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
    groups = rf"\d{{1,3}}(?P<group>[{other}{_SPACES}])\d{{3}}(?:(?P=group)\d{{3}})*"
    return re.compile(
        rf"(?P<sign>[-+]?)(?=\d|\{decimal}\d)(?P<whole>{groups}|\d*)(?P<decimals>\{decimal}\d*)?"
        r"(?P<exponent>[eEdD][-+]?\d+)?",
        re.ASCII,
    )


def is_missing(cell: str) -> bool:
    """Say whether a cell states that nothing was measured."""
    return cell.strip().lower() in MISSING


@dataclass(frozen=True)
class Dialect:
    """How a file is written.

    Attributes:
        separator: between cells, one of `SEPARATORS`.
        numbers: how numbers are written.
    """

    separator: str
    numbers: NumberFormat

    def __str__(self) -> str:
        """In words, such as "semicolons between cells, decimal commas"."""
        signs = {".": "points", ",": "commas", "\t": "tabs", ";": "semicolons", "|": "bars", " ": "blanks"}
        return f"{signs[self.separator]} between cells, decimal {signs[self.numbers.decimal]}"

    def split(self, line: str) -> list[str]:
        """Give the cells of a line without surrounding blanks; a quote that is not closed belongs to its cell."""
        if '"' in line:
            with contextlib.suppress(csv.Error):
                reader = csv.reader(
                    [line.strip(" ")], delimiter=self.separator, strict=True, skipinitialspace=True
                )
                return [cell.strip() for cell in next(reader)]
        cells = line.split() if self.separator == " " else line.split(self.separator)
        return [cell.strip() for cell in cells]

    def is_row(self, cells: Sequence[str]) -> bool:
        """Say whether cells are a row: two numbers or more, or one and else what says that nothing was measured."""
        if not 2 <= len(cells) <= MOST_COLUMNS:
            return False
        if cells[0].startswith(("#", "%", ";", "!")):
            return cells[0] in SPREADSHEET_ERRORS
        numeric = sum(map(self.is_number, cells))
        return numeric >= 2 or (numeric == 1 and sum(map(is_missing, cells)) >= len(cells) - 2)

    def is_number(self, cell: str) -> bool:
        """Say whether a cell holds a number."""
        return self.numbers.text(cell) is not None


def sniff(lines: Sequence[tuple[int, str]], source: str, decimal: Decimal | None = None) -> Dialect:
    """Find the separator and the decimal sign by which most cells of most lines are numbers.

    Of readings that explain equally much the first wins, in the order of `SEPARATORS` and with points.

    Args:
        lines: of the file with their numbers, without blank ones.
        source: the file, as complaints call it.
        decimal: the decimal sign where it is stated.

    Raises:
        MeasurementError: no reading gives a table of numbers, or its points or commas may be either sign.
    """
    sampled = [*lines[: SAMPLE // 2], *lines[SAMPLE // 2 :][-SAMPLE // 2 :]]
    sample = [line for _, line in sampled]
    signs = (decimal,) if decimal else get_args(Decimal)
    choices = [
        Dialect(separator, NumberFormat(sign)) for separator, sign in itertools.product(SEPARATORS, signs)
    ]
    scores = [_score(dialect, sample) for dialect in choices]
    best = max(scores)
    if best <= 0:
        raise MeasurementError(
            f"{source}: no lines of equally many numbers were recognised; a table with one measurement per line was "
            "wanted, its cells separated by tabs, semicolons, commas or blanks."
        )
    dialect = choices[scores.index(best)]
    if decimal is None:
        rows = [(number, row) for number, line in sampled if dialect.is_row(row := dialect.split(line))]
        _check_decimal(dialect, rows, source)
    return dialect


def _check_decimal(dialect: Dialect, rows: Sequence[tuple[int, list[str]]], source: str) -> None:
    """Refuse a table whose numbers may have groups of thousands instead of decimals.

    That is where every number with the sign looks like 2.104, and either the sign separates the cells, too, or a column
    has whole numbers besides, or all of these numbers are small and another column holds whole numbers; and where a
    column holds such numbers and else whole ones of hundreds.

    Raises:
        MeasurementError: see above; the message names line and column.
    """
    sign, width = dialect.numbers.decimal, Counter(len(row) for _, row in rows).most_common(1)[0][0]
    columns = [
        [(number, row[k]) for number, row in rows if len(row) == width and dialect.is_number(row[k])]
        for k in range(width)
    ]
    signed = [[(number, cell) for number, cell in column if sign in cell] for column in columns]
    is_ambiguous = dialect.numbers.is_ambiguous
    if not is_ambiguous(cell for column in columns for _, cell in column):
        signed = [
            ours
            if is_ambiguous(cell for _, cell in column) and _has_hundreds([cell for _, cell in column])
            else []
            for ours, column in zip(signed, columns, strict=True)
        ]
        if not any(signed):
            return
    largest = max(float(cell.replace(sign, ".").strip("+-")) for column in signed for _, cell in column)
    is_mixed = [0 < len(ours) < len(column) for ours, column in zip(signed, columns, strict=True)]
    has_whole = any(
        column and not ours and not _counts([cell for _, cell in column])
        for ours, column in zip(signed, columns, strict=True)
    )
    bound = _FAR if sum(map(bool, signed)) <= 3 else _SMALL
    if dialect.separator != sign and not any(is_mixed) and (largest >= bound or not has_whole):
        return
    k = is_mixed.index(True) if any(is_mixed) else next(k for k, ours in enumerate(signed) if ours)
    number, cell = signed[k][0]
    raise MeasurementError(
        f"{source}, line {number}, column {k + 1}: '{cell}' may have decimals or a group of thousands; state --decimal "
        "point or --decimal comma."
    )


def _has_hundreds(cells: Sequence[str]) -> bool:
    """Whether cells are whole numbers of three digits, among others."""
    return any(re.fullmatch(r"[-+]?[1-9]\d\d", cell) for cell in cells)


def _counts(cells: Sequence[str]) -> bool:
    """Whether cells count the rows."""
    numbers = [int(cell) if cell.isdigit() and len(cell) < 9 else -1 for cell in cells]
    return all(after - before == 1 for before, after in itertools.pairwise(numbers))


def _score(dialect: Dialect, lines: Sequence[str]) -> float:
    """Share of the lines that are rows of one width, times the share of their cells that are surely numbers."""
    rows = [dialect.split(line) for line in lines]
    numeric = [row for row in rows if dialect.is_row(row)]
    if not numeric:
        return 0.0
    width = Counter(map(len, numeric)).most_common(1)[0][0]
    cells = [cell for row in numeric if len(row) == width for cell in row if not is_missing(cell)]
    certain = sum(map(dialect.numbers.certainty, cells)) * (_BLANKS if dialect.separator == " " else 1.0)
    return len([row for row in numeric if len(row) == width]) / len(rows) * certain / len(cells)
