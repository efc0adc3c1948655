"""A measurement file that grows while it is read: every complete row once, as soon as it stands there."""

import os
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch

from pisigma.files.errors import MeasurementError, printable
from pisigma.files.input_file import read_text
from pisigma.measurement.csv.header import read_header
from pisigma.measurement.csv.reading import sound_rows
from pisigma.measurement.csv.table import Table, table_of
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.fields import LeftOut, MeasuredFields
from pisigma.robot import Robot

_DIGITS = 9
"""Rows are the same where their values [SI] agree to so many decimals: programs that save a file anew round them."""


Reader = Callable[[Table, bool], MeasuredFields]
"""Turns rows of a table into measurements; the second argument says whether nothing comes any more."""


@dataclass(frozen=True, eq=False)
class Growth:
    """What came to a file since it was looked at last.

    Attributes:
        rows: new rows in the file's order; None where there are none.
        left_out: new rows that cannot be used, and why.
        notices: what happened to the file itself: it was truncated or replaced.
        waiting: what is waited for: the file, its header, or the end of its last line; "" for nothing.
    """

    rows: Measurements | None = None
    left_out: tuple[LeftOut, ...] = ()
    notices: tuple[str, ...] = ()
    waiting: str = ""

    @property
    def is_news(self) -> bool:
        """Whether anything came, or happened to the file."""
        return self.rows is not None or bool(self.left_out or self.notices)


class GrowingFile:
    """Reads the rows that come to a measurement file, each once; see `Measurements.read_csv` for what a file holds.

    A line counts when its end is there. Where the file is truncated or replaced, rows that were read stay read, and
    rows of the new file that equal one of them are not read again.
    """

    def __init__(self, path: str | os.PathLike[str], robot: Robot, reader: Reader | None = None):
        """Follow a file.

        Args:
            path: the file, which need not exist yet.
            robot: that is measured.
            reader: of rows that mean something only together; None for measurement files.
        """
        self.path = Path(path)
        self._robot = robot
        self._reader: Reader = reader or (lambda table, final: sound_rows(table, robot))
        self._source = printable(str(path), cut=False)
        self._stamp: tuple[int, ...] = ()
        self._text = ""
        self._waiting = ""
        self._accepted: Counter[str] = Counter()
        self._refused: set[LeftOut] = set()

    def read(self, final: bool = False) -> Growth:
        """Read what is new.

        Args:
            final: whether nothing comes any more, so that the last line counts without its end, too.

        Raises:
            MeasurementError: the file cannot be read or its header cannot be used; or, at the end, there is no file.
        """
        try:
            state = os.stat(self.path)
        except FileNotFoundError:
            if final:
                raise MeasurementError(f"{self._source}: there is no such file; check the path.") from None
            return Growth(waiting=f"{self._source} does not exist yet.")
        stamp = (state.st_ino, state.st_size, state.st_mtime_ns, final)
        if stamp == self._stamp:
            return Growth(waiting=self._waiting)
        text = read_text(self.path, MeasurementError, "CSV")
        complete = text if final else text[: max(text.rfind("\n"), text.rfind("\r")) + 1]
        self._stamp, notices = stamp, self._changes(complete)
        self._text = complete
        self._waiting = "" if complete == text else "the last line is not complete yet."
        if not complete.strip() and not final:
            self._waiting = f"{self._source} has no complete header yet."
            return Growth(notices=notices, waiting=self._waiting)
        table = table_of(complete, self._source)
        if not table.records:
            read_header(table, self._robot)
            return Growth(notices=notices, waiting=self._waiting)
        data = self._reader(table, final)
        left_out = tuple(one for one in data.left_out if one not in self._refused)
        self._refused.update(left_out)
        new = self._new_rows(data)
        rows = Measurements.from_fields(data.select(torch.tensor(new))) if new else None
        return Growth(rows, left_out, notices, self._waiting)

    def _changes(self, text: str) -> tuple[str, ...]:
        """Say what happened to the file where it does not go on as it was read."""
        if text.startswith(self._text):
            return ()
        what = "truncated" if self._text.startswith(text) else "replaced"
        return (
            f"{self._source} was {what}. The {self._accepted.total()} rows that were read so far still count, and none "
            "of them is read again; start anew if they are no longer to count.",
        )

    def _new_rows(self, data: MeasuredFields) -> list[int]:
        """Find the rows that were not read before; now they are."""
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
    """Everything that stands in a row, whichever columns the file has beside it."""
    numbers = {
        name: (values[row].round(decimals=_DIGITS) + 0.0).tolist()  # -0.0 becomes 0.0
        for name, values in sorted(data.numbers.items())
        if bool(values[row].isfinite().any())
    }
    return repr((numbers, sorted((name, texts[row]) for name, texts in data.texts.items() if texts[row])))
