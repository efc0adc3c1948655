"""Dates of measurements: ISO 8601, from 1970 to today."""

import datetime
import re

from pisigma.files.errors import MeasurementError, Place

EXPECTED_DATE = "a day from 1970-01-01 to today, such as 2026-11-22"
"""Description of valid dates, for messages."""

_FIRST = datetime.date(1970, 1, 1)
"""Earliest date; joint values were not logged before then, so an earlier year is a typing error."""
_TIME_ZONES = datetime.timedelta(days=1)
"""Number of days that a date may be in the future: it may already be tomorrow in the instrument's time zone."""
_IN_NAME = re.compile(r"(?<!\d)(\d{4})([-_.]?)(\d{2})[-_.]?(\d{2})(?!\d)")
_WRITTEN = re.compile(r"(?:19|20)\d\d")
"""Pattern of a date in a file name: digits followed by a separator that can only be a year."""


def is_date(text: str, days_ahead: int = 0) -> bool:
    """Return whether a text is a possible date of a measurement, such as "2026-11-22".

    Args:
        text: date in the form of ISO 8601.
        days_ahead: number of days that the date may be in the future.
    """
    latest = datetime.date.today() + _TIME_ZONES + datetime.timedelta(days=days_ahead)
    day = _day(text)
    return day is not None and _FIRST <= day <= latest


def date_in_name(name: str) -> str:
    """Return the date in the name of a file; "" if there is none.

    Raises:
        MeasurementError: the date is before 1970, in the future, or does not exist, such as 2026-02-30.
    """
    match = _IN_NAME.search(name)
    if match is None:
        return ""
    text, is_written = f"{match[1]}-{match[3]}-{match[4]}", bool(match[2] and _WRITTEN.match(match[1]))
    if _day(text) is None and not is_written:
        return ""
    if not is_date(text):
        raise MeasurementError(
            expected=f"{EXPECTED_DATE}, in the name of the file",
            value=text,
            at=Place(name),
            remedy="rename the file, or state the date",
        )
    return text


def _day(text: str) -> datetime.date | None:
    try:
        day = datetime.date.fromisoformat(text)
    except ValueError:
        return None
    return day if day.isoformat() == text else None
