"""An export as a table of texts: its comments, heading, units and rows."""

import os
import re
from collections import Counter
from dataclasses import dataclass

from pisigma.errors import MeasurementError, printable
from pisigma.files.input_file import MOST_BYTES, read_input
from pisigma.measurement.csv.table import SPREADSHEET_ERRORS
from pisigma.measurement.foreign.dialect import COMMENT, Dialect, sniff
from pisigma.measurement.foreign.headings import is_recognised
from pisigma.measurement.foreign.number_format import Decimal
from pisigma.measurement.foreign.text_encoding import decoded
from pisigma.measurement.foreign.units import unit_symbol

LONGEST_LINE = 100_000
"""Characters of a line; a thousand columns have fewer."""
_Lines = list[tuple[int, str]]


@dataclass(frozen=True, eq=False)
class ExportFile:
    """A file of an instrument or a controller, before its meaning is looked at.

    Attributes:
        source: the file, as complaints call it.
        headings: of the columns; their numbers from "1" on where the file has none.
        has_header: whether it has headings.
        units: symbols of the units of its unit row, "" for columns without.
        comments: titles and comments, as they stand there.
        records: the cells of every row, in the order of the file.
        lines: where the rows stand.
        dialect: how it is written.
        skipped: lines after the first row that are no rows.
    """

    source: str
    headings: tuple[str, ...]
    has_header: bool
    units: tuple[str, ...]
    comments: tuple[str, ...]
    records: list[list[str]]
    lines: tuple[int, ...]
    dialect: Dialect
    skipped: tuple[int, ...]

    def column(self, index: int) -> list[str]:
        """The cells of a column."""
        return [record[index] for record in self.records]

    def numbers(self, index: int) -> list[float]:
        """The numbers of a column in its file's unit, without the cells that hold none."""
        texts = (self.dialect.numbers.text(cell) for cell in self.column(index))
        return [float(text) for text in texts if text is not None]


def read_export(
    path: str | os.PathLike[str], decimal: Decimal | None = None, most: int = MOST_BYTES
) -> ExportFile:
    """Read an export: encoding, separator and decimal sign are recognised, headings, unit row and comments told apart.

    Args:
        path: the file.
        decimal: the decimal sign, where it is stated.
        most: bytes that the file may have.

    Raises:
        MeasurementError: the file cannot be read, is no text, holds no table of numbers, or a row has another number
            of cells than the others; the message names the line.
    """
    source = printable(str(path), cut=False)
    lines = _lines_of(decoded(read_input(path, MeasurementError, most), source), source)
    dialect = sniff([line for _, line in lines], source, decimal)
    cells = [dialect.split(line) for _, line in lines]
    width = Counter(len(row) for row in cells if dialect.is_row(row)).most_common(1)[0][0]
    is_row = [len(row) == width and dialect.is_row(row) for row in cells]
    first = is_row.index(True)
    ends_empty = not any(row[-1] for row, sure in zip(cells, is_row, strict=True) if sure)
    headings, units, comments = _read_top(lines[:first], dialect, width - ends_empty, source)
    rows, skipped = [], []
    for i in range(first, len(lines)):
        if is_row[i] or (len(cells[i]) == width and _is_content(lines[i][1], cells[i], headings)):
            rows.append(i)
        elif any(cells[i]) and cells[i][: len(headings)] != headings:
            if not _is_comment(lines[i][1], cells[i]):
                _check_skipped(cells[i], dialect, width, f"{source}, line {lines[i][0]}")
            skipped.append(i)
    used = [
        k for k in range(width - ends_empty) if (headings and headings[k]) or any(cells[i][k] for i in rows)
    ]
    return ExportFile(
        source=source,
        headings=tuple(headings[k] if headings and headings[k] else str(k + 1) for k in used),
        has_header=bool(headings),
        units=tuple(units[k] if units else "" for k in used),
        comments=(*comments, *(lines[i][1] for i in skipped)),
        records=[[cells[i][k] for k in used] for i in rows],
        lines=tuple(lines[i][0] for i in rows),
        dialect=dialect,
        skipped=tuple(lines[i][0] for i in skipped),
    )


def _lines_of(text: str, source: str) -> _Lines:
    """The lines that are not blank, each with its number."""
    lines = [(number, line) for number, line in enumerate(text.split("\n"), start=1) if line.strip()]
    for number, line in lines:
        if len(line) > LONGEST_LINE:
            raise MeasurementError(
                f"{source}, line {number}: has {len(line):,} characters; one line per measurement was wanted."
            )
    return lines


def _is_content(line: str, row: list[str], headings: list[str]) -> bool:
    """Whether cells without numbers are a row nevertheless, whose reader will say what is wrong with it."""
    return any(row) and row[: len(headings)] != headings and not _is_comment(line, row)


def _is_comment(line: str, row: list[str]) -> bool:
    return bool(COMMENT.match(line)) and row[0] not in SPREADSHEET_ERRORS


def _check_skipped(row: list[str], dialect: Dialect, width: int, place: str) -> None:
    """Refuse a row of another width, which would be lost.

    Raises:
        MeasurementError: see above.
    """
    if sum(map(dialect.is_number, row)) < 2:
        return
    raise MeasurementError(
        f"{place}: {len(row)} cells, but the other rows have {width}; complete or remove the row, or state --decimal "
        "where decimal commas were taken for separators."
    )


def _read_top(
    lines: _Lines, dialect: Dialect, width: int, source: str
) -> tuple[list[str], list[str], list[str]]:
    """What stands before the first row: headings, the unit row (each [] where there is none), and comments."""
    headings: list[str] = []
    units: list[str] = []
    comments: list[str] = []
    for number, line in reversed(lines):
        cells = _heading_cells(line, dialect, width)
        symbols = [unit_symbol(cell) for cell in cells]
        others = [cell for cell, symbol in zip(cells, symbols, strict=True) if cell and not symbol]
        count = sum(map(bool, symbols))
        is_units = count >= (max(2, len(others)) if others else 1) and not any(map(is_recognised, others))
        if headings or not any(cells) or set(line) <= set("-=+|_ \t"):
            comments.append(line)
        elif len(cells) == width and is_units and not units:
            units = symbols
        elif len(cells) == width and (not COMMENT.match(line) or _recognised(cells) >= 0.5):
            headings = cells
        elif len(cells) > 2 and _recognised(cells) >= 0.5:
            commas = dialect.separator == "," and len(cells) < width
            raise MeasurementError(
                f"{source}, line {number}: {len(cells)} headings stand over rows of {width} cells; "
                + (
                    "export decimal points, or semicolons between cells."
                    if commas
                    else "give every column one heading."
                )
            )
        else:
            comments.append(line)
    return headings, units, comments[::-1]


def _heading_cells(line: str, dialect: Dialect, width: int) -> list[str]:
    """The cells of a heading, which may begin as a comment, end with a separator or have blanks before its units."""
    bare = COMMENT.sub("", line, count=1) if COMMENT.match(line) else line
    for text in (line, bare, re.sub(r"(?<!\s)\s+(?=[\[(])", "", bare)):
        cells = dialect.split(text)
        if len(cells) == width + 1 and not cells[-1]:
            cells = cells[:-1]
        if len(cells) == width:
            return [cell.lstrip("#%").strip() for cell in cells]
    return dialect.split(bare)


def _recognised(cells: list[str]) -> float:
    """Share of the cells that are names which instruments use."""
    return sum(map(is_recognised, cells)) / len(cells)
