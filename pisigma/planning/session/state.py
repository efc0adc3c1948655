"""State of a measuring session, which terminals and pages show."""

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float64
from torch import Tensor

from pisigma.measurement.growing_file import FileGrowth
from pisigma.robot.description import Robot

AlarmKind = Literal["setup", "unreadable", "duplicate", "frozen", "swapped", "off", "pose", "cleared"]
"""Kind of an alarm. "setup": all rows have the same fault, such as a wrong unit. "unreadable": the row cannot be read.
"duplicate": the row equals another row. "frozen": the sensor shows an old value. "swapped": the values of two poses are
swapped. "off": the other rows contradict the value. "pose": the joint values are not those of a planned pose (a remark;
the row is used). "cleared": an alarm is withdrawn because later rows agree with the row.
"""


@dataclass(frozen=True)
class Alarm:
    """Alarm or remark about a row.

    Attributes:
        line: line of the row in the file.
        kind: kind of the alarm.
        sentence: what was expected, what was measured, and what to do.
        repeat: whether to measure the pose again.
        row_is_used: whether the row is used despite the alarm.
    """

    line: int
    kind: AlarmKind
    sentence: str
    repeat: bool
    row_is_used: bool = False

    def to_json(self) -> dict[str, object]:
        """Return the alarm as plain values."""
        return {
            "line": self.line,
            "kind": self.kind,
            "sentence": self.sentence,
            "repeat": self.repeat,
            "counts": self.row_is_used,
        }


@dataclass(frozen=True, eq=False)
class RowsSoFar:
    """All rows that were read, in the order of the file.

    Attributes:
        line: line of every row in the file.
        q: commanded joint values [rad or m].
        position: predicted position of the target in the robot's base frame [m]; NaN while base and tool are unknown.
        error: measured minus predicted position in the robot's base frame [m]; NaN for rows that cannot be checked.
        is_test_row: mask of the rows of the set "test", which test the calibration and are not used for it.
        is_unused: mask of the rows that are not used.
    """

    line: tuple[int, ...]
    q: Float64[np.ndarray, "rows dof"]
    position: Float64[np.ndarray, "rows 3"]
    error: Float64[np.ndarray, "rows 3"]
    is_test_row: Bool[np.ndarray, " rows"]
    is_unused: Bool[np.ndarray, " rows"]

    @staticmethod
    def unjudged(line: tuple[int, ...], q: Float64[np.ndarray, "rows dof"]) -> "RowsSoFar":
        """Return rows that have not been compared with each other."""
        unknown, no = np.full((len(line), 3), math.nan), np.zeros(len(line), dtype=bool)
        return RowsSoFar(line, q, unknown, unknown, no, no)


@dataclass(frozen=True, eq=False)
class NextPose:
    """The next pose to measure.

    Attributes:
        number: number of the pose, which does not change when the remaining poses are replanned.
        largest_pose_number: largest number of a pose so far.
        q: joint values [rad or m].
        is_test_pose: whether the pose tests the calibration.
        commanded: controller values [rad or m], if they differ from the joint values.
    """

    number: int
    largest_pose_number: int
    q: Float64[np.ndarray, " dof"]
    is_test_pose: bool
    commanded: Float64[np.ndarray, " axes"] | None = None

    @property
    def controller_values(self) -> Float64[np.ndarray, " axes"]:
        """Values to command at the controller [rad or m]."""
        return self.q if self.commanded is None else self.commanded


@dataclass(frozen=True)
class JointSpan:
    """Measured range of a joint.

    Attributes:
        name: name of the joint.
        lower: smallest measured value [rad or m].
        upper: largest measured value [rad or m].
        planned: ratio of the measured range to the planned range, at most 1.
    """

    name: str
    lower: float
    upper: float
    planned: float


