"""Robots as joint frames, independently of the DH convention of their rows, and poses to compare with the pendant."""

import math
import os
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from pisigma.robot.description import Robot
from pisigma.robot.row import FRAME_COLUMNS, Row, in_file_units
from pisigma.robot.urdf_chain import Chain, ChainJoint
from pisigma.robot.urdf_frames import Frame, frame_of, rotation, row_frame, translation, xyz_zyx_of
from pisigma.robot.urdf_rows import NEARLY_PARALLEL, rows_of_chain


def joint_origins(robot: Robot) -> tuple[list[Frame], Frame]:
    """Return the joint frames at zero, each in the preceding joint's frame, and the transform after the last joint.

    The frame of a joint is that of its row after `RotZ(theta) · Trans(0, 0, d)`. The joint moves about or along its z
    axis, in the opposite sense if its direction is -1. Base and tool are not included.
    """
    origins, behind = [], np.eye(4)
    for row, (theta, d, a, alpha, beta) in zip(robot.rows, robot.dh.tolist(), strict=True):
        behind = behind @ rotation(2, theta) @ translation(0.0, 0.0, d)
        if row.type != "fixed":
            origins.append(behind)
            behind = np.eye(4)
        behind = behind @ row_frame(0.0, 0.0, a, alpha, beta)
    return origins, behind


def robot_of_origins(
    similar_robot: Robot, origins: list[Frame], end: Frame, nearly_parallel_sine: float = NEARLY_PARALLEL
) -> Robot:
    """Return a robot with the given joint frames, and with base, tool, names and limits of another robot.

    Args:
        similar_robot: the other robot, with the same number of joints.
        origins: joint frames as returned by `joint_origins`.
        end: transform from the last joint to the frame to which the tool is attached.
        nearly_parallel_sine: see `rows_of_chain`.

    Returns:
        A robot with one row per joint, in DH parameters or, between nearly parallel axes, Hayati parameters.
    """
    joints = tuple(
        ChainJoint(
            row.name,
            "prismatic" if row.type == "prismatic" else "revolute",
            origin,
            np.array([0.0, 0.0, row.direction]),
            row.lower,
            row.upper,
        )
        for row, origin in zip(similar_robot.joints, origins, strict=True)
    )
    fields = rows_of_chain(Chain(similar_robot.name, "", "", joints, end, ""), nearly_parallel_sine).fields
    moved = replace(similar_robot, rows=similar_robot.joints, dh=fields.dh, urdf=None)
    base, tool = (
        frame_of(similar_robot.base) @ frame_of(fields.base),
        frame_of(fields.tool) @ frame_of(similar_robot.tool),
    )
    return moved.with_geometry(base=xyz_zyx_of(base), tool=xyz_zyx_of(tool))


def with_one_row_per_joint(robot: Robot) -> Robot:
    """Return an equivalent robot with one row per joint, and Hayati parameters for nearly parallel axes."""
    return robot_of_origins(robot, *joint_origins(robot))


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
        is_within_limits: whether all controller values are within the limits.
    """

    axis: Row | None
    value: float
    tool: Float64[np.ndarray, " 6"]
    is_within_limits: bool

    @property
    def axis_value_in_file_unit(self) -> float:
        """Controller value of the moved axis [deg or mm]."""
        return 0.0 if self.axis is None else self.axis.in_file_unit(self.value)

    @property
    def tool_in_file_units(self) -> dict[str, float]:
        """Pose of the tool by column name [mm, deg]."""
        return in_file_units(FRAME_COLUMNS, self.tool)

    def to_json(self) -> dict[str, object]:
        """Return the pose as plain values for JSON."""
        unit = "deg" if self.axis is None else self.axis.file_unit
        moved: dict[str, object] = {
            "axis": self.axis and self.axis.name,
            f"value_{unit}": self.axis_value_in_file_unit,
        }
        return moved | self.tool_in_file_units | {"within_limits": self.is_within_limits}


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
        PendantPose(axis, float(value), xyz_zyx_of(_tool(nominal, joints)), bool(allowed))
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
