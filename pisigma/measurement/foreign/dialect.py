"""Formats of exports: separators of cells, and format of numbers."""

import contextlib
import csv
import functools
import itertools
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

from pisigma.files.errors import MeasurementError, Phrase, Place
from pisigma.measurement.csv.table import SPREADSHEET_ERRORS

_SEPARATORS = ("\t", ";", ",", "|", " ")
"""Separators of cells; a space stands for any number of spaces and tabs."""
_SAMPLED_LINES = 300
"""Number of lines from which the format is recognised."""
_MAX_COLUMNS = 2000
_BLANKS = 0.8
"""Weight of spaces as separators; it is small, because names also contain spaces."""
_SMALL, _FAR = 20.0, 200.0
"""Limits below which numbers such as 2.104 may be lengths in mm with a group of thousands: no robot reaches 20,000
mm, and no measured position is 200,000 mm away."""
COMMENT = re.compile(r"\s*(?://|#|%|!|\*\*|--|;|'|REM\b)\s*")
"""Texts with which comments start; rows may also start with them."""
Decimal = Literal[".", ","]
_MISSING = frozenset(
    ("", "-", "--", "---", "*", "n/a", "na", "nan", "null", "none", "nil", "n.a.", "missing")
)
"""Texts of cells without a measured value, in lower case."""
_SPACES = " \u00a0\u2009\u202f'\u2019"
"""Separators of thousands other than points and commas."""
_PLAIN = {sign: re.compile(rf"[-+]?[0-9]+(?:\{sign}[0-9]+)?") for sign in get_args(Decimal)}
"""Pattern of numbers in the usual form, which are converted faster."""


@dataclass(frozen=True)
class NumberFormat:
    """Format of the numbers in a file.

    Attributes:
        decimal: the decimal sign; the other sign may separate thousands.
    """

    decimal: Decimal

    def to_plain_number(self, cell: str) -> str | None:
        """Return a number with a decimal point, all digits and no groups; None if the cell is not a number."""
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
        """Return 1 if a cell is a number of this format, less if it is ambiguous, and 0 if it is not a number.

        A group of thousands without decimals, such as 1,234, may also be a number with three decimals.
        """
        text = self.to_plain_number(cell)
        if text is None:
            return 0.0
        other = "," if self.decimal == "." else "."
        return 0.5 if cell.count(other) == 1 and self.decimal not in cell else 1.0

    def is_ambiguous(self, cells: Iterable[str]) -> bool:
        """Return whether the decimal sign may separate thousands in every cell that contains it, such as 1,234."""
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
    """Return whether the text of a cell states that nothing was measured."""
    return cell.strip().lower() in _MISSING


@dataclass(frozen=True)
class Dialect:
    """Format of an exported file.

    Attributes:
        separator: separator of cells, one of `_SEPARATORS`.
        number_format: format of numbers.
    """

    separator: str
    number_format: NumberFormat

    def __str__(self) -> str:
        """Return a description such as "semicolons between cells, decimal commas"."""
        signs = {".": "points", ",": "commas", "\t": "tabs", ";": "semicolons", "|": "bars", " ": "spaces"}
        return f"{signs[self.separator]} between cells, decimal {signs[self.number_format.decimal]}"

    def split(self, line: str) -> list[str]:
        """Return the cells of a line without surrounding spaces; an unclosed quote is part of the cell."""
        if '"' in line:
            with contextlib.suppress(csv.Error):
                reader = csv.reader(
                    [line.strip(" ")], delimiter=self.separator, strict=True, skipinitialspace=True
                )
                return [cell.strip() for cell in next(reader)]
        cells = line.split() if self.separator == " " else line.split(self.separator)
        return [cell.strip() for cell in cells]

    def is_row(self, cells: Sequence[str]) -> bool:
        """Return whether cells are a row: two or more numbers, or one number with markers of missing values."""
        if not 2 <= len(cells) <= _MAX_COLUMNS:
            return False
        if cells[0].startswith(("#", "%", ";", "!")):
            return cells[0] in SPREADSHEET_ERRORS
        numeric = sum(map(self.is_number, cells))
        return numeric >= 2 or (numeric == 1 and sum(map(is_missing, cells)) >= len(cells) - 2)

    def is_number(self, cell: str) -> bool:
        """Return whether a cell is a number."""
        return self.number_format.to_plain_number(cell) is not None


