"""Time stamps of instruments and controllers."""

import itertools
import math
import re
from collections.abc import Sequence
from datetime import datetime, timezone

import numpy as np
from jaxtyping import Float64

from pisigma.files.errors import MeasurementError, Place

_DATE = re.compile(r"(\d{1,4})([./-])(\d{1,2})\2(\d{1,4})(?:$|[ T,]+(.*))")
_BASIC = re.compile(r"(\d{4})(\d\d)(\d\d)T(\d\d)(\d\d)(\d\d)")
"""Start of a time stamp without separators, such as 20260302T103102."""
_ZONED = re.compile(r"(.*?)(?:Z|([+-]\d\d(?::?\d\d)?))?")
"""Clock time and time zone, such as 10:31:02Z, 10:31:02+01:00 or 10:31:02+01."""
_CLOCK = re.compile(r"(\d{1,2}):(\d{2})(?::(\d{2}(?:[.,]\d+)?))?(?:\s*([AaPp])\.?[Mm]\.?)?")
_MIN_RISING = 5
"""Number of rows at which the first column rises by chance in one of 120 files."""
_MIN_ORDERED = 8
"""Number of rows at which one of ten columns rises or falls by chance in one of 2,000 files."""
_MANY, _MAX_REVERSED = 20, 0.1
"""Smallest number of rows at which some steps of a time may have the opposite sign, for example because a clock was
set, and the largest share of such steps."""
_MIN_CHANGES = 0.4
"""Smallest share of the rows in which a time changes; joints that are at rest in many rows change less often."""


def seconds_of(text: str, day_first: bool | None = None) -> float | None:
    """Return the time in seconds of a number, a clock time, or a date with clock time (UTC by default), or None.

    Args:
        text: time stamp such as "12.5", "10:31:02.5", "10:31:02 PM", "2026-03-02 10:31:02.5", "02.03.2026 10:31" or
            "02/03/2026 10:31".
        day_first: whether the day precedes the month in dates such as 02/03/2026; None if unknown: such a date is
            then accepted if only one order is possible.
    """
    text = text.strip()
    try:
        return number if math.isfinite(number := float(text)) else None
    except ValueError:
        pass
    if match := _CLOCK.fullmatch(text):
        return _clock(match)
    try:
        match = _DATE.fullmatch(_BASIC.sub(r"\1-\2-\3T\4:\5:\6", text))
        if match and (zoned := _ZONED.fullmatch(match[5] or "")):
            clock, day = _CLOCK.fullmatch(zoned[1].strip()), _day(match, day_first)
            seconds = _clock(clock) if clock else None
            if day is not None and seconds is not None:
                local = datetime.strptime((zoned[2] or "+00").ljust(5, "0"), "%z")
                return day.replace(tzinfo=local.tzinfo).timestamp() + seconds
        stamp = datetime.fromisoformat(text.replace("/", "-"))
    except ValueError:
        return None
    return stamp.replace(tzinfo=stamp.tzinfo or timezone.utc).timestamp()


def iso_day(text: str, day_first: bool | None = None) -> str | None:
    """Return the day of a date, with or without clock time, in the form of ISO 8601; None for other texts."""
    match = _DATE.fullmatch(text.strip())
    if match is None or (match[5] and not is_time_of_day(match[5])):
        return None
    day = _day(match, day_first)
    return None if day is None else day.date().isoformat()


def date_of(text: str) -> str:
    """Return the date in a time stamp as written; "" if it contains no date."""
    match = _DATE.match(text.strip())
    return text.strip()[: match.start(5) if match[5] is not None else None].strip(" T,") if match else ""


def is_time_of_day(text: str) -> bool:
    """Return whether a time stamp is a clock time without a date."""
    return bool(_CLOCK.fullmatch(text.strip()))


def day_first(texts: Sequence[str]) -> bool | None:
    """Return whether dates such as 13/03/2026 begin with the day; None if the dates do not determine it or disagree."""
    matches = [match for match in map(_DATE.match, map(str.strip, texts)) if match and _is_open(match)]
    is_day, is_month = (any(int(match[group]) > 12 for match in matches) for group in (1, 3))
    return is_day if is_day != is_month else None


