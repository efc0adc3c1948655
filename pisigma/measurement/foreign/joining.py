"""Join a log of joint values and a list of measurements by name, order or time."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float64, Int64

from pisigma.files.errors import MeasurementError, Phrase, Place
from pisigma.measurement.foreign.accounting import FileLine, LeftOutRow
from pisigma.measurement.foreign.conversion import ConvertedRows
from pisigma.measurement.foreign.quantities import KEYS, is_measured, joints_of
from pisigma.measurement.foreign.time_stamps import (
    ambiguous_date_error,
    check_same_recording,
    date_of,
    day_first,
    has_ambiguous_date,
    is_time_of_day,
    seconds_of,
)

JoinBy = Literal["point", "order", "time"]
_MAX_MOTION = 0.05
"""Motion of a joint around a time stamp [deg or mm] above which the robot was not at rest."""


@dataclass(frozen=True, eq=False)
class JoinedRows:
    """Measurements joined with joint values.

    Attributes:
        rows: the measurements in the order of the list, with joint values.
        joined_lines: file and line of the rows of the log that were joined.
        unmatched_rows: rows of both files without a matching row.
        unneeded_rows: rows of the log that need no matching row, because another row has the same point or nothing was
            measured at their time.
        warnings: warnings, each a sentence.
    """

    rows: ConvertedRows
    joined_lines: tuple[FileLine, ...]
    unmatched_rows: tuple[LeftOutRow, ...]
    unneeded_rows: tuple[LeftOutRow, ...]
    warnings: tuple[str, ...]


def join_rows(
    measured: ConvertedRows, joints: ConvertedRows, by: JoinBy, max_time_difference: float = 0.2
) -> JoinedRows:
    """Join a list of measurements and a log of joint values.

    Rows of the list keep their order; rows without a matching row are left out and listed. Poses in the log are
    commanded or calculated, so they are left out.

    Args:
        measured: rows without joint values.
        joints: rows with joint values.
        by: "point": by names of points, ignoring groups before "::", case and leading zeros; "order": by position in
            the files; "time": with the row of the log that is nearest in time.
        max_time_difference: largest difference of time stamps [s].

    Raises:
        MeasurementError: there is no column to join by, the numbers of rows differ, a name has different joint
            values, no row has a matching row, or names of points contradict the order or the time.
    """
    if by == "order":
        partner = _by_order(measured, joints)
    elif by == "point":
        partner = _by_point(measured, joints)
    else:
        partner = _by_time(measured, joints, max_time_difference)
    matched = np.flatnonzero(partner >= 0)
    if not len(matched):
        raise _no_partner(measured, joints, by, max_time_difference)
    warnings = [] if by == "point" else _check_names(measured, joints, partner, by)
    commanded = [name for name in joints.cells if is_measured(name)]
    kept = [name for name in joints.cells if name not in (*commanded, *KEYS, *measured.cells)]
    cells = {name: tuple(joints.cells[name][row] for row in partner[matched]) for name in kept}
    cells |= {name: tuple(texts[row] for row in matched) for name, texts in measured.cells.items()}
    rows = ConvertedRows(
        measured.source,
        tuple(measured.lines[row] for row in matched),
        cells,
        tuple(measured.row_places[row][0] for row in matched),
    )
    if commanded:
        names = ", ".join(commanded)
        warnings.append(
            f"{joints.source}: {names} are left out, because the measurements are in {measured.source}."
        )
    if by == "time":
        warnings += _moving(joints, partner[matched], max_time_difference)
    alone = np.setdiff1d(np.arange(len(joints.lines)), partner)
    known = np.intersect1d(alone, _partners(joints, partner, by))
    same_point = "another row has the same point and joint values"
    why = "nothing was measured at its time" if by == "time" else same_point
    return JoinedRows(
        rows=rows,
        joined_lines=tuple(joints.row_places[row] for row in np.unique(partner[matched])),
        unmatched_rows=(
            *_left_out(measured, np.flatnonzero(partner < 0), f"the row has no match in {joints.source}"),
            *_left_out(joints, np.setdiff1d(alone, known), f"the row has no match in {measured.source}"),
        ),
        unneeded_rows=tuple(_left_out(joints, known, why)),
        warnings=tuple(warnings),
    )


def _left_out(rows: ConvertedRows, which: Int64[np.ndarray, " _which"], reason: str) -> list[LeftOutRow]:
    places = [(*rows.row_places[row], _point(rows, row)) for row in which.tolist()]
    return [LeftOutRow(file, line, reason, point) for file, line, point in places]


def append_rows(rows: Sequence[ConvertedRows]) -> ConvertedRows:
    """Concatenate the rows of several files; columns that a file does not have are empty in its rows."""
    if len(rows) == 1:
        return rows[0]
    names = list(dict.fromkeys(name for one in rows for name in one.cells))
    return ConvertedRows(
        source=" + ".join(one.source for one in rows),
        lines=tuple(line for one in rows for line in one.lines),
        cells={
            name: tuple(text for one in rows for text in one.cells.get(name, ("",) * len(one.lines)))
            for name in names
        },
        origins=tuple(place[0] for one in rows for place in one.row_places),
    )


def _check_names(
    measured: ConvertedRows, joints: ConvertedRows, partner: Int64[np.ndarray, " rows"], by: JoinBy
) -> list[str]:
    """Refuse joined rows whose points have different names in both files.

    If no name occurs in both files, the numbers at the ends of the names are compared, up to a constant offset.

    Returns:
        Warnings about names that cannot be compared.

    Raises:
        MeasurementError: the two files name a point differently.
    """
    if "point" not in measured.cells or "point" not in joints.cells:
        return []
    ours, theirs = ([_plain_name(text) for text in one.cells["point"]] for one in (measured, joints))
    if not set(ours) & set(theirs):
        ours, theirs = ([_number_of(name) for name in names] for names in (ours, theirs))
        is_clear = (
            len(set(ours)) == len(ours) and len(set(theirs)) == len(theirs) and "" not in (*ours, *theirs)
        )
        pairs = [(row, other) for row, other in enumerate(partner.tolist()) if other >= 0]
        offsets = {int(theirs[other]) - int(ours[row]) for row, other in pairs} if is_clear else set[int]()
        if not set(ours) & set(theirs) or (len(offsets) == 1 and offsets != {0}) or not is_clear:
            row = int(np.flatnonzero(partner >= 0)[0])
            return [
                f"{measured.source}, line {measured.lines[row]}: the point '{_point(measured, row)}' is joined with "
                f"'{_point(joints, int(partner[row]))}' ({joints.source}, line {joints.lines[partner[row]]}), and no "
                "name is the same in both files; check that their rows belong together."
            ]
    lines = dict(zip(theirs, joints.lines, strict=True))
    for row, other in enumerate(partner.tolist()):
        name = ours[row]
        if other >= 0 and name in lines and theirs[other] and theirs[other] != name:
            raise MeasurementError(
                f"joining by {by} pairs this point with '{_point(joints, other)}' (line {joints.lines[other]} of "
                f"{joints.source}), but that file has '{_point(measured, row)}' in line {lines[name]}",
                at=Place(measured.source, measured.lines[row]),
                value=_point(measured, row),
                remedy="join by point, or omit the column of the names with --map",
            )
    return []


def _by_order(measured: ConvertedRows, joints: ConvertedRows) -> Int64[np.ndarray, " rows"]:
    if len(measured.lines) != len(joints.lines):
        raise MeasurementError(
            expected=f"{len(measured.lines)} rows as in {measured.source}, to join by order",
            value=len(joints.lines),
            at=Place(joints.source),
            remedy="join by point or time, or complete the shorter file",
        )
    return np.arange(len(measured.lines))


def _by_point(measured: ConvertedRows, joints: ConvertedRows) -> Int64[np.ndarray, " rows"]:
    for one in (measured, joints):
        _check_key(one, "point", "names of the points")
    row_of: dict[str, int] = {}
    values = list(zip(*(joints.cells[name] for name in _joint_columns(joints)), strict=True))
    for row, name in enumerate(map(_plain_name, joints.cells["point"])):
        if values[row_of.setdefault(name, row)] != values[row] and name:
            first, text = joints.lines[row_of[name]], joints.cells["point"][row]
            raise MeasurementError(
                f"the point '{text}' has different joint values in line {first}",
                at=Place(joints.source, joints.lines[row]),
                value=text,
                remedy="give every pose a different name",
            )
    names = map(_plain_name, measured.cells["point"])
    return np.array([row_of.get(name, -1) if name else -1 for name in names], dtype=np.int64)


def _plain_name(text: str) -> str:
    """Return a name without the groups before it, in lower case and without leading zeros."""
    return re.sub(r"(?<![\d.])0+(?=\d)", "", text.rpartition("::")[2].strip().casefold())


def _number_of(name: str) -> str:
    """Return the number at the end of a plain name; "" if there is none."""
    return _plain_name(re.sub(r".*?(\d*)$", r"\1", name, flags=re.DOTALL))


def _by_time(measured: ConvertedRows, joints: ConvertedRows, within: float) -> Int64[np.ndarray, " rows"]:
    times, logged = _times(measured, joints), _times(joints, measured)
    check_same_recording(times, within, measured.source, measured.lines)
    check_same_recording(logged, within, joints.source, joints.lines)
    order = np.argsort(logged, kind="stable")
    after = np.clip(np.searchsorted(logged[order], times), min(1, len(order) - 1), len(order) - 1)
    before = np.maximum(after - 1, 0)  # the nearest stamp is one of the two neighbours in the sorted log
    nearer = np.abs(logged[order][after] - times) < np.abs(logged[order][before] - times)
    partner = order[np.where(nearer, after, before)]
    return np.where(np.abs(logged[partner] - times) <= within, partner, -1)


def _times(rows: ConvertedRows, other: ConvertedRows) -> Float64[np.ndarray, " rows"]:
    """Return the time stamps [s].

    Raises:
        MeasurementError: a time stamp is invalid, or neither file determines the order of day and month.
    """
    texts, others = _stamps(rows), _stamps(other)
    first = day_first(texts)
    if first is None and len({date_of(text) for text in (*texts, *others)}) == 1:
        first = True  # on the same day the order does not matter
    times = np.empty(len(rows.lines))
    for row, text in enumerate(texts):
        seconds = seconds_of(text, first)
        if seconds is None and has_ambiguous_date(text) and seconds_of(text, True) is not None:
            raise ambiguous_date_error(Place(rows.source, rows.lines[row]), text)
        if seconds is None:
            raise MeasurementError(
                expected="a time stamp such as 12.5, 10:31:02.5, 10:31:02 PM or 2026-03-02 10:31:02.5",
                value=text,
                at=Place(rows.source, rows.lines[row]),
                remedy="correct it, or remove the row",
            )
        times[row] = seconds
    return times


def _stamps(rows: ConvertedRows) -> list[str]:
    """Return the texts of the time stamps; a column of dates completes clock times."""
    _check_key(rows, "time", "time stamps")
    dates = rows.cells.get("date", ("",) * len(rows.lines))
    return [
        f"{date} {text}" if date and is_time_of_day(text) else text
        for date, text in zip(dates, rows.cells["time"], strict=True)
    ]


def _check_key(rows: ConvertedRows, key: str, what: str) -> None:
    if key not in rows.cells:
        raise MeasurementError(
            expected=f"a column of {what}, to join rows by them",
            value=Phrase("none"),
            at=Place(rows.source),
            remedy=f"name it with --map HEADING={key}, or join in another way",
        )


def _joint_columns(rows: ConvertedRows) -> list[str]:
    by_joint = {name.partition("_")[0]: name for name in rows.cells}
    return [by_joint[joint] for joint in joints_of(by_joint)]


def _partners(
    joints: ConvertedRows, partner: Int64[np.ndarray, " rows"], by: JoinBy
) -> Int64[np.ndarray, " _log"]:
    """Return the rows of the log that need not be listed: joined rows and, in a continuous log, rows between them."""
    if by != "time":
        if by == "point":
            names = {_plain_name(joints.cells["point"][row]) for row in partner if row >= 0}
            return np.flatnonzero([_plain_name(name) in names for name in joints.cells["point"]])
        return partner
    return np.arange(len(joints.lines)) if len(joints.lines) > 2 * len(partner) else partner


def _point(rows: ConvertedRows, row: int) -> str:
    return rows.cells["point"][row] if "point" in rows.cells else ""


def _moving(joints: ConvertedRows, partner: Int64[np.ndarray, " _rows"], within: float) -> list[str]:
    """Return a warning if joints moved around the time of a measurement."""
    times = _times(joints, joints)
    try:
        q = np.array([[float(text) for text in joints.cells[name]] for name in _joint_columns(joints)]).T
    except ValueError:
        return []  # the reader reports the cell
    order = np.argsort(times, kind="stable")
    low = np.searchsorted(times[order], times[partner] - within)
    high = np.searchsorted(times[order], times[partner] + within, side="right")
    moved = [float(np.ptp(q[order[a:b]], axis=0).max()) for a, b in zip(low, high, strict=True)]
    count = sum(value > _MAX_MOTION for value in moved)
    if not count:
        return []
    return [
        f"The joints move by up to {max(moved):.3g} (deg or mm) within {within:g} s of {count} measurements; measure "
        "while the robot is at rest."
    ]


def _no_partner(
    measured: ConvertedRows, joints: ConvertedRows, by: JoinBy, within: float
) -> MeasurementError:
    """Return the exception for two files without matching rows."""
    at = Place(f"{measured.source} and {joints.source}")
    if by == "time":
        times, logged = _times(measured, joints), _times(joints, measured)
        difference = np.abs(times[:1000, None] - logged[None, :1000]).min()
        expected, remedy = f"time stamps within {within:g} s of each other", "check the clocks and time zones"
        value = f"a smallest difference of {difference:.6g} s"
    else:
        expected, remedy = "points with the same name in both files", "check the columns of the names"
        value = f"{measured.cells['point'][0]} and {joints.cells['point'][0]}"
    return MeasurementError(expected=expected, value=value, at=at, remedy=remedy)
