"""Days on which something was measured: as ISO 8601 writes them, from 1970 to today."""

import datetime
import re

from pisigma.files.errors import MeasurementError

WANTED = "a day from 1970-01-01 to today, such as 2026-11-22"
"""What is expected of a date, for messages."""

_FIRST = datetime.date(1970, 1, 1)
"""Before it nobody logged joint values: such a year is a slip."""
_CLOCKS_DIFFER = datetime.timedelta(days=1)
"""Where the instrument is, it may be tomorrow already."""
_IN_NAME = re.compile(r"(?<!\d)(\d{4})([-_.]?)(\d{2})[-_.]?(\d{2})(?!\d)")
_WRITTEN = re.compile(r"(?:19|20)\d\d")
"""A year that, with signs behind it, can only be meant as one."""


def is_date(text: str, days_ahead: int = 0) -> bool:
    """Whether a text is a day on which something can have been measured, such as "2026-11-22".

    Args:
        text: as ISO 8601 writes it.
        days_ahead: how far in the future it may be [days].
    """
    latest = datetime.date.today() + _CLOCKS_DIFFER + datetime.timedelta(days=days_ahead)
    day = _day(text)
    return day is not None and _FIRST <= day <= latest


def date_in_name(name: str) -> str:
    """The day in the name of a file; "" where no digits of it are a day.

    Raises:
        MeasurementError: it is a day before 1970 or in the future, or one that no calendar has, such as 2026-02-30.
    """
    match = _IN_NAME.search(name)
    if match is None:
        return ""
    text, is_written = f"{match[1]}-{match[3]}-{match[4]}", bool(match[2] and _WRITTEN.match(match[1]))
    if _day(text) is None and not is_written:
        return ""
    if not is_date(text):
        raise MeasurementError(
            f"{name}: expected {WANTED} in the name of the file, got {text}; rename the file, or state the date."
        )
    return text


def _day(text: str) -> datetime.date | None:
    try:
        day = datetime.date.fromisoformat(text)
    except ValueError:
        return None
    return day if day.isoformat() == text else None