@dataclass(frozen=True)
class AccuracyPoint:
    """Position error over the task after a number of poses [m]; NaN where a figure is unknown.

    Attributes:
        poses: number of poses used for the calibration.
        predicted_rms: root mean square predicted by the posterior.
        predicted_p95: 95 % quantile predicted by the posterior.
        cross_validated_rms: root mean square of the errors of held-out rows, which include the noise of the sensor.
        cross_validated_p95: 95 % quantile of these errors.
        checked_rms: root mean square of the errors of the test poses, which include the noise of the sensor.
        checked_p95: 95 % quantile of these errors.
        random_rms: predicted root mean square after the same number of random poses.
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
        """Return the figures [mm] as plain values; None for unknown ones."""
        lengths = {f"{name}_mm": value * 1e3 for name, value in asdict(self).items() if name != "poses"}
        return {"poses": self.poses, **{name: _number(value) for name, value in lengths.items()}}


@dataclass(frozen=True)
class Advice:
    """Advice on what to do next.

    Attributes:
        action: "measure" the next pose, "repeat" a pose, "correct" a fault that affects all rows, or "stop".
        sentence: the reason.
    """

    action: Literal["measure", "repeat", "correct", "stop"]
    sentence: str


@dataclass(frozen=True, eq=False)
class SessionState:
    """A measuring session after some rows.

    Attributes:
        rows: all rows that were read.
        alarms: alarms on rows, in the order of the file.
        next_pose: next pose to measure; None if the plan is finished.
        remaining: joint values of all remaining poses, beginning with the next [rad or m].
        coverage: measured range of every joint.
        reached_accuracy: accuracy so far, one point per computation; the last point is valid.
        expected_accuracy: expected accuracy after the remaining poses.
        advice: what to do next.
        revolute: whether each axis of the controller is revolute (values in rad) or prismatic (in m).
        base: `T_sensor_base`, pose of the robot's base in the frame of the sensor [m]; None while it is unknown.
    """

    rows: RowsSoFar
    alarms: tuple[Alarm, ...]
    next_pose: NextPose | None
    remaining: Float64[np.ndarray, "poses dof"]
    coverage: tuple[JointSpan, ...]
    reached_accuracy: tuple[AccuracyPoint, ...]
    expected_accuracy: tuple[AccuracyPoint, ...]
    advice: Advice
    revolute: tuple[bool, ...]
    base: Float64[np.ndarray, "4 4"] | None = None

    @property
    def accuracy(self) -> AccuracyPoint | None:
        """Accuracy so far; None while it cannot be computed."""
        return self.reached_accuracy[-1] if self.reached_accuracy else None

    def to_json(self) -> dict[str, object]:
        """Return the figures as plain values, the result of `pisigma measure --json`; None for unknown values."""
        counting = ~self.rows.is_unused
        sizes = np.linalg.norm(self.rows.error, axis=1) * 1e3
        following = self.next_pose
        return {
            "rows": len(self.rows.line),
            "rows_counting": int(counting.sum()),
            "check_rows": int((self.rows.is_test_row & counting).sum()),
            "errors_mm": [_number(size) for size in sizes.tolist()],
            "alarms": [alarm.to_json() for alarm in self.alarms],
            "poses_left": len(self.remaining),
            "next_pose": None
            if following is None
            else {
                "number": following.number,
                "count": following.largest_pose_number,
                "set": "test" if following.is_test_pose else "train",
                "joints": self.in_file_units(following.controller_values),
                "units": ["deg" if turns else "mm" for turns in self.revolute],
            },
            "coverage": [
                {
                    "joint": span.name,
                    "unit": "deg" if turns else "mm",
                    "lower": lower,
                    "upper": upper,
                    "share_of_plan": span.planned,
                }
                for span, turns, lower, upper in zip(
                    self.coverage,
                    self.revolute[: len(self.coverage)],
                    self.in_file_units([span.lower for span in self.coverage]),
                    self.in_file_units([span.upper for span in self.coverage]),
                    strict=True,
                )
            ],
            "accuracy": None if self.accuracy is None else self.accuracy.to_json(),
            "curve": [point.to_json() for point in (*self.reached_accuracy, *self.expected_accuracy)],
            "action": self.advice.action,
            "advice": self.advice.sentence,
        }

    def in_file_units(self, q: Iterable[float]) -> list[float]:
        """Convert values of the controller's first axes to deg, or mm for prismatic joints."""
        return [
            float(np.rad2deg(value) if turns else value * 1e3)
            for value, turns in zip(q, self.revolute, strict=False)
        ]

    @property
    def is_finished(self) -> bool:
        """Whether no poses remain, or whether more poses would not help."""
        return self.advice.action == "stop"


def _number(value: float) -> float | None:
    """Return a number for JSON, with None for NaN."""
    return value if math.isfinite(value) else None


def coverage(
    robot: Robot, measured: Float64[Tensor, "rows dof"], planned: Float64[Tensor, "poses dof"]
) -> tuple[JointSpan, ...]:
    """Return the measured range of every joint relative to the plan; empty if there are no rows.

    Args:
        robot: nominal robot.
        measured: joint values of the rows in use [rad or m].
        planned: joint values of all planned poses [rad or m].
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


@dataclass(frozen=True, eq=False)
class SessionStep:
    """News of a session.

    Attributes:
        growth: new rows of the file.
        alarms: faults of the new rows, or faults of earlier rows that the new rows reveal.
        state: state of the session.
        points: accuracies that were computed since the last step.
        replanned: whether the remaining poses differ from the planned poses or from those after the last step.
    """

    growth: FileGrowth
    alarms: tuple[Alarm, ...]
    state: SessionState
    points: tuple[AccuracyPoint, ...] = ()
    replanned: bool = False
