"""What became of every row of the files of an import: rows read = rows used + rows named as left out."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

Place = tuple[str, int]
"""File and line of a row."""

_LONGEST_LIST = 200
"""Characters of a list of lines in a sentence; the lines of the JSON are complete."""


@dataclass(frozen=True)
class LeftOutRow:
    """A row of a file that was not imported.

    Attributes:
        file: that it is in.
        line: of the file.
        reason: why it was left out, as the second half of "is left out: ...".
        point: name of its point, "" where it has none.
    """

    file: str
    line: int
    reason: str
    point: str = ""

    def to_json(self) -> dict[str, object]:
        """Give file, line and reason as plain values."""
        return {"file": self.file, "line": self.line, "reason": self.reason}


@dataclass(frozen=True)
class FileAccount:
    """What became of the rows of a file; `read` is the sum of `used` and the rows that were left out.

    Attributes:
        file: that was read.
        read: number of its rows.
        used: number of those that were imported, or whose joint values were joined to an imported row.
        left_out: the others.
    """

    file: str
    read: int
    used: int
    left_out: tuple[LeftOutRow, ...]

    def to_json(self) -> dict[str, object]:
        """Give the numbers of rows as plain values."""
        return {
            "file": self.file,
            "rows_read": self.read,
            "rows_used": self.used,
            "rows_left_out": len(self.left_out),
        }


def account(
    read: Sequence[Place], used: Sequence[Place], left_out: Sequence[LeftOutRow]
) -> tuple[FileAccount, ...]:
    """Count the rows of every file.

    Args:
        read: places of all rows that were read, in their order.
        used: places of the rows that were imported or joined.
        left_out: the rows that were left out.
    """
    places = Counter(used) + Counter((row.file, row.line) for row in left_out)
    assert places == Counter(read), "a row was lost or counted twice"
    return tuple(
        FileAccount(
            file,
            count,
            sum(place[0] == file for place in used),
            tuple(row for row in left_out if row.file == file),
        )
        for file, count in Counter(file for file, _ in read).items()
    )


def sentences(left_out: Sequence[LeftOutRow]) -> tuple[str, ...]:
    """Name rows that were left out: one sentence for every file and reason."""
    by_reason: dict[tuple[str, str], list[LeftOutRow]] = {}
    for row in left_out:
        by_reason.setdefault((row.file, row.reason), []).append(row)
    return tuple(
        f"{file}: {len(rows)} {'row is' if len(rows) == 1 else 'rows are'} left out, "
        f"{'line' if len(rows) == 1 else 'lines'} {_lines(rows)}: {reason}."
        for (file, reason), rows in by_reason.items()
    )


def _lines(rows: Sequence[LeftOutRow]) -> str:
    """Lines with the names of points, or with ranges such as "3, 5-9"; a long list ends with "..."."""
    if any(row.point for row in rows):
        texts = [f"{row.line} ({row.point})" if row.point else str(row.line) for row in rows]
    else:
        numbers = enumerate(sorted(row.line for row in rows))
        runs = [[line for _, line in run] for _, run in groupby(numbers, lambda one: one[1] - one[0])]
        texts = [str(run[0]) if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in runs]
    text = ", ".join(texts)
    return text if len(text) <= _LONGEST_LIST else text[:_LONGEST_LIST].rpartition(",")[0] + ", ..."
