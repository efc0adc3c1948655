"""Follow a measurement file while it grows, reading every complete row once."""

import os
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch

from pisigma.files.errors import MeasurementError, Place, make_printable
from pisigma.files.input_file import read_text
from pisigma.measurement.csv.header import read_header
from pisigma.measurement.csv.reading import read_usable_rows
from pisigma.measurement.csv.table import Table, table_of
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.fields import MeasuredFields, UnusableRow
from pisigma.robot import Robot

_DIGITS = 9
"""Number of decimals [SI] to which equal rows agree, because programs that save a file again round values."""


Reader = Callable[[Table, bool], MeasuredFields]
"""Function that converts rows of a table to measurements; its second argument is whether the file is complete."""


@dataclass(frozen=True, eq=False)
class FileGrowth:
    """Changes of a file since it was last read.

    Attributes:
        rows: new rows in the order of the file; None if there are none.
        left_out: new rows that cannot be used, with the reasons.
        notices: sentences about a file that was truncated or replaced.
        missing_part: what is missing: the file, its header, or the end of its last line; "" if nothing is missing.
    """

    rows: Measurements | None = None
    left_out: tuple[UnusableRow, ...] = ()
    notices: tuple[str, ...] = ()
    missing_part: str = ""

    @property
    def has_changes(self) -> bool:
        """Whether there are new rows, or the file was truncated or replaced."""
        return self.rows is not None or bool(self.left_out or self.notices)


class GrowingFile:
    """Reader of rows that are appended to a measurement file; see `Measurements.read_csv` for the columns.

    Every row is read once, after the end of its line has been written. If the file is truncated or replaced, rows that
    have been read remain valid, and equal rows of the new file are not read again.
    """

    def __init__(self, path: str | os.PathLike[str], robot: Robot, reader: Reader | None = None):
        """Follow a file.

        Args:
            path: the file, which need not exist yet.
            robot: the measured robot.
            reader: function that converts rows that are meaningful only together (corners of an image); None for
                measurement files.
        """
        self.path = Path(path)
        self._robot = robot
        self._reader: Reader = reader or (lambda table, final: read_usable_rows(table, robot))
        self._source = make_printable(str(path), cut=False)
        self._stamp: tuple[int, ...] = ()
        self._text = ""
        self._waiting = ""
        self._accepted: Counter[str] = Counter()
        self._refused: set[UnusableRow] = set()

    def read(self, is_complete: bool = False) -> FileGrowth:
        """Return the rows that were added to the file since the last call.

        Args:
            is_complete: whether the file is complete, so that the last line is read without a line end.

        Raises:
            MeasurementError: the file cannot be read, its header cannot be used, or the file is missing at the end
                (`is_complete`).
        """
        try:
            state = os.stat(self.path)
        except FileNotFoundError:
            if is_complete:
                raise MeasurementError(
                    "there is no such file", at=Place(self._source), remedy="check the path"
                ) from None
            return FileGrowth(missing_part=f"{self._source} does not exist yet.")
        stamp = (state.st_ino, state.st_size, state.st_mtime_ns, is_complete)
        if stamp == self._stamp:
            return FileGrowth(missing_part=self._waiting)
        text = read_text(self.path, MeasurementError, "CSV")
        complete = text if is_complete else text[: max(text.rfind("\n"), text.rfind("\r")) + 1]
        self._stamp, notices = stamp, self._changes(complete)
        self._text = complete
        self._waiting = "" if complete == text else "the last line is not complete yet."
        if not complete.strip() and not is_complete:
            self._waiting = f"{self._source} has no complete header yet."
            return FileGrowth(notices=notices, missing_part=self._waiting)
        table = table_of(complete, self._source)
        if not table.records:
            read_header(table, self._robot)
            return FileGrowth(notices=notices, missing_part=self._waiting)
        data = self._reader(table, is_complete)
        left_out = tuple(one for one in data.left_out if one not in self._refused)
        self._refused.update(left_out)
        new = self._new_rows(data)
        rows = Measurements.from_fields(data.select(torch.tensor(new))) if new else None
        return FileGrowth(rows, left_out, notices, self._waiting)

    def _changes(self, text: str) -> tuple[str, ...]:
        """Return a notice if the file does not continue the text that was read."""
        if text.startswith(self._text):
            return ()
        what = "truncated" if self._text.startswith(text) else "replaced"
        return (
            f"{self._source} was {what}. The {self._accepted.total()} rows that have been read are still used and "
            "are not read again; restart the session if they should no longer be used.",
        )

    def _new_rows(self, data: MeasuredFields) -> list[int]:
        """Return the indices of the rows that were not read before, and record them as read."""
        # if the file has more equal rows than were read, the excess rows are new
        in_file: Counter[str] = Counter()
        new = []
        for row in range(data.rows):
            key = _values(data, row)
            in_file[key] += 1
            if in_file[key] > self._accepted[key]:
                new.append(row)
        self._accepted |= in_file
        return new


def _values(data: MeasuredFields, row: int) -> str:
    """Return all values of a row as text, independent of empty columns."""
    numbers = {
        name: (values[row].round(decimals=_DIGITS) + 0.0).tolist()  # -0.0 becomes 0.0
        for name, values in sorted(data.numbers.items())
        if bool(values[row].isfinite().any())
    }
    return repr((numbers, sorted((name, texts[row]) for name, texts in data.texts.items() if texts[row])))
