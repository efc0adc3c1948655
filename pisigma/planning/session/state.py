"""What a measuring session has come to, as terminals and pages show it."""

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float64
from torch import Tensor

from pisigma.robot.description import Robot

AlarmKind = Literal["setup", "unreadable", "duplicate", "frozen", "swapped", "off", "pose", "cleared"]
"""All rows have the same fault, such as a unit; the row cannot be read; it equals another one; the sensor shows an old
value; the values of two poses are swapped; the value is off; the joint values are not those of a pose of the plan (a
remark: the row counts); an alarm was taken back, as the rows that came since agree with the row."""


@dataclass(frozen=True)
class Alarm:
    """A row that cannot be right, or a remark on one.

    Attributes:
        line: the row's line in the file.
        kind: what is wrong.
        sentence: what was expected, what came, and whether to measure the pose again.
        repeat: whether the pose is to be measured again.
        counts: whether the row counts nevertheless.
    """

    line: int
    kind: AlarmKind
    sentence: str
    repeat: bool
    counts: bool = False


@dataclass(frozen=True, eq=False)
class RowsSoFar:
    """All rows that were read, in the order of the file.

    Attributes:
        line: lines in the file.
        q: commanded joint values [rad or m].
        position: where the target is predicted, in the robot's base frame [m]; NaN while base and tool are unknown.
        error: measured - predicted position in the base frame [m]; NaN where it cannot be judged.
        check: rows of the set "test", which judge the calibration and are not calibrated with.
        alarmed: rows that do not count.
    """

    line: tuple[int, ...]
    q: Float64[np.ndarray, "rows dof"]
    position: Float64[np.ndarray, "rows 3"]
    error: Float64[np.ndarray, "rows 3"]
    check: Bool[np.ndarray, " rows"]
    alarmed: Bool[np.ndarray, " rows"]


@dataclass(frozen=True, eq=False)
class NextPose:
    """The pose to be measured next.

    Attributes:
        number: of the pose, which it keeps when the rest is planned again.
        count: largest number of a pose so far.
        q: joint values [rad or m].
        check: whether it judges the calibration.
        commanded: the same as the controller counts, where its values are others.
    """

    number: int
    count: int
    q: Float64[np.ndarray, " dof"]
    check: bool
    commanded: Float64[np.ndarray, " axes"] | None = None

    @property
    def values(self) -> Float64[np.ndarray, " axes"]:
        """What the controller is to show [rad or m]."""
        return self.q if self.commanded is None else self.commanded


@dataclass(frozen=True)
class JointSpan:
    """The values at which a joint was measured.

    Attributes:
        name: of the joint.
        lower: smallest value measured [rad or m].
        upper: largest value measured [rad or m].
        planned: width that was measured over the width that the plan has; 1 where both are the same.
    """

    name: str
    lower: float
    upper: float
    planned: float


@dataclass(frozen=True)
class AccuracyPoint:
    """How accurately a calibration with so many poses places the tool over the task [m]; NaN where that is unknown.

    Attributes:
        poses: number of poses calibrated with.
        predicted_rms: root mean square, from the posterior.
        predicted_p95: what 95 % of the poses stay below, from the posterior.
        cross_validated_rms: root mean square of the errors of left-out rows, which hold the noise of the sensor too.
        cross_validated_p95: what 95 % of them stay below.
        checked_rms: root mean square of the errors of the poses that check the calibration, likewise with noise.
        checked_p95: what 95 % of them stay below.
        random_rms: predicted root mean square of as many poses drawn at random.
    """

    poses: int
    predicted_rms: float
    predicted_p95: float
    cross_validated_rms: float = math.nan
    cross_validated_p95: float = math.nan
    checked_rms: float = math.nan
    checked_p95: float = math.nan
    random_rms: float = math.nan

    def to_json(self) -> dict[str, float | int | None]:
        """Return the figures [mm] as plain values, None for those that are unknown."""
        lengths = {f"{name}_mm": value * 1e3 for name, value in asdict(self).items() if name != "poses"}
        return {"poses": self.poses, **{name: _number(value) for name, value in lengths.items()}}


@dataclass(frozen=True)
class Advice:
    """Whether to go on.

    Attributes:
        action: "measure" the next pose; "repeat" a pose; "correct" what is wrong with all rows; "stop".
        sentence: why.
    """

    action: Literal["measure", "repeat", "correct", "stop"]
    sentence: str


