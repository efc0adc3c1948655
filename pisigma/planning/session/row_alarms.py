"""Alarms about single rows: what was expected, what was measured, and what to do."""

from collections.abc import Iterator, Sequence

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.geometric.prediction import predicted_poses
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.fields import UnusableRow
from pisigma.planning.session.row_judgement import FALSE_ALARMS, RowJudgement
from pisigma.planning.session.state import Alarm
from pisigma.robot.description import Robot

_SAME_READING = 2e-6
"""Difference below which readings are the same [m]; noise makes independent readings differ by more."""
_SAME_VALUE = 1e-9
"""Difference below which numbers are the same up to rounding in the file [SI units]."""
_SAME_POSE, NEAR_POSE = 0.1, 3.0
"""Differences of joint values [deg or mm] below which a row is at a pose, and below which it is meant to be at the
pose."""
_SWAPPED_SHARE = 0.2
"""Share of a point's error below which the distance of the point from another pose shows that it belongs to that
pose."""
_AMBIGUOUS_ROWS = 6
"""Number of rows up to which a different row may be the wrong one."""


def unreadable_alarm(row: UnusableRow) -> Alarm:
    """Return the alarm about a row that cannot be read."""
    return Alarm(row.line, "unreadable", f"line {row.line}: {row.reason}.", repeat=True)


def alarm_of_all_rows(sentence: str) -> Alarm:
    """Return the alarm about a fault that affects all rows, for example in the header of the file."""
    return Alarm(1, "setup", f"line 1: {sentence} Correct this before you continue measuring.", repeat=False)


def withdrawn_alarm(line: int) -> Alarm:
    """Return the message that withdraws an alarm."""
    text = f"line {line}: later rows agree with it, so the row is used again."
    return Alarm(line, "cleared", text, repeat=False, row_is_used=True)


def stale_reading_alarms(rows: Measurements, start: int) -> Iterator[Alarm]:
    """Yield alarms about rows from `start` that repeat readings of an earlier row: duplicates, or a frozen sensor."""
    fields = rows.as_fields().numbers.values()
    numbers = torch.cat([values.reshape(rows.rows, -1) for values in fields], 1)
    position = torch.full((rows.rows, 3), torch.nan) if rows.position is None else rows.position
    for row in range(start, rows.rows):
        frozen = (position[:row] - position[row]).norm(dim=1) < _SAME_READING
        off = (numbers[:row] - numbers[row]).abs() < _SAME_VALUE
        same = frozen | (off | (numbers[:row].isnan() & numbers[row].isnan())).all(1)
        if not bool(same.any()):
            continue
        earlier = int(same.nonzero()[0])
        here, there = rows.line[row], rows.line[earlier]
        if float((rows.q[row] - rows.q[earlier]).abs().max()) < _SAME_VALUE:
            text = f"line {here}: joint values and readings equal those of line {there}; the row is not used."
            yield Alarm(here, "duplicate", text, repeat=False)
        else:
            text = (
                f"line {here}: the position equals that of line {there} exactly, but the joint values differ. The "
                "sensor shows an old value; check that it is measuring, and measure the pose again."
            )
            yield Alarm(here, "frozen", text, repeat=True)


def unplanned_joint_alarms(
    robot: Robot,
    rows: Measurements,
    start: int,
    poses: Float64[Tensor, "poses dof"],
    names: Sequence[str],
) -> Iterator[Alarm]:
    """Yield alarms about rows from `start` with joint values that are not planned; these rows are still used."""
    for row in range(start, rows.rows):
        off = joint_differences(robot, rows.q[row : row + 1], poses)[0].abs()
        pose = int(off.amax(1).argmin())
        joint = int(off[pose].argmax())
        most = float(off[pose, joint])
        if most <= _SAME_POSE:
            continue
        name = robot.joints[joint]
        if most <= NEAR_POSE:
            text = (
                f"joint '{name.name}' differs by {most:.2f} {name.file_unit} from its value in {names[pose]}; the row "
                "is used at its own joint values."
            )
        else:
            text = _in_other_unit(robot, rows.q[row : row + 1], poses, names) or (
                "its joint values are not those of a planned pose; the row is treated as an additional pose."
            )
        yield Alarm(rows.line[row], "pose", f"line {rows.line[row]}: {text}", repeat=False, row_is_used=True)


