"""Read an export in any text encoding as a table of texts, with comments, headings, units and rows."""

import codecs
import os
import re
from collections import Counter
from dataclasses import dataclass

from pisigma.files.errors import MeasurementError, Place, make_printable
from pisigma.files.input_file import MAX_BYTES, read_input
from pisigma.measurement.csv.table import SPREADSHEET_ERRORS
from pisigma.measurement.foreign.accounting import FileLine, LeftOutRow
from pisigma.measurement.foreign.dialect import COMMENT, Decimal, Dialect, detect_dialect
from pisigma.measurement.foreign.headings import is_recognised
from pisigma.measurement.foreign.summary_rows import summary_rows
from pisigma.measurement.foreign.units import ambiguous_unit, unit_symbol

MAX_LINE = 100_000
"""Largest number of characters of a line; a line of a thousand columns is shorter."""
_Lines = list[tuple[int, str]]
_MARKS = (
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF32_LE, "utf-32-le"),  # a text that starts with the byte order mark of UTF-16
    (codecs.BOM_UTF32_BE, "utf-32-be"),
    (codecs.BOM_UTF16_LE, "utf-16-le"),
    (codecs.BOM_UTF16_BE, "utf-16-be"),
)
_BINARY = {
    b"PK\x03\x04": ("a workbook or an archive", "save its sheet as CSV"),
    b"\xd0\xcf\x11\xe0": ("an old Excel workbook", "save its sheet as CSV"),
    b"%PDF": ("a PDF", "export the measurements as text"),
    b"\x1f\x8b": ("a compressed file", "unpack it"),
}
_CONTROLS = frozenset(map(chr, range(32))) - set("\t\n\r\x0b\x0c\x1a")
"""Control characters that texts do not contain; old exports end with the end-of-file mark 1A."""


@dataclass(frozen=True, eq=False)
class ExportFile:
    """Contents of a file of an instrument or a controller, without interpretation of the columns.

    Attributes:
        source: the file, for messages.
        headings: headings of the columns; their numbers from "1" if the file has no headings.
        has_header: whether the file has headings.
        header_line: line number of the headings, or of the first row if there are no headings.
        units: symbols in the unit row, "" for columns without a unit; ambiguous units keep their spelling.
        comments: titles and comments.
        records: cells of every row, in the order of the file.
        lines: line numbers of the rows.
        dialect: format of the file.
        skipped_lines: lines that are not used as rows: lines that contain numbers but are not rows, lines after the
            first row that are neither rows nor blank, and rows that summarise others.
    """

    source: str
    headings: tuple[str, ...]
    has_header: bool
    header_line: int
    units: tuple[str, ...]
    comments: tuple[str, ...]
    records: list[list[str]]
    lines: tuple[int, ...]
    dialect: Dialect
    skipped_lines: tuple[LeftOutRow, ...]

    @property
    def row_places(self) -> tuple[FileLine, ...]:
        """File and line of all rows, including skipped lines."""
        return (
            *((self.source, line) for line in self.lines),
            *((one.file, one.line) for one in self.skipped_lines),
        )

    def column(self, index: int) -> list[str]:
        """Return the cells of a column."""
        return [record[index] for record in self.records]

    def numbers(self, index: int) -> list[float]:
        """Return the numbers of a column in the file's unit; cells that are not numbers are omitted."""
        texts = (self.dialect.number_format.to_plain_number(cell) for cell in self.column(index))
        return [float(text) for text in texts if text is not None]