@dataclass(frozen=True, eq=False)
class SessionState:
    """A measuring session after some rows.

    Attributes:
        rows: all rows that were read.
        alarms: what is wrong with which of them, in the order of the file.
        next_pose: the pose to be measured next; None where the plan is done.
        remaining: joint values of all poses that are left, the next one first [rad or m].
        coverage: what was measured of every joint.
        reached: accuracy so far, a point for each time that it was worked out, the last one holds.
        expected: accuracy that the poses that are left would bring.
        advice: whether to go on.
        revolute: per axis of the controller, whether it turns (values in rad) or slides (in m).
        base: `T_sensor_base`, where the robot's base is in the frame of the sensor [m]; None as long as it is unknown.
    """

    rows: RowsSoFar
    alarms: tuple[Alarm, ...]
    next_pose: NextPose | None
    remaining: Float64[np.ndarray, "poses dof"]
    coverage: tuple[JointSpan, ...]
    reached: tuple[AccuracyPoint, ...]
    expected: tuple[AccuracyPoint, ...]
    advice: Advice
    revolute: tuple[bool, ...]
    base: Float64[np.ndarray, "4 4"] | None = None

    @property
    def accuracy(self) -> AccuracyPoint | None:
        """Accuracy so far; None as long as it could not be worked out."""
        return self.reached[-1] if self.reached else None

    def to_json(self) -> dict[str, object]:
        """Return the figures as plain values: the result of `pisigma measure --json`; None for what is unknown."""
        counting = ~self.rows.alarmed
        sizes = np.linalg.norm(self.rows.error, axis=1) * 1e3
        following = self.next_pose
        return {
            "rows": len(self.rows.line),
            "rows_counting": int(counting.sum()),
            "check_rows": int((self.rows.check & counting).sum()),
            "errors_mm": [_number(size) for size in sizes.tolist()],
            "alarms": [asdict(alarm) for alarm in self.alarms],
            "poses_left": len(self.remaining),
            "next_pose": None
            if following is None
            else {
                "number": following.number,
                "of": following.count,
                "set": "test" if following.check else "train",
                "joints": self.in_file_units(following.values),
            },
            "coverage": [
                {"joint": span.name, "lower": lower, "upper": upper, "share_of_plan": span.planned}
                for span, lower, upper in zip(
                    self.coverage,
                    self.in_file_units([span.lower for span in self.coverage]),
                    self.in_file_units([span.upper for span in self.coverage]),
                    strict=True,
                )
            ],
            "accuracy": None if self.accuracy is None else self.accuracy.to_json(),
            "curve": [point.to_json() for point in (*self.reached, *self.expected)],
            "action": self.advice.action,
            "advice": self.advice.sentence,
        }

    def in_file_units(self, q: Iterable[float]) -> list[float]:
        """The controller's values in deg, or mm of joints that slide; of any number of the first joints."""
        return [
            float(np.rad2deg(value) if turns else value * 1e3)
            for value, turns in zip(q, self.revolute, strict=False)
        ]

    @property
    def finished(self) -> bool:
        """Whether more poses would not help, or none are left."""
        return self.advice.action == "stop"


def _number(value: float) -> float | None:
    """A number for JSON, which has no NaN."""
    return value if math.isfinite(value) else None


def coverage(
    robot: Robot, measured: Float64[Tensor, "rows dof"], planned: Float64[Tensor, "poses dof"]
) -> tuple[JointSpan, ...]:
    """Compare the range in which every joint was measured with that of the plan; nothing of no rows.

    Args:
        robot: as drawn.
        measured: joint values of the rows that count [rad or m].
        planned: joint values of all poses that were planned [rad or m].
    """
    if not len(measured):
        return ()
    lower, upper = robot.to_controller(measured).aminmax(dim=0)
    every = robot.to_controller(planned)
    width = every.amax(0) - every.amin(0)
    return tuple(
        JointSpan(joint.name, low, high, min(1.0, (high - low) / max(most, 1e-9)))
        for joint, low, high, most in zip(
            robot.axes, lower.tolist(), upper.tolist(), width.tolist(), strict=True
        )
    )