def detect_dialect(
    lines: Sequence[tuple[int, str]], source: str, decimal_sign: Decimal | None = None
) -> Dialect:
    """Find the separator and the decimal sign for which most cells of most lines are numbers.

    Of equally good formats, the first is returned, in the order of `_SEPARATORS` and with decimal points first.

    Args:
        lines: line numbers and texts of the lines of the file that are not blank.
        source: the file, for messages.
        decimal_sign: the decimal sign, if it is stated.

    Raises:
        MeasurementError: no format results in a table of numbers, or the decimal sign is ambiguous.
    """
    half = _SAMPLED_LINES // 2
    sampled = [*lines[:half], *lines[half:][-half:]]
    sample = [line for _, line in sampled]
    signs = (decimal_sign,) if decimal_sign else get_args(Decimal)
    choices = [
        Dialect(separator, NumberFormat(sign)) for separator, sign in itertools.product(_SEPARATORS, signs)
    ]
    scores = [_score(dialect, sample) for dialect in choices]
    best = max(scores)
    if best <= 0:
        raise MeasurementError(
            expected="a table of numbers with one measurement per line",
            value=Phrase("no lines with the same number of numbers"),
            at=Place(source),
            remedy="separate cells with tabs, semicolons, commas or spaces",
        )
    dialect = choices[scores.index(best)]
    if decimal_sign is None:
        rows = [(number, row) for number, line in sampled if dialect.is_row(row := dialect.split(line))]
        _check_decimal(dialect, rows, source)
    return dialect


def _check_decimal(dialect: Dialect, rows: Sequence[tuple[int, list[str]]], source: str) -> None:
    """Refuse a table whose numbers may have groups of thousands instead of decimals.

    A table is ambiguous if every number with the sign looks like 2.104, and either the sign also separates the
    cells, or a column also contains whole numbers, or all of these numbers are small and another column contains
    whole numbers. It is also ambiguous if a column contains such numbers together with whole numbers that all have
    three digits.

    Raises:
        MeasurementError: the numbers of the table are ambiguous.
    """
    sign, width = dialect.number_format.decimal, Counter(len(row) for _, row in rows).most_common(1)[0][0]
    columns = [
        [(number, row[k]) for number, row in rows if len(row) == width and dialect.is_number(row[k])]
        for k in range(width)
    ]
    signed = [[(number, cell) for number, cell in column if sign in cell] for column in columns]
    is_ambiguous = dialect.number_format.is_ambiguous
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
        f"'{cell}' is ambiguous: '{sign}' may be a decimal or a thousands separator",
        at=Place(source, number, k + 1),
        value=cell,
        remedy="use --set decimal=point or --set decimal=comma",
    )


def _has_hundreds(cells: Sequence[str]) -> bool:
    """Return whether some cells are whole numbers of three digits."""
    return any(re.fullmatch(r"[-+]?[1-9]\d\d", cell) for cell in cells)


def _counts(cells: Sequence[str]) -> bool:
    """Return whether the cells of a column are consecutive row numbers."""
    numbers = [int(cell) if cell.isdigit() and len(cell) < 9 else -1 for cell in cells]
    return all(after - before == 1 for before, after in itertools.pairwise(numbers))


def _score(dialect: Dialect, lines: Sequence[str]) -> float:
    """Return the share of lines that are rows of one width, times the share of unambiguous numbers in their cells."""
    rows = [dialect.split(line) for line in lines]
    numeric = [row for row in rows if dialect.is_row(row)]
    if not numeric:
        return 0.0
    width = Counter(map(len, numeric)).most_common(1)[0][0]
    cells = [cell for row in numeric if len(row) == width for cell in row if not is_missing(cell)]
    certain = sum(map(dialect.number_format.certainty, cells)) * (
        _BLANKS if dialect.separator == " " else 1.0
    )
    return len([row for row in numeric if len(row) == width]) / len(rows) * certain / len(cells)