def has_ambiguous_date(text: str) -> bool:
    """Return whether the date of a time stamp depends on the order of day and month."""
    match = _DATE.match(text.strip())
    return bool(match and _is_open(match) and match[1] != match[3])


def ambiguous_date_error(at: Place, text: str) -> MeasurementError:
    """Return the exception for a date that may begin with the day or with the month."""
    return MeasurementError(
        expected="a date with a known order of day and month",
        value=text,
        at=at,
        remedy="write dates as 2026-03-02 or 02.03.2026",
    )


def check_same_recording(
    times: Float64[np.ndarray, " rows"], max_time_difference: float, source: str, lines: Sequence[int]
) -> None:
    """Check that rows close in time belong to one recording, because the wrong recording might otherwise be joined.

    Args:
        times: time stamps in the order of the file [s].
        max_time_difference: largest difference of time stamps that are joined [s].
        source: the file.
        lines: lines of its rows.

    Raises:
        MeasurementError: time stamps restart, and the same times occur before and after the restart.
    """
    restarts = np.diff(times, prepend=times[:1]) < -max_time_difference
    order = np.argsort(times, kind="stable")
    close = np.diff(times[order]) <= max_time_difference
    if (close & (np.diff(np.cumsum(restarts)[order]) != 0)).any():
        row = int(restarts.argmax())
        raise MeasurementError(
            "time stamps restart, so that rows of several recordings have the same times",
            expected="time stamps of one clock",
            value=f"{times[row]:g} s after {times[row - 1]:g} s",
            at=Place(source, lines[row]),
            remedy="join one recording after the other, or join by point; the time stamps of LeRobot restart in every "
            "episode",
        )


def is_like_time(numbers: Sequence[float], is_first_column: bool) -> bool:
    """Return whether numbers rise or fall from row to row more often than by chance, apart from changes of the clock.

    Args:
        numbers: numbers of a column.
        is_first_column: whether it is the first column, of which `_MIN_RISING` numbers that all rise are sufficient.
    """
    steps = [after - before for before, after in itertools.pairwise(numbers)]
    up, down = (sum(sign * step > 0 for step in steps) for sign in (1, -1))
    few, most = sorted((up, down))
    if most < _MIN_CHANGES * len(steps) or len(numbers) < (_MIN_RISING if is_first_column else _MIN_ORDERED):
        return False
    if len(numbers) >= _MANY:
        return few <= _MAX_REVERSED * most
    return few == 0 and (len(numbers) >= _MIN_ORDERED or most == len(steps) == up)


def _is_open(match: re.Match[str]) -> bool:
    """Return whether a date has slashes or dashes and ends with the year; dates with points begin with the day."""
    return match[2] != "." and len(match[4]) == 4


def _day(match: re.Match[str], first: bool | None) -> datetime | None:
    """Return the time of midnight on a date [s]; None if the date is invalid or ambiguous."""
    one, two, last = int(match[1]), int(match[3]), int(match[4])
    if len(match[1]) == 4:
        year, month, day = one, two, last
    elif len(match[4]) == 2 and match[2] == ".":
        year, month, day = 2000 + last, two, one
    elif len(match[4]) != 4:
        return None
    elif match[2] == "." or first or (first is None and one > 12):
        year, month, day = last, two, one
    elif first is False or two > 12 or one == two:
        year, month, day = last, one, two
    else:
        return None
    try:
        return datetime(year, month, day, tzinfo=timezone.utc)
    except ValueError:
        return None


def _clock(match: re.Match[str]) -> float | None:
    """Return the seconds since midnight of a clock time; None if it is invalid."""
    hours, minutes, seconds = int(match[1]), int(match[2]), float((match[3] or "0").replace(",", "."))
    if half := match[4]:
        if not 1 <= hours <= 12:
            return None
        hours = hours % 12 + (12 if half in "pP" else 0)
    return hours * 3600 + minutes * 60 + seconds if hours < 24 and minutes < 60 and seconds < 61 else None
