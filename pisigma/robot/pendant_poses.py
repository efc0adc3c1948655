"""Tool poses with one axis moved at a time, to compare a robot description with the teach pendant."""

import math
import os
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from pisigma.robot.description import Robot
from pisigma.robot.row import FRAME_COLUMNS, Row, in_file_units
from pisigma.robot.urdf_frames import Frame, frame_of, row_frame, xyzrpy_of

_ROTATION, _STROKE = math.pi / 2, 0.1
"""Values to which a revolute axis [rad] and a prismatic axis [m] are moved."""


@dataclass(frozen=True, eq=False)
class PendantPose:
    """The pose of the tool with one axis moved and all others at 0.

    Attributes:
        axis: axis that is moved; None if all are at 0.
        value: the controller's value of that axis [rad or m].
        tool: pose of the tool in the base frame: x, y, z [m], roll, pitch, yaw [rad] of
            `Trans(x, y, z) · RotZ(roll) · RotY(pitch) · RotX(yaw)`.
        inside: whether all controller values are within the limits.
    """

    axis: Row | None
    value: float
    tool: Float64[np.ndarray, " 6"]
    inside: bool

    @property
    def in_file_unit(self) -> float:
        """Controller value of the moved axis [deg or mm]."""
        return 0.0 if self.axis is None else self.axis.in_file_unit(self.value)

    @property
    def tool_in_file_units(self) -> dict[str, float]:
        """Pose of the tool by column name [mm, deg]."""
        return in_file_units(FRAME_COLUMNS, self.tool)

    def to_json(self) -> dict[str, object]:
        """Return the pose as plain values for JSON."""
        unit = "deg" if self.axis is None else self.axis.file_unit
        moved: dict[str, object] = {"axis": self.axis and self.axis.name, f"value_{unit}": self.in_file_unit}
        return moved | self.tool_in_file_units | {"within_limits": self.inside}


def pendant_poses(
    robot: Robot | str | os.PathLike[str], base: str | None = None, tip: str | None = None
) -> tuple[PendantPose, ...]:
    """Return the tool pose with all axes at 0, and with each axis at 90 deg (100 mm) or at its nearest limit.

    Args:
        robot: a robot, a name of the catalogue, or a robot file (YAML or URDF).
        base: base link of a URDF file; poses are in its frame.
        tip: tool link of a URDF file.

    Raises:
        RobotError: the robot cannot be read.
    """
    nominal = robot if isinstance(robot, Robot) else Robot.load(robot, base, tip)
    count, (lower, upper) = len(nominal.axes), nominal.axis_limits.T
    values = np.zeros((count + 1, count))
    for index, axis in enumerate(nominal.axes):
        step = _ROTATION if axis.type == "revolute" else _STROKE
        ends = min(step, upper[index]), max(-step, lower[index])
        values[index + 1, index] = ends[0] if abs(ends[0]) >= abs(ends[1]) else ends[1]
    inside = ((values >= lower) & (values <= upper)).all(1)
    if nominal.coupling is not None:
        inside &= nominal.coupling.is_within_limits(nominal.coupling.to_dh(values))
    moved = zip(
        (None, *nominal.axes), (0.0, *values[1:].diagonal()), nominal.to_dh(values), inside, strict=True
    )
    return tuple(
        PendantPose(axis, float(value), xyzrpy_of(_tool(nominal, joints)), bool(allowed))
        for axis, value, joints, allowed in moved
    )


def _tool(robot: Robot, q: Float64[np.ndarray, " dof"]) -> Frame:
    """Return T_base_tool at joint values [rad or m]."""
    T: Frame = frame_of(robot.base)
    values = iter(q.tolist())
    for row, (theta, d, a, alpha, beta) in zip(robot.rows, robot.dh.tolist(), strict=True):
        value = 0.0 if row.type == "fixed" else row.direction * next(values)
        turned, slid = (value, 0.0) if row.type == "revolute" else (0.0, value)
        T = T @ row_frame(theta + turned, d + slid, a, alpha, beta)
    T = T @ frame_of(robot.tool)
    return T
