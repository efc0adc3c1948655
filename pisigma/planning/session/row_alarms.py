"""What is wrong with a row, in a sentence: what was expected, what came, and what to do."""

from collections.abc import Iterator, Sequence

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.geometric.prediction import predicted_poses
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.fields import LeftOut
from pisigma.planning.session.row_judgement import FALSE_ALARMS, RowJudgement
from pisigma.planning.session.state import Alarm
from pisigma.robot.description import Robot

SAME_READING = 2e-6
"""[m] Readings of two poses never agree so well, not even with a robot that stands still."""
SAME_VALUE = 1e-9
"""[SI] Numbers that were written twice differ by no more."""
SAME_POSE, NEAR_POSE = 0.1, 3.0
"""[deg or mm] Joint values so near to those of a pose are that pose, or are meant to be."""
SWAPPED = 0.2
"""A point is that of another pose where it is nearer to it than this share of its error."""
CONTRADICTION = 6
"""Up to so many rows, an error may as well be one of the others."""


def unreadable(row: LeftOut) -> Alarm:
    """Complain of a row that cannot be read."""
    return Alarm(row.line, "unreadable", f"line {row.line}, {row.reason}.", repeat=True)


def of_all_rows(sentence: str) -> Alarm:
    """Complain of what is wrong with all rows alike, which the header of their file may say."""
    return Alarm(1, "setup", f"line 1: {sentence} Do not go on before it is right.", repeat=False)


def cleared(line: int) -> Alarm:
    """Take an alarm back."""
    text = f"line {line}: the rows that came since agree with it, so it counts after all."
    return Alarm(line, "cleared", text, repeat=False, counts=True)


def stale_readings(rows: Measurements, start: int) -> Iterator[Alarm]:
    """Find rows from one on whose readings are those of an earlier row: written twice, or from a frozen sensor."""
    fields = rows.as_fields().numbers.values()
    numbers = torch.cat([values.reshape(rows.rows, -1) for values in fields], 1)
    position = torch.full((rows.rows, 3), torch.nan) if rows.position is None else rows.position
    for row in range(start, rows.rows):
        frozen = (position[:row] - position[row]).norm(dim=1) < SAME_READING
        off = (numbers[:row] - numbers[row]).abs() < SAME_VALUE
        same = frozen | (off | (numbers[:row].isnan() & numbers[row].isnan())).all(1)
        if not bool(same.any()):
            continue
        earlier = int(same.nonzero()[0])
        here, there = rows.line[row], rows.line[earlier]
        if float((rows.q[row] - rows.q[earlier]).abs().max()) < SAME_VALUE:
            text = (
                f"line {here}: joint values and readings are those of line {there}; the row does not count."
            )
            yield Alarm(here, "duplicate", text, repeat=False)
        else:
            text = (
                f"line {here}: the position is exactly that of line {there}, but the joint values are others. The "
                "sensor shows an old value; check that it measures, and measure the pose again."
            )
            yield Alarm(here, "frozen", text, repeat=True)


def other_joint_values(
    robot: Robot,
    rows: Measurements,
    start: int,
    poses: Float64[Tensor, "poses dof"],
    names: Sequence[str],
) -> Iterator[Alarm]:
    """Find rows from one on whose joint values are not those of a planned pose; they count nevertheless."""
    for row in range(start, rows.rows):
        off = joint_differences(robot, rows.q[row : row + 1], poses)[0].abs()
        pose = int(off.amax(1).argmin())
        joint = int(off[pose].argmax())
        most = float(off[pose, joint])
        if most <= SAME_POSE:
            continue
        name = robot.joints[joint]
        if most <= NEAR_POSE:
            text = (
                f"joint '{name.name}' is {most:.2f} {name.file_unit} from its value in {names[pose]}; the row counts "
                "at the joint values that it states."
            )
        else:
            text = _in_other_unit(robot, rows.q[row : row + 1], poses, names) or (
                "no pose of the plan has its joint values; the row counts as one more pose."
            )
        yield Alarm(rows.line[row], "pose", f"line {rows.line[row]}: {text}", repeat=False, counts=True)


