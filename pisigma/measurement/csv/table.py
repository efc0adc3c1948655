"""A CSV file as text: a header and the fields of every row, each with its line and with what is wrong with it."""

import csv
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from pisigma.files.errors import MeasurementError, printable
from pisigma.files.input_file import read_text

SPREADSHEET_ERRORS = frozenset(
    ("#N/A", "#NV", "#REF!", "#VALUE!", "#DIV/0!", "#NAME?", "#NUM!", "#NULL!", "#SPILL!", "#CALC!")
)
"""What spreadsheets write into cells that they cannot calculate."""


@dataclass(frozen=True, eq=False)
class Table:
    """The fields of a CSV file, before their meaning is looked at.

    Attributes:
        source: the file, as complaints call it.
        header: names of the columns, without surrounding blanks.
        header_line: where the header stands.
        records: the fields of every row; empty where the row is no valid CSV.
        lines: where the rows stand.
        broken: for rows that are no valid CSV, what is wrong with them, by row.
    """

    source: str
    header: tuple[str, ...]
    header_line: int
    records: list[list[str]]
    lines: tuple[int, ...]
    broken: dict[int, str]


def read_table(path: str | os.PathLike[str]) -> Table:
    """Read a CSV file: commas between fields, UTF-8 with or without byte order mark.

    Blank lines and lines that begin with # are skipped. A field may stand in double quotes, but no field
    goes on in the next line.

    Raises:
        MeasurementError: the file cannot be read, is too large, not UTF-8, empty, or holds nothing but a header.
    """
    table = table_of(read_text(path, MeasurementError, "CSV"), printable(str(path), cut=False))
    if not table.records:
        raise MeasurementError(
            f"{table.source}, line {table.header_line}: the file ends after its header; add one row per measurement."
        )
    return table


def table_of(text: str, source: str) -> Table:
    """Split the text of a CSV file into a header and any number of rows.

    Raises:
        MeasurementError: there is no header, or it is no valid CSV.
    """
    lines = content_lines(text.replace("\r\n", "\n").replace("\r", "\n").split("\n"), source)
    header_line, line = next(lines)
    header = header_names(line, f"{source}, line {header_line}")
    content = list(lines)
    split = [split_line(line) for _, line in content]
    return Table(
        source=source,
        header=header,
        header_line=header_line,
        records=[fields for fields, _ in split],
        lines=tuple(number for number, _ in content),
        broken={row: problem for row, (_, problem) in enumerate(split) if problem},
    )


def content_lines(lines: Iterable[str], source: str) -> Iterator[tuple[int, str]]:
    """The lines that are neither blank nor begin with #, the header first, each with its number.

    A line with as many fields as the header whose first one is an error of a spreadsheet is a row.

    Raises:
        MeasurementError: there is none.
    """
    columns = 0
    for number, line in enumerate(lines, start=1):
        if (start := line.lstrip()) and (not start.startswith("#") or _is_failed_row(start, columns)):
            columns = columns or len(split_line(line)[0])
            yield number, line
    if not columns:
        raise MeasurementError(f"{source}: the file is empty; a header and at least one row were wanted.")


def _is_failed_row(line: str, columns: int) -> bool:
    """Whether a line that begins with # is a row whose first cell a spreadsheet could not calculate."""
    fields = split_line(line)[0]
    return len(fields) == columns and fields[0].strip() in SPREADSHEET_ERRORS


def header_names(line: str, place: str) -> tuple[str, ...]:
    """The names of the columns, without surrounding blanks.

    Raises:
        MeasurementError: the line is no valid CSV.
    """
    names, problem = split_line(line)
    if problem:
        raise MeasurementError(f"{place}: the header is no valid CSV ({problem}); check its quotes.")
    return tuple(name.strip() for name in names)


def split_line(line: str) -> tuple[list[str], str]:
    """The fields of a line, and what is wrong with its quotes ("" where nothing is)."""
    if '"' not in line:
        return line.split(","), ""
    try:
        return next(csv.reader([line], strict=True, skipinitialspace=True)), ""
    except csv.Error as problem:
        return [], str(problem)


class Faults:
    """What is wrong with which row; the first fault of a row stays.

    Attributes:
        reasons: column at fault, what stands there and what to do, by row.
    """

    def __init__(self, broken: dict[int, str]):
        self.reasons = {
            row: f"all columns: no valid CSV ({what}); check the quotes" for row, what in broken.items()
        }

    def add(self, faults: Iterable[tuple[int, str]]) -> None:
        """Note rows at fault, and what is wrong with each."""
        for row, what in faults:
            self.reasons.setdefault(row, what)

    def sound(self, rows: int) -> Bool[np.ndarray, " rows"]:
        """The rows without a fault so far, of so many."""
        sound = np.ones(rows, dtype=bool)
        sound[list(self.reasons)] = False
        return sound