def read_export(
    path: str | os.PathLike[str], decimal_sign: Decimal | None = None, max_bytes: int = MAX_BYTES
) -> ExportFile:
    """Read an export, recognising encoding, separator, decimal sign, headings, unit row and comments.

    Args:
        path: the file.
        decimal_sign: the decimal sign, if it is stated.
        max_bytes: largest size of the file [bytes].

    Raises:
        MeasurementError: the file cannot be read, is not text, does not contain a table of numbers, or the number of
            cells of a row differs from that of the other rows.
    """
    source = make_printable(str(path), cut=False)
    lines = _lines_of(decode_text(read_input(path, MeasurementError, max_bytes), source), source)
    dialect = detect_dialect(lines, source, decimal_sign)
    cells = [dialect.split(line) for _, line in lines]
    width = Counter(len(row) for row in cells if dialect.is_row(row)).most_common(1)[0][0]
    is_row = [len(row) == width and dialect.is_row(row) for row in cells]
    ends_empty = not any(row[-1] for row, sure in zip(cells, is_row, strict=True) if sure)
    top = _read_top(lines[: is_row.index(True)], dialect, width - ends_empty, source)
    rows, skipped = [], list(top.skipped)
    for i in range(top.end, len(lines)):
        number, line = lines[i]
        if is_row[i] or (len(cells[i]) == width and _is_content(line, cells[i], top.headings)):
            rows.append(i)
        elif any(cells[i]) and cells[i][: len(top.headings)] != top.headings:
            if not _is_comment(line, cells[i]):
                _check_skipped(cells[i], dialect, width, Place(source, number))
            skipped.append(LeftOutRow(source, number, "the line is not a row of the table"))
    headings, units = top.headings, top.units
    used = [
        k for k in range(width - ends_empty) if (headings and headings[k]) or any(cells[i][k] for i in rows)
    ]
    summaries = summary_rows([[cells[i][k] for k in used] for i in rows], dialect.number_format)
    skipped += [LeftOutRow(source, lines[rows[row]][0], why) for row, why in sorted(summaries.items())]
    text_of = dict(lines)
    comments = [text_of[row.line] for row in skipped if row.line not in {lines[i][0] for i in rows}]
    rows = [i for row, i in enumerate(rows) if row not in summaries]
    return ExportFile(
        source=source,
        headings=tuple(headings[k] if headings and headings[k] else str(k + 1) for k in used),
        has_header=bool(headings),
        header_line=top.header_line or (lines[rows[0]][0] if rows else 1),
        units=tuple(units[k] if units else "" for k in used),
        comments=(*top.comments, *comments),
        records=[[cells[i][k] for k in used] for i in rows],
        lines=tuple(lines[i][0] for i in rows),
        dialect=dialect,
        skipped_lines=tuple(sorted(skipped, key=lambda row: row.line)),
    )


def _lines_of(text: str, source: str) -> _Lines:
    """Return the lines that are not blank, with their line numbers."""
    lines = [(number, line) for number, line in enumerate(text.split("\n"), start=1) if line.strip()]
    for number, line in lines:
        if len(line) > MAX_LINE:
            raise MeasurementError(
                expected=f"a line of up to {MAX_LINE:,} characters",
                value=len(line),
                at=Place(source, number),
                remedy="write one line per measurement",
            )
    return lines


def _is_content(line: str, row: list[str], headings: list[str]) -> bool:
    """Return whether cells without numbers are a row, which the reader of measurement files then refuses."""
    return any(row) and row[: len(headings)] != headings and not _is_comment(line, row)


def _is_comment(line: str, row: list[str]) -> bool:
    return bool(COMMENT.match(line)) and row[0] not in SPREADSHEET_ERRORS


def _check_skipped(row: list[str], dialect: Dialect, width: int, at: Place) -> None:
    """Refuse a row with a wrong number of cells, which would otherwise be lost.

    Raises:
        MeasurementError: the number of cells of the row differs from that of the other rows.
    """
    if sum(map(dialect.is_number, row)) < 2:
        return
    raise MeasurementError(
        expected=f"{width} cells as in the other rows",
        value=len(row),
        at=at,
        remedy="complete or remove the row, or use --set decimal=point if decimal commas were read as separators",
    )


@dataclass
class _Top:
    """The lines before the first row.

    Attributes:
        headings: headings of the columns, [] if there are none.
        header_line: line number of the headings, 0 if there are none.
        units: units in the unit row, see `ExportFile.units`; [] if there is no unit row.
        comments: titles and comments.
        skipped: lines with numbers that are neither headings nor rows.
        end: number of lines before the first row.
    """

    headings: list[str]
    header_line: int
    units: list[str]
    comments: list[str]
    skipped: list[LeftOutRow]
    end: int


