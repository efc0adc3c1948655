"""Account for every row of the imported files: rows read = rows used + rows left out, which are listed."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

FileLine = tuple[str, int]
"""File and line of a row."""

_MAX_LIST = 200
"""Largest number of characters of a list of lines in a sentence; lists in JSON are complete."""


@dataclass(frozen=True)
class LeftOutRow:
    """A row of a file that was not imported.

    Attributes:
        file: the file of the row.
        line: line number of the row.
        reason: reason why it was left out, as a clause that follows "is left out: ".
        point: name of the measured point; "" if the row has no name.
    """

    file: str
    line: int
    reason: str
    point: str = ""

    def to_json(self) -> dict[str, object]:
        """Return file, line and reason as plain values for JSON."""
        return {"file": self.file, "line": self.line, "reason": self.reason}


@dataclass(frozen=True)
class FileAccount:
    """Numbers of rows of a file that were read, used and left out; the first is the sum of the other two.

    Attributes:
        file: the file.
        rows_read: number of rows of the file.
        rows_used: number of rows that were imported, or whose joint values were joined to an imported row.
        left_out: rows that were not used.
    """

    file: str
    rows_read: int
    rows_used: int
    left_out: tuple[LeftOutRow, ...]

    def to_json(self) -> dict[str, object]:
        """Return the numbers of rows as plain values for JSON."""
        return {
            "file": self.file,
            "rows_read": self.rows_read,
            "rows_used": self.rows_used,
            "rows_left_out": len(self.left_out),
        }


def count_rows(
    read_lines: Sequence[FileLine], used_lines: Sequence[FileLine], left_out: Sequence[LeftOutRow]
) -> tuple[FileAccount, ...]:
    """Count the rows of every file.

    Args:
        read_lines: file and line of all rows that were read, in order.
        used_lines: file and line of the rows that were imported or joined.
        left_out: the rows that were left out.
    """
    places = Counter(used_lines) + Counter((row.file, row.line) for row in left_out)
    assert places == Counter(read_lines), "a row was lost or counted twice"
    return tuple(
        FileAccount(
            file,
            count,
            sum(place[0] == file for place in used_lines),
            tuple(row for row in left_out if row.file == file),
        )
        for file, count in Counter(file for file, _ in read_lines).items()
    )


def left_out_sentences(left_out: Sequence[LeftOutRow]) -> tuple[str, ...]:
    """Return sentences that list the rows that were left out, one sentence for every file and reason."""
    by_reason: dict[tuple[str, str], list[LeftOutRow]] = {}
    for row in left_out:
        by_reason.setdefault((row.file, row.reason), []).append(row)
    return tuple(
        f"{file}: {len(rows)} {'row is' if len(rows) == 1 else 'rows are'} left out, "
        f"{'line' if len(rows) == 1 else 'lines'} {_lines(rows)}: {reason}."
        for (file, reason), rows in by_reason.items()
    )


def _lines(rows: Sequence[LeftOutRow]) -> str:
    """Return a text with line numbers and names of points, or ranges such as "3, 5-9"; long lists end with "..."."""
    if any(row.point for row in rows):
        texts = [f"{row.line} ({row.point})" if row.point else str(row.line) for row in rows]
    else:
        numbers = enumerate(sorted(row.line for row in rows))
        runs = [[line for _, line in run] for _, run in groupby(numbers, lambda one: one[1] - one[0])]
        texts = [str(run[0]) if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in runs]
    text = ", ".join(texts)
    return text if len(text) <= _MAX_LIST else text[:_MAX_LIST].rpartition(",")[0] + ", ..."
