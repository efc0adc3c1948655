"""How the lines of an export are divided into cells, and how its numbers are written."""

import contextlib
import csv
import itertools
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import get_args

from pisigma.errors import MeasurementError
from pisigma.measurement.csv.table import SPREADSHEET_ERRORS
from pisigma.measurement.foreign.number_format import Decimal, NumberFormat, is_missing

SEPARATORS = ("\t", ";", ",", "|", " ")
"""A blank stands for any number of blanks and tabs."""
SAMPLE = 300
"""Lines that are looked at."""
MOST_COLUMNS = 2000
_BLANKS = 0.8
"""Blanks stand in names, too: they separate cells only where no other separator explains nearly as much."""
COMMENT = re.compile(r"\s*(?://|#|%|!|\*\*|--|;|'|REM\b)\s*")
"""What begins lines that are no rows; a line of cells may begin so, too."""


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


def sniff(lines: Sequence[str], source: str, decimal: Decimal | None = None) -> Dialect:
    """Find the separator and the decimal sign by which most cells of most lines are numbers.

    Of readings that explain equally much the first wins, in the order of `SEPARATORS` and with points.

    Args:
        lines: of the file, without blank ones.
        source: the file, as complaints call it.
        decimal: the decimal sign where it is stated.

    Raises:
        MeasurementError: no reading gives a table of numbers, or its commas may be either sign.
    """
    sample = [*lines[: SAMPLE // 2], *lines[SAMPLE // 2 :][-SAMPLE // 2 :]]
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
    rows = filter(dialect.is_row, map(dialect.split, sample))
    if decimal is None and dialect.separator == dialect.numbers.decimal == ",":
        cells = [cell for row in rows for cell in row if dialect.is_number(cell)]
        if dialect.numbers.is_ambiguous(cells):
            example = next(cell for cell in cells if "," in cell)
            raise MeasurementError(
                f"{source}: the comma of '{example}', which also separates the cells, may set thousands apart or "
                "decimals; state --decimal point or --decimal comma."
            )
    return dialect


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
