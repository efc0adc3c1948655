"""A measuring session as it is printed: a line a row, or a page that changes."""

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from pisigma.files.errors import printable
from pisigma.planning.session.state import AccuracyPoint, SessionState
from pisigma.workflow.follow import SessionStep

if TYPE_CHECKING:
    from rich.console import RenderableType

SHOWN_ROWS, SHOWN_ALARMS, SHOWN_POINTS = 8, 4, 8
"""On the page: the last of them."""


def step_lines(step: SessionStep) -> Iterator[str]:
    """Say what is new, in a line each."""
    yield from step.growth.notices
    if step.growth.waiting and not step.state.rows.line:
        yield f"Waiting: {step.growth.waiting}"
    state = step.state
    lines = [] if step.growth.rows is None else step.growth.rows.line
    alarms = {alarm.line for alarm in step.alarms if not alarm.counts}
    for line in lines:
        if line not in alarms:
            yield f"line {line}: {row_text(state, state.rows.line.index(line))}"
    for alarm in step.alarms:
        yield f"{'Remark' if alarm.counts else 'ALARM'}: {alarm.sentence}"
    for point in step.points:
        yield accuracy_text(point)
    if lines or step.points:
        yield next_text(state)


def summary_lines(state: SessionState) -> Iterator[str]:
    """Say what the session has come to."""
    counting = int((~state.rows.alarmed).sum())
    yield f"{len(state.rows.line)} rows were read, {counting} of them count, {len(state.remaining)} poses are left."
    if state.accuracy is not None:
        yield accuracy_text(state.accuracy)
    narrow = [span for span in state.coverage if span.planned < 0.5]
    if narrow:
        names = ", ".join(f"{span.name} ({100 * span.planned:.0f} %)" for span in narrow)
        yield f"Less than half of the planned range was measured of: {names}."
    yield state.advice.sentence


def row_text(state: SessionState, row: int) -> str:
    """Say how far a row is from what the others predict."""
    error = float((state.rows.error[row] ** 2).sum() ** 0.5)
    kind = " (check)" if state.rows.check[row] else ""
    if error != error:
        return f"cannot be judged yet{kind}"
    return f"{error * 1e3:.2f} mm from what the other rows predict{kind}"


def accuracy_text(point: AccuracyPoint) -> str:
    """Say how accurate a calibration is."""
    texts = [_errors("expected", point.predicted_rms, point.predicted_p95)]
    texts += [_errors("left-out rows", point.cross_validated_rms, point.cross_validated_p95)]
    texts += [_errors("check poses", point.checked_rms, point.checked_p95)]
    return f"With {point.poses} poses, RMS and 95 % of the errors: {'; '.join(filter(None, texts))}."


def next_text(state: SessionState) -> str:
    """Say which pose is next."""
    following = state.next_pose
    if following is None:
        return "No pose is left."
    units = ("deg" if turns else "mm" for turns in state.revolute)
    values = zip(state.in_file_units(following.values), units, strict=True)
    joints = ", ".join(f"{value:.3f} {unit}" for value, unit in values)
    kind = " (check)" if following.check else ""
    return f"Next: pose {following.number} of {following.count}{kind}: {joints}."


def page(step: SessionStep | None, state: SessionState, title: str) -> "RenderableType":
    """Lay out the session for a terminal."""
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    def table(name: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
        laid_out = Table(*columns, title=Text(name), title_justify="left", box=None, pad_edge=False)
        for row in rows:
            laid_out.add_row(*(Text(printable(cell, cut=False)) for cell in row))
        return laid_out

    first = max(0, len(state.rows.line) - SHOWN_ROWS)
    rows = [(str(state.rows.line[row]), _verdict(state, row)) for row in range(first, len(state.rows.line))]
    points = (*state.reached, *state.expected)[-SHOWN_POINTS:]
    waiting = "" if step is None else step.growth.waiting
    alarms = [printable(alarm.sentence, cut=False) for alarm in state.alarms[-SHOWN_ALARMS:]]
    colour = {"measure": "bold", "repeat": "bold red", "correct": "bold red", "stop": "bold green"}[
        state.advice.action
    ]
    return Group(
        Text(printable(title), style="bold"),
        Text(next_text(state)),
        Text(printable(state.advice.sentence, cut=False), style=colour),
        *([Text(f"Waiting: {printable(waiting, cut=False)}", style="dim")] if waiting else []),
        *(Text(alarm, style="red") for alarm in alarms),
        table("Rows", ("line", "error"), rows),
        table("Accuracy [mm]", ("poses", "expected RMS", "95 %", "left-out RMS", "95 %"), _points(points)),
        table("Joints", ("joint", "measured", "of the planned range"), _coverage(state)),
    )


def _verdict(state: SessionState, row: int) -> str:
    return "does not count" if state.rows.alarmed[row] else row_text(state, row)


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


def _errors(name: str, rms: float, p95: float) -> str:
    return "" if rms != rms else f"{name} {rms * 1e3:.3f} and {p95 * 1e3:.3f} mm"
