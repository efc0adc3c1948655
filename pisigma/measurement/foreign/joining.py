"""A log of joint values and a list of measurements, put together by name, order or time."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Literal

import numpy as np
from jaxtyping import Float64, Int64

from pisigma.errors import MeasurementError
from pisigma.measurement.foreign.conversion import ConvertedRows
from pisigma.measurement.foreign.quantities import KEYS, is_measured, joints_of

JoinBy = Literal["point", "order", "time"]
WITHIN = 0.2
"""[s] Two time stamps of one pose differ by no more, where nothing is said."""
_MOVED = 0.05
"""[deg or mm] A joint that moves by more around a time stamp did not stand."""
_NAMED = 5
"""Rows that a message names."""
_DAY = re.compile(r"(\d{1,2})\.(\d{1,2})\.(\d{4})[ T]+(.*)")
_CLOCK = re.compile(r"(\d{1,2}):(\d{2})(?::(\d{2}(?:[.,]\d+)?))?")


@dataclass(frozen=True, eq=False)
class JoinedRows:
    """Rows that were put together.

    Attributes:
        rows: what was measured, in its order, with the joint values.
        unmatched: sentences on the rows that have no partner.
        warnings: what else should be known, each a sentence.
    """

    rows: ConvertedRows
    unmatched: tuple[str, ...]
    warnings: tuple[str, ...]


def join_rows(
    measured: ConvertedRows, joints: ConvertedRows, by: JoinBy, within: float = WITHIN
) -> JoinedRows:
    """Put a list of measurements and a log of joint values together.

    Rows of the list stay in their order; one without a partner is left out and named. Poses of the log are commanded or
    calculated, and are left out.

    Args:
        measured: rows without joint values.
        joints: rows with joint values.
        by: "point": names of points, without the groups before "::" and whatever their case and leading zeros;
            "order": the first with the first and so on; "time": the row of the log that is nearest in time.
        within: largest difference of time stamps [s].

    Raises:
        MeasurementError: there is nothing to join by, numbers of rows differ, a name stands at different joint values,
            or no row has a partner.
    """
    if by == "order":
        partner = _by_order(measured, joints)
    elif by == "point":
        partner = _by_point(measured, joints)
    else:
        partner = _by_time(measured, joints, within)
    matched = np.flatnonzero(partner >= 0)
    if not len(matched):
        raise MeasurementError(
            f"{measured.source} and {joints.source}: {_nothing(measured, joints, by, within)}"
        )
    left_out = [name for name in joints.cells if is_measured(name)]
    kept = [name for name in joints.cells if name not in (*left_out, *KEYS, *measured.cells)]
    cells = {name: tuple(joints.cells[name][row] for row in partner[matched]) for name in kept}
    cells |= {name: tuple(texts[row] for row in matched) for name, texts in measured.cells.items()}
    rows = ConvertedRows(measured.source, tuple(measured.lines[row] for row in matched), cells)
    warnings = []
    if left_out:
        names = ", ".join(left_out)
        warnings.append(
            f"{joints.source}: {names} are left out, as the measurements are those of {measured.source}."
        )
    if by == "time":
        warnings += _moving(joints, partner[matched], within)
    unmatched = (
        *_alone(measured, np.flatnonzero(partner < 0), joints),
        *_alone(joints, np.setdiff1d(np.arange(len(joints.lines)), _partners(joints, partner, by)), measured),
    )
    return JoinedRows(rows, unmatched, tuple(warnings))


def append_rows(rows: Sequence[ConvertedRows]) -> ConvertedRows:
    """Put the rows of several files behind each other; what one of them lacks is empty in its rows."""
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
    )


def _by_order(measured: ConvertedRows, joints: ConvertedRows) -> Int64[np.ndarray, " rows"]:
    if len(measured.lines) != len(joints.lines):
        raise MeasurementError(
            f"{measured.source} has {len(measured.lines)} rows and {joints.source} {len(joints.lines)}, so that they "
            "cannot be joined by order; join them by point or time, or complete the shorter one."
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
                f"{joints.source}, line {joints.lines[row]}: the point '{text}' stands in line {first} at other joint "
                "values; give every pose a name of its own."
            )
    names = map(_plain_name, measured.cells["point"])
    return np.array([row_of.get(name, -1) if name else -1 for name in names], dtype=np.int64)


def _plain_name(text: str) -> str:
    """A name without the groups before it, case, and leading zeros."""
    return re.sub(r"(?<![\d.])0+(?=\d)", "", text.rpartition("::")[2].strip().casefold())


def _by_time(measured: ConvertedRows, joints: ConvertedRows, within: float) -> Int64[np.ndarray, " rows"]:
    times, logged = _times(measured), _times(joints)
    order = np.argsort(logged, kind="stable")
    after = (
        np.clip(np.searchsorted(logged[order], times), 1, len(order) - 1)
        if len(order) > 1
        else np.zeros(len(times), dtype=np.int64)
    )
    before = np.maximum(after - 1, 0)
    nearer = np.abs(logged[order][after] - times) < np.abs(logged[order][before] - times)
    partner = order[np.where(nearer, after, before)]
    return np.where(np.abs(logged[partner] - times) <= within, partner, -1)


def _times(rows: ConvertedRows) -> Float64[np.ndarray, " rows"]:
    """Time stamps [s]."""
    _check_key(rows, "time", "time stamps")
    times = np.empty(len(rows.lines))
    for row, text in enumerate(rows.cells["time"]):
        seconds = seconds_of(text)
        if seconds is None:
            raise MeasurementError(
                f"{rows.source}, line {rows.lines[row]}: '{text}' is no time stamp; seconds, 10:31:02.5, or "
                "2026-03-02 10:31:02.5 were wanted."
            )
        times[row] = seconds
    return times


def seconds_of(text: str) -> float | None:
    """Seconds of a number, of a clock, or of a date with a clock (in UTC where no zone is named); None for others."""
    try:
        return number if np.isfinite(number := float(text)) else None
    except ValueError:
        pass
    if match := _CLOCK.fullmatch(text.strip()):
        return int(match[1]) * 3600 + int(match[2]) * 60 + float((match[3] or "0").replace(",", "."))
    if match := _DAY.fullmatch(text.strip()):
        text = f"{match[3]}-{match[2]:0>2}-{match[1]:0>2}T{match[4]}"
    try:
        stamp = datetime.fromisoformat(text.strip().replace("/", "-"))
    except ValueError:
        return None
    return (stamp if stamp.tzinfo else stamp.replace(tzinfo=UTC)).timestamp()


def _check_key(rows: ConvertedRows, key: str, what: str) -> None:
    if key not in rows.cells:
        raise MeasurementError(
            f"{rows.source}: no column holds {what}, by which rows were to be joined; name it with --map "
            f"HEADING={key}, or join by something else."
        )


def _joint_columns(rows: ConvertedRows) -> list[str]:
    by_joint = {name.partition("_")[0]: name for name in rows.cells}
    return [by_joint[joint] for joint in joints_of(by_joint)]


def _partners(
    joints: ConvertedRows, partner: Int64[np.ndarray, " rows"], by: JoinBy
) -> Int64[np.ndarray, " _log"]:
    """The rows of the log that need no mention: those that were joined, and between them those of a running log."""
    if by != "time":
        if by == "point":
            names = {_plain_name(joints.cells["point"][row]) for row in partner if row >= 0}
            return np.flatnonzero([_plain_name(name) in names for name in joints.cells["point"]])
        return partner
    return np.arange(len(joints.lines)) if len(joints.lines) > 2 * len(partner) else partner


def _alone(rows: ConvertedRows, alone: Int64[np.ndarray, " _alone"], other: ConvertedRows) -> list[str]:
    """A sentence on rows without a partner."""
    if not len(alone):
        return []
    named = [
        f"line {rows.lines[row]}" + (f" ({point})" if (point := _point(rows, row)) else "")
        for row in alone[:_NAMED].tolist()
    ]
    more = f" and {len(alone) - _NAMED} more" if len(alone) > _NAMED else ""
    have, are = ("1 row has", "is") if len(alone) == 1 else (f"{len(alone)} rows have", "are")
    return [
        f"{rows.source}: {have} no partner in {other.source} and {are} left out: {', '.join(named)}{more}."
    ]


def _point(rows: ConvertedRows, row: int) -> str:
    return rows.cells["point"][row] if "point" in rows.cells else ""


def _moving(joints: ConvertedRows, partner: Int64[np.ndarray, " _rows"], within: float) -> list[str]:
    """A sentence where joints moved around the time at which something was measured."""
    times = _times(joints)
    try:
        q = np.array([[float(text) for text in joints.cells[name]] for name in _joint_columns(joints)]).T
    except ValueError:
        return []  # the reader names the cell
    order = np.argsort(times, kind="stable")
    low = np.searchsorted(times[order], times[partner] - within)
    high = np.searchsorted(times[order], times[partner] + within, side="right")
    moved = [float(np.ptp(q[order[a:b]], axis=0).max()) for a, b in zip(low, high, strict=True)]
    count = sum(value > _MOVED for value in moved)
    if not count:
        return []
    return [
        f"The joints move by up to {max(moved):.3g} (deg or mm) within {within:g} s of {count} measurements; measure "
        "while the robot stands."
    ]


def _nothing(measured: ConvertedRows, joints: ConvertedRows, by: JoinBy, within: float) -> str:
    """Say why no row has a partner."""
    if by == "time":
        times, logged = _times(measured), _times(joints)
        apart = np.abs(times[:1000, None] - logged[None, :1000]).min()
        return (
            f"no time stamps are within {within:g} s of each other, the nearest are {apart:.6g} s apart; check the "
            "clocks and their zones."
        )
    first, second = measured.cells["point"][0], joints.cells["point"][0]
    return f"no point has the same name in both, '{first}' and '{second}' for example; check the columns of the names."
