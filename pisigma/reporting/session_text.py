"""A measuring session as text: its result, lines about its steps, or a page on the terminal that changes."""

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from pisigma.files.errors import make_printable
from pisigma.planning.session.state import AccuracyPoint, SessionState, SessionStep
from pisigma.reporting.result_text import MAX_ALIKE, ResultText, merge_alike_warnings, numbers_as_ranges
from pisigma.reporting.verdict import Verdict, count_text, rounded_text, uncapitalised

if TYPE_CHECKING:
    from rich.console import RenderableType


def session_text(state: SessionState, closing_sentences: Sequence[str] = ()) -> ResultText:
    """Lay out a session: the accuracy so far, the used rows, and whether to measure more.

    Args:
        state: state of the session.
        closing_sentences: sentence on the written files.
    """
    counting = int((~state.rows.is_unused).sum())
    reached = "not known yet." if state.accuracy is None else accuracy_text(state.accuracy)
    alarmed = len(state.rows.line) - counting
    trust = (
        f"{count_text(counting, 'row')} used, {alarmed} left out" if alarmed else f"all {counting} rows count"
    )
    if state.advice.action == "correct":
        trust = "no: all rows have the same fault"
    left = count_text(len(state.remaining), "pose")
    verdict = Verdict(
        reached, f"{trust}; {left} of the plan not measured.", uncapitalised(state.advice.sentence)
    )
    return ResultText(verdict, tuple(_narrow(state)), closing_sentences=tuple(closing_sentences))


def _narrow(state: SessionState) -> list[str]:
    """Return a text on joints that were measured over less than half of their planned range."""
    narrow = [span for span in state.coverage if span.planned < 0.5]
    names = ", ".join(f"{span.name} ({100 * span.planned:.0f} %)" for span in narrow)
    return [f"less than half of the planned range was measured of: {names}."] if narrow else []


def accuracy_text(point: AccuracyPoint) -> str:
    """Return a text on the accuracy of a calibration."""
    texts = [_errors("predicted", point.predicted_rms, point.predicted_p95)]
    texts += [_errors("held-out rows", point.cross_validated_rms, point.cross_validated_p95)]
    texts += [_errors("check poses", point.checked_rms, point.checked_p95)]
    return f"with {point.poses} poses, RMS and 95 % of the errors: {'; '.join(filter(None, texts))}."


def _errors(name: str, rms: float, p95: float) -> str:
    return "" if rms != rms else f"{name} {rounded_text(rms * 1e3)} and {rounded_text(p95 * 1e3)} mm"


_SHOWN_ROWS, _SHOWN_ALARMS, _SHOWN_POINTS = 8, 4, 8
"""Largest numbers of rows, alarms and points on the page; the last ones are shown."""


def step_lines(step: SessionStep) -> Iterator[str]:
    """Return lines about new rows, alarms and poses; many rows or alarms of one kind share a line."""
    yield from step.growth.notices
    if step.growth.missing_part and not step.state.rows.line:
        yield f"Waiting: {step.growth.missing_part}"
    state = step.state
    lines = [] if step.growth.rows is None else step.growth.rows.line
    alarms = {alarm.line for alarm in step.alarms if not alarm.row_is_used}
    yield from _row_lines(state, [line for line in lines if line not in alarms])
    yield from merge_alike_warnings(
        f"{'Remark' if alarm.row_is_used else 'ALARM'}: {alarm.sentence}" for alarm in step.alarms
    )
    for point in step.points:
        yield f"Accuracy {accuracy_text(point)}"
    if lines or step.points:
        yield next_pose_text(state)