def _in_other_unit(
    robot: Robot, q: Float64[Tensor, "1 dof"], poses: Float64[Tensor, "poses dof"], names: Sequence[str]
) -> str:
    """Return a text with the planned pose of a row whose angles are in another unit; "" if there is none."""
    stated = {
        180 / torch.pi: "radians labelled as degrees",
        torch.pi / 180: "degrees labelled as radians",
    }
    for factor, unit in stated.items():
        other = torch.where(torch.tensor(robot.revolute), factor * q, q)
        off = joint_differences(robot, other, poses)[0].abs().amax(1)
        if float(off.min()) <= NEAR_POSE:
            return f"its joint values are those of {names[int(off.argmin())]} if they are {unit}; correct the header."
    return ""


def contradiction_alarm(
    rows: Measurements,
    judgement: RowJudgement,
    row: int,
    poses: Float64[Tensor, "poses dof"],
    names: Sequence[str],
) -> Alarm:
    """Return the alarm about a row that others contradict, naming the pose to which its point may belong.

    Args:
        rows: all rows.
        judgement: result of `judge_rows` for the rows.
        row: index of the row.
        poses: joint values of the planned poses [rad or m].
        names: names of the planned poses.
    """
    assert judgement.model is not None
    assert judgement.errors is not None
    line, errors = rows.line[row], judgement.errors
    length, angle = float(errors.length_error[row]), float(errors.angle_error[row].rad2deg())
    usual = float(errors.length_error[judgement.used_rows].nanmedian()) * 1e3
    parts = [f"{length * 1e3:.2f} mm"] if length == length else []
    parts += [f"{angle:.3f} deg in orientation"] if angle == angle else []
    what = f"line {line}: the measured value is {' and '.join(parts) or 'far'} from the prediction of the other rows"
    what += f" ({usual:.2f} mm is usual here)" if usual == usual else ""
    other = _other_pose(rows, judgement, row, poses, names)
    if other:
        advice = "Check whether points or joint values were swapped, and measure the pose again."
        text = f"{what}; it looks like {other}. {advice}"
        return Alarm(line, "swapped", text, repeat=True)
    advice = "Check the reflector, its seat and the line of sight, and measure the pose again."
    if bool(rows.is_measured("corner")[row]):
        advice = "Check the image, make sure that robot and board are at rest, and take it again."
    if rows.rows <= _AMBIGUOUS_ROWS:
        advice = f"With so few rows, another row may be the wrong one. {advice}"
    return Alarm(line, "off", f"{what}. {advice}", repeat=True)


def _other_pose(
    rows: Measurements,
    judgement: RowJudgement,
    row: int,
    poses: Float64[Tensor, "poses dof"],
    names: Sequence[str],
) -> str:
    """Return a text with the planned pose or the row whose point was measured; "" if there is none."""
    assert judgement.model is not None
    assert judgement.errors is not None
    if rows.position is None or not bool(rows.position[row].isfinite().all()):
        return ""
    geometry, length = judgement.model.geometry, float(judgement.errors.length_error[row])
    q = torch.cat([poses, rows.q])
    at = Measurements(q, frame=(rows.frame[row],) * len(q), target=(rows.target[row],) * len(q))
    T = predicted_poses(geometry.robot, geometry.bases, geometry.tools, at)
    distance = (T[:, :3, 3] - rows.position[row]).norm(dim=1)
    nearest = int(distance.argmin())
    if not float(distance[nearest]) < _SWAPPED_SHARE * length:
        return ""
    where = names[nearest] if nearest < len(poses) else f"line {rows.line[nearest - len(poses)]}"
    return f"the point of {where} ({float(distance[nearest]) * 1e3:.2f} mm from it)"


def joint_differences(
    robot: Robot, q: Float64[Tensor, "rows dof"], poses: Float64[Tensor, "poses dof"]
) -> Float64[Tensor, "rows poses dof"]:
    """Compute joint values of rows minus those of poses [deg or mm]."""
    scale = torch.where(torch.tensor(robot.revolute), 180 / torch.pi, 1e3).double()
    return (q[:, None] - poses) * scale


def is_wrong(judgement: RowJudgement) -> Tensor:
    """Return the mask of rows that are contradicted by the others."""
    if judgement.errors is None:
        return torch.zeros_like(judgement.used_rows)
    return ~judgement.used_rows & (judgement.errors.p_value < FALSE_ALARMS)