def _read_top(lines: _Lines, dialect: Dialect, width: int, source: str) -> _Top:
    """Separate headings, unit row and comments in the lines before the first row.

    Raises:
        MeasurementError: the number of headings differs from the number of columns, or a line before the first row
            lacks a cell.
    """
    cells = [_heading_cells(line, dialect, width) for _, line in lines]
    is_units = [len(row) == width and _is_unit_row(row) for row in cells]
    heading = _heading_row(lines, cells, is_units, width)
    if heading is None:
        for (number, _), row in zip(lines, cells, strict=True):
            if len(row) > 2 and _recognised(row) >= 0.5:
                raise _wrong_headings(row, dialect, width, Place(source, number))
    units = next((i for i in reversed(range(len(lines))) if is_units[i]), None)
    table = max(
        -1 if i is None else i for i in (heading, units)
    )  # the last line that is certainly above the rows
    top = _Top(
        headings=[] if heading is None else cells[heading],
        header_line=0 if heading is None else lines[heading][0],
        units=[] if units is None else [unit_symbol(cell) or ambiguous_unit(cell) for cell in cells[units]],
        comments=[],
        skipped=[],
        end=len(lines),
    )
    is_certain = heading is not None and _recognised(top.headings) >= 0.5
    for i, (number, line) in enumerate(lines):
        numeric = sum(map(dialect.is_number, cells[i]))
        is_plain = any(cells[i]) and not set(line) <= set("-=+|_ \t") and not COMMENT.match(line)
        if i in (heading, units):
            continue
        if is_certain and i > table and is_plain:
            top.end = i  # lines below the headings are treated like lines between rows
            break
        if is_plain and numeric >= max(2, width // 2) and (heading is None or i > table):
            _check_skipped(cells[i], dialect, width, Place(source, number))
        if numeric >= 2:
            top.skipped.append(LeftOutRow(source, number, "the line is not a row of the table"))
        else:
            top.comments.append(line)
    return top


def _heading_row(lines: _Lines, cells: list[list[str]], is_units: list[bool], width: int) -> int | None:
    """Return the index of the headings: the line with one cell per column and the most recognised names."""
    possible = [
        (_recognised(row), i)
        for i, row in enumerate(cells)
        if len(row) == width
        and any(row)
        and not is_units[i]
        and not set(lines[i][1]) <= set("-=+|_ \t")
        and (not COMMENT.match(lines[i][1]) or _recognised(row) >= 0.5)
    ]
    return max(possible)[1] if possible else None


def _is_unit_row(cells: list[str]) -> bool:
    """Return whether the cells of a line are units, possibly with other texts that are not column names."""
    symbols = [unit_symbol(cell) or ambiguous_unit(cell) for cell in cells]
    others = [cell for cell, symbol in zip(cells, symbols, strict=True) if cell and not symbol]
    count = sum(map(bool, symbols))
    return count >= (max(2, len(others)) if others else 1) and not any(map(is_recognised, others))


def _wrong_headings(cells: list[str], dialect: Dialect, width: int, at: Place) -> MeasurementError:
    """Return the exception for a number of headings that differs from the number of columns."""
    commas = dialect.separator == "," and len(cells) < width
    action = (
        "export decimal points, or semicolons between cells" if commas else "give every column one heading"
    )
    return MeasurementError(
        expected=f"{width} headings as the rows have {width} cells", value=len(cells), at=at, remedy=action
    )


def _heading_cells(line: str, dialect: Dialect, width: int) -> list[str]:
    """Return the cells of a heading line, which may start like a comment, end with a separator or have spaced units."""
    bare = COMMENT.sub("", line, count=1) if COMMENT.match(line) else line
    for text in (line, bare, re.sub(r"(?<!\s)\s+(?=[\[(])", "", bare)):
        cells = dialect.split(text)
        if len(cells) == width + 1 and not cells[-1]:
            cells = cells[:-1]
        if len(cells) == width:
            return [cell.lstrip("#%").strip() for cell in cells]
    return dialect.split(bare)


def _recognised(cells: list[str]) -> float:
    """Return the share of cells that are recognised names."""
    return sum(map(is_recognised, cells)) / len(cells)


def decode_text(content: bytes, source: str) -> str:
    """Decode a text by its byte order mark, or else with the first of UTF-16, UTF-8 and Windows-1252 that fits.

    Args:
        content: content of the file.
        source: the file, for messages.

    Raises:
        MeasurementError: the content is not text.
    """
    for start, (what, remedy) in _BINARY.items():
        if content.startswith(start):
            raise MeasurementError(expected="text", value=what, at=Place(source), remedy=remedy)
    encoding, mark = next(((name, mark) for mark, name in _MARKS if content.startswith(mark)), ("", b""))
    for attempt in (encoding,) if encoding else (_utf16_without_mark(content), "utf-8", "cp1252"):
        try:
            text = content[len(mark) :].decode(attempt) if attempt else ""
        except UnicodeDecodeError:
            continue
        if attempt and not _CONTROLS & set(text):
            return text.rstrip("\x1a").replace("\r\n", "\n").replace("\r", "\n")
    raise MeasurementError(
        expected="text in UTF-8, UTF-16 or Windows-1252",
        at=Place(source),
        remedy="export the measurements as text",
    )


def _utf16_without_mark(content: bytes) -> str:
    """Return the encoding of UTF-16 without a mark, in which most characters have a zero byte; "" for other texts."""
    even, odd = content[0:4096:2].count(0), content[1:4096:2].count(0)
    most = 0.4 * min(len(content), 4096) / 2
    return "utf-16-le" if odd > most > even else "utf-16-be" if even > most > odd else ""