def _row_lines(state: SessionState, lines: Sequence[int]) -> Iterator[str]:
    """Return lines about the distance of new rows from their predictions; one line if there are many rows."""
    rows = [state.rows.line.index(line) for line in lines]
    if len(lines) <= MAX_ALIKE:
        yield from (f"line {line}: {row_text(state, row)}" for line, row in zip(lines, rows, strict=True))
        return
    errors = np.linalg.norm(state.rows.error[rows], axis=1) * 1e3
    known = errors[~np.isnan(errors)]
    if not len(known):
        yield f"lines {numbers_as_ranges(lines)}: cannot be judged yet"
        return
    worst = lines[int(np.nanargmax(errors))]
    yield (
        f"lines {numbers_as_ranges(lines)}: {rounded_text(float(np.sqrt((known**2).mean())), len(known))} mm RMS from "
        f"what the other rows predict, at most {rounded_text(float(known.max()), len(known))} mm (line {worst})"
    )


def row_text(state: SessionState, row: int) -> str:
    """Return a text with the distance of a row from its prediction by the other rows."""
    error = float((state.rows.error[row] ** 2).sum() ** 0.5)
    kind = " (check)" if state.rows.is_test_row[row] else ""
    if error != error:
        return f"cannot be judged yet{kind}"
    return f"{error * 1e3:.2f} mm from what the other rows predict{kind}"


def next_pose_text(state: SessionState) -> str:
    """Return a text about the next pose."""
    following = state.next_pose
    if following is None:
        return "No pose is left."
    units = ("deg" if turns else "mm" for turns in state.revolute)
    values = zip(state.in_file_units(following.controller_values), units, strict=True)
    joints = ", ".join(f"{value:.3f} {unit}" for value, unit in values)
    kind = " (check)" if following.is_test_pose else ""
    return f"Next: pose {following.number} of {following.largest_pose_number}{kind}: {joints}."


def session_page(step: SessionStep | None, state: SessionState, title: str) -> "RenderableType":
    """Return the session laid out for a terminal."""
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    def table(name: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
        laid_out = Table(*columns, title=Text(name), title_justify="left", box=None, pad_edge=False)
        for row in rows:
            laid_out.add_row(*(Text(make_printable(cell, cut=False)) for cell in row))
        return laid_out

    first = max(0, len(state.rows.line) - _SHOWN_ROWS)
    rows = [(str(state.rows.line[row]), _verdict(state, row)) for row in range(first, len(state.rows.line))]
    points = (*state.reached_accuracy, *state.expected_accuracy)[-_SHOWN_POINTS:]
    waiting = "" if step is None else step.growth.missing_part
    alarms = [make_printable(alarm.sentence, cut=False) for alarm in state.alarms[-_SHOWN_ALARMS:]]
    colour = {"measure": "bold", "repeat": "bold red", "correct": "bold red", "stop": "bold green"}[
        state.advice.action
    ]
    return Group(
        Text(make_printable(title), style="bold"),
        Text(next_pose_text(state)),
        Text(make_printable(state.advice.sentence, cut=False), style=colour),
        *([Text(f"Waiting: {make_printable(waiting, cut=False)}", style="dim")] if waiting else []),
        *(Text(alarm, style="red") for alarm in alarms),
        table("Rows", ("line", "error"), rows),
        table("Accuracy [mm]", ("poses", "predicted RMS", "95 %", "held-out RMS", "95 %"), _points(points)),
        table("Joints", ("joint", "measured", "share of the planned range"), _coverage(state)),
    )


def _verdict(state: SessionState, row: int) -> str:
    return "not used" if state.rows.is_unused[row] else row_text(state, row)


def _points(points: Sequence[AccuracyPoint]) -> list[tuple[str, ...]]:
    return [
        (
            str(point.poses),
            *(
                "" if value != value else f"{value * 1e3:.3f}"
                for value in (
                    point.predicted_rms,
                    point.predicted_p95,
                    point.cross_validated_rms,
                    point.cross_validated_p95,
                )
            ),
        )
        for point in points
    ]


def _coverage(state: SessionState) -> list[tuple[str, ...]]:
    lower = state.in_file_units([span.lower for span in state.coverage])
    upper = state.in_file_units([span.upper for span in state.coverage])
    return [
        (span.name, f"{low:.1f} to {high:.1f} {'deg' if turns else 'mm'}", f"{100 * span.planned:.0f} %")
        for span, low, high, turns in zip(state.coverage, lower, upper, state.revolute, strict=False)
    ]
