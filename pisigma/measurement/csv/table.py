"""CSV files as text: header and fields of every row, with lines and faults."""

import csv
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from pisigma.files.errors import MeasurementError, Place, make_printable
from pisigma.files.input_file import read_text
from pisigma.measurement.faults import Fault

SPREADSHEET_ERRORS = frozenset(
    ("#N/A", "#NV", "#REF!", "#VALUE!", "#DIV/0!", "#NAME?", "#NUM!", "#NULL!", "#SPILL!", "#CALC!")
)
"""Texts that spreadsheets write into cells that they cannot calculate."""


@dataclass(frozen=True, eq=False)
class Table:
    """The fields of a CSV file, uninterpreted.

    Attributes:
        source: name of the file in messages.
        header: names of the columns, without surrounding spaces.
        header_line: line number of the header.
        records: the fields of every row; empty for rows that are not valid CSV.
        lines: line numbers of the rows.
        invalid_rows: faults of the rows that are not valid CSV, by row.
    """

    source: str
    header: tuple[str, ...]
    header_line: int
    records: list[list[str]]
    lines: tuple[int, ...]
    invalid_rows: dict[int, str]

    @property
    def header_place(self) -> Place:
        """Place of the header, for messages."""
        return Place(self.source, self.header_line)

    def place_of(self, row: int, column: str | int | None = None) -> Place:
        """Return the place of a row and a column, for messages."""
        return Place(self.source, self.lines[row], column)


def read_table(path: str | os.PathLike[str]) -> Table:
    """Read a CSV file: commas between fields, UTF-8 with or without byte order mark.

    Blank lines and lines that start with # are skipped. A field may be in double quotes, but must not contain a line
    break.

    Raises:
        MeasurementError: the file cannot be read, is too large, not UTF-8 or empty, or contains only a header.
    """
    table = table_of(read_text(path, MeasurementError, "CSV"), make_printable(str(path), cut=False))
    if not table.records:
        raise MeasurementError(
            "the file ends after its header", at=table.header_place, remedy="add one row per measurement"
        )
    return table


def table_of(text: str, source: str) -> Table:
    """Split the text of a CSV file into a header and any number of rows.

    Raises:
        MeasurementError: there is no header, or it is not valid CSV.
    """
    lines = content_lines(text.replace("\r\n", "\n").replace("\r", "\n").split("\n"), source)
    header_line, line = next(lines)
    header = header_names(line, Place(source, header_line))
    content = list(lines)
    split = [split_line(line) for _, line in content]
    return Table(
        source=source,
        header=header,
        header_line=header_line,
        records=[fields for fields, _ in split],
        lines=tuple(number for number, _ in content),
        invalid_rows={row: problem for row, (_, problem) in enumerate(split) if problem},
    )


def content_lines(lines: Iterable[str], source: str) -> Iterator[tuple[int, str]]:
    """Yield the lines that are neither blank nor comments (#) with their numbers, the header first.

    A line with as many fields as the header whose first field is an error of a spreadsheet (#N/A) is a row.

    Raises:
        MeasurementError: there is no such line, not even a header.
    """
    columns = 0
    for number, line in enumerate(lines, start=1):
        if (start := line.lstrip()) and (not start.startswith("#") or _is_failed_row(start, columns)):
            columns = columns or len(split_line(line)[0])
            yield number, line
    if not columns:
        raise MeasurementError(
            "the file is empty", at=Place(source), remedy="write a header and at least one row"
        )


def _is_failed_row(line: str, columns: int) -> bool:
    """Return whether a line that starts with # is a row whose first cell a spreadsheet could not calculate."""
    fields = split_line(line)[0]
    return len(fields) == columns and fields[0].strip() in SPREADSHEET_ERRORS


def header_names(line: str, place: Place) -> tuple[str, ...]:
    """Return the names of the columns, without surrounding spaces.

    Raises:
        MeasurementError: the line is not valid CSV.
    """
    names, problem = split_line(line)
    if problem:
        raise MeasurementError(
            f"the header is not valid CSV: {problem}", at=place, value=line, remedy="check its quotes"
        )
    return tuple(name.strip() for name in names)


def split_line(line: str) -> tuple[list[str], str]:
    """Return the fields of a line, and the fault of its quotes ("" if there is none)."""
    if '"' not in line:
        return line.split(","), ""
    try:
        return next(csv.reader([line], strict=True, skipinitialspace=True)), ""
    except csv.Error as problem:
        return [], str(problem)


class Faults:
    """Faults of rows; only the first fault of every row is kept.

    Attributes:
        by_row: faults by number of the row.
    """

    def __init__(self, broken: dict[int, str]):
        self.by_row = {
            row: Fault(f"the row is not valid CSV: {what}", remedy="check the quotes")
            for row, what in broken.items()
        }

    def add(self, faults: Iterable[tuple[int, Fault]]) -> None:
        """Add faults of rows that do not have a fault yet."""
        for row, fault in faults:
            self.by_row.setdefault(row, fault)

    def rows_without_faults(self, rows: int) -> Bool[np.ndarray, " rows"]:
        """Return the mask, of length `rows`, of the rows that have no fault."""
        sound = np.ones(rows, dtype=bool)
        sound[list(self.by_row)] = False
        return sound