def _in_other_unit(
    robot: Robot, q: Float64[Tensor, "1 dof"], poses: Float64[Tensor, "poses dof"], names: Sequence[str]
) -> str:
    """Name the planned pose that a row is at if its angles are in another unit than stated; "" where none is."""
    stated = {
        180 / torch.pi: "radians that are named degrees",
        torch.pi / 180: "degrees that are named radians",
    }
    for factor, unit in stated.items():
        other = torch.where(torch.tensor(robot.revolute), factor * q, q)
        off = joint_differences(robot, other, poses)[0].abs().amax(1)
        if float(off.min()) <= NEAR_POSE:
            return f"its joint values are those of {names[int(off.argmin())]} if they are {unit}; correct the header."
    return ""


def contradicted(
    rows: Measurements,
    judgement: RowJudgement,
    row: int,
    poses: Float64[Tensor, "poses dof"],
    names: Sequence[str],
) -> Alarm:
    """Say how far a row is off what the others say of it, and whether its point is that of another pose.

    Args:
        rows: all rows.
        judgement: of them.
        row: number of the row.
        poses: joint values of the poses that were planned [rad or m].
        names: of these.
    """
    assert judgement.model is not None
    assert judgement.errors is not None
    line, errors = rows.line[row], judgement.errors
    length, angle = float(errors.length[row]), float(errors.angle[row].rad2deg())
    usual = float(errors.length[judgement.counts].nanmedian()) * 1e3
    parts = [f"{length * 1e3:.2f} mm"] if length == length else []
    parts += [f"{angle:.3f} deg in orientation"] if angle == angle else []
    what = (
        f"line {line}: the measured value is {' and '.join(parts) or 'far'} from what the other rows predict"
    )
    what += f" ({usual:.2f} mm is usual here)" if usual == usual else ""
    other = _other_pose(rows, judgement, row, poses, names)
    if other:
        advice = "Look for points or joint values that were swapped, and measure it again."
        text = f"{what}; it looks like {other}. {advice}"
        return Alarm(line, "swapped", text, repeat=True)
    advice = "Check the reflector, its seat and the line of sight, and measure the pose again."
    if bool(rows.measured("corner")[row]):
        advice = "Check the image, and that robot and board stood still, and take it again."
    if rows.rows <= CONTRADICTION:
        advice = f"It may as well be one of the others, as they are few. {advice}"
    return Alarm(line, "off", f"{what}. {advice}", repeat=True)


def _other_pose(
    rows: Measurements,
    judgement: RowJudgement,
    row: int,
    poses: Float64[Tensor, "poses dof"],
    names: Sequence[str],
) -> str:
    """Name the pose that was planned, or the row, whose point was measured; "" where it is none."""
    assert judgement.model is not None
    assert judgement.errors is not None
    if rows.position is None or not bool(rows.position[row].isfinite().all()):
        return ""
    geometry, length = judgement.model.geometry, float(judgement.errors.length[row])
    q = torch.cat([poses, rows.q])
    at = Measurements(q, frame=(rows.frame[row],) * len(q), target=(rows.target[row],) * len(q))
    T = predicted_poses(geometry.robot, geometry.bases, geometry.tools, at)
    distance = (T[:, :3, 3] - rows.position[row]).norm(dim=1)
    nearest = int(distance.argmin())
    if not float(distance[nearest]) < SWAPPED * length:
        return ""
    where = names[nearest] if nearest < len(poses) else f"line {rows.line[nearest - len(poses)]}"
    return f"the point of {where} ({float(distance[nearest]) * 1e3:.2f} mm from it)"


def joint_differences(
    robot: Robot, q: Float64[Tensor, "rows dof"], poses: Float64[Tensor, "poses dof"]
) -> Float64[Tensor, "rows poses dof"]:
    """Joint values of rows minus those of poses, in the units of files [deg or mm]."""
    scale = torch.where(torch.tensor(robot.revolute), 180 / torch.pi, 1e3).double()
    return (q[:, None] - poses) * scale


def is_wrong(judgement: RowJudgement) -> Tensor:
    """Rows that the others contradict."""
    if judgement.errors is None:
        return torch.zeros_like(judgement.counts)
    return ~judgement.counts & (judgement.errors.chance < FALSE_ALARMS)
