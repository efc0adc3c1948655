"""Convert a chain of joints with arbitrary axes to DH and Hayati rows with the same forward kinematics.

Every joint gets a frame whose z axis is the joint's axis. A row
`RotZ(theta) · Trans(a, 0, d) · RotX(alpha) · RotY(beta)` leads from one frame to the next. It has one parameter more
than two lines need, so beta is 0 (Denavit and Hartenberg 1955), unless the axes are nearly parallel; then d is 0
(Hayati and Mirmirani 1985), because the common normal of nearly parallel lines is ill-conditioned.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from pisigma.robot.coupling_section import CoupledJointSection, rows_and_coupling
from pisigma.robot.right_angles import ROUNDING, snap_right_angle
from pisigma.robot.robot_fields import RobotFields
from pisigma.robot.row import Row
from pisigma.robot.urdf_chain import Chain, ChainJoint
from pisigma.robot.urdf_frames import (
    Frame,
    inverse,
    rotation,
    row_frame,
    xyz_zyx_of,
    zero_if_rounding,
)

NEARLY_PARALLEL = 0.1
"""Sine of the angle between two axes below which Hayati's row is used; DH rows then have common normals at most ten
times as far away as the joints."""

Vector = Float64[np.ndarray, " 3"]
Parameters = tuple[float, float, float, float, float]


@dataclass(frozen=True, eq=False)
class ChainRows:
    """A chain converted to rows, with the frames of the rows in the frames of its joints.

    Attributes:
        fields: rows, base, tool and names.
        T_joint_row: for every joint, the frame of its row in the joint's frame; both share the axis and move together.
    """

    fields: RobotFields
    T_joint_row: tuple[Frame, ...]


URDF_SOURCE = "URDF file "
"""Prefix of the `source` of robots read from a URDF file, before the file name."""


def rows_of_chain(chain: Chain, nearly_parallel: float = NEARLY_PARALLEL) -> ChainRows:
    """Convert a chain to DH and Hayati rows, base and tool, with the same forward kinematics up to rounding.

    Joint values have the sign of the file. If the largest component of an axis is negative, its row has direction -1.
    The last row includes the transform to the tip if the tip is on its axis; otherwise the tool does.

    Args:
        chain: the chain.
        nearly_parallel: sine of the angle between two axes below which Hayati's row is used.
    """
    joints = chain.joints
    axes = [_direction(joint) * joint.axis for joint in joints]
    frame, dh = _first_frame(joints[0], axes[0]), []
    frames = [inverse(joints[0].origin) @ frame]
    for i in range(len(joints) - 1):
        T_row_next = inverse(frames[i]) @ joints[i + 1].origin
        point = _point_of_axis(joints, axes, i + 1, T_row_next)
        parameters = _row_to(T_row_next[:3, :3] @ axes[i + 1], point, nearly_parallel)
        dh.append(parameters)
        frames.append(inverse(T_row_next) @ row_frame(*parameters))
    T_row_tip = inverse(frames[-1]) @ chain.end
    dh.append(_last_row(T_row_tip))
    rows = [
        Row(j.name, j.type, _direction(j), j.lower, j.upper, _urdf_origin(frame))
        for j, frame in zip(joints, frames, strict=True)
    ]
    coupled_rows, coupling = rows_and_coupling(rows, _mimics(joints, rows))
    fields = RobotFields(
        name=chain.name,
        maker="not stated",
        source=f"{URDF_SOURCE}{Path(chain.source).name}, from link '{chain.base}' to link '{chain.tip}'",
        rows=coupled_rows,
        dh=np.array(dh),
        base=xyz_zyx_of(frame),
        tool=xyz_zyx_of(inverse(row_frame(*dh[-1])) @ T_row_tip),
        coupling=coupling,
        urdf=chain.content,
    )
    return ChainRows(fields, tuple(frames))


def _mimics(joints: tuple[ChainJoint, ...], rows: list[Row]) -> list[CoupledJointSection]:
    """Return the coupling sections of a robot file that are equivalent to the mimic joints."""
    by_name = {row.name: row for row in rows}
    sections = []
    for joint, row in zip(joints, rows, strict=True):
        if joint.mimic is not None:
            name, multiplier, offset = joint.mimic
            other = by_name[name]
            if other.type != row.type:
                multiplier *= row.in_file_unit(1.0) * other.from_file_unit(1.0)
            stated = {f"offset_{row.file_unit}": row.in_file_unit(offset)}
            sections.append(CoupledJointSection(joint=row.name, factors={name: multiplier}, **stated))
    return sections


def _urdf_origin(frame: Frame) -> tuple[float, float, float]:
    """Return the position of a joint's origin [m] in the frame of its row; `frame` is the inverse pose."""
    x, y, z = (zero_if_rounding(value) for value in inverse(frame)[:3, 3])
    return x, y, z


def _direction(joint: ChainJoint) -> int:
    return 1 if joint.axis[np.argmax(np.abs(joint.axis))] > 0 else -1


def _first_frame(joint: ChainJoint, axis: Vector) -> Frame:
    """Return the frame of the first row in the base link: the base link itself if the axis is its z axis."""
    z, point = joint.origin[:3, :3] @ axis, joint.origin[:3, 3]
    upright = math.hypot(z[0], z[1]) <= ROUNDING
    if upright and (joint.type == "prismatic" or math.hypot(point[0], point[1]) <= ROUNDING):
        return np.eye(4) if z[2] > 0 else rotation(0, math.pi)
    T: Frame = joint.origin @ rotation_from_z_to(axis)
    return T


def rotation_from_z_to(axis: Vector) -> Frame:
    """Return a rotation about y and then x that maps the z axis to a given one."""
    x, y, z = (float(value) for value in axis)
    about_x, about_y = math.atan2(-y, z), math.atan2(x, math.hypot(y, z))
    T: Frame = rotation(0, snap_right_angle(about_x)) @ rotation(1, snap_right_angle(about_y))
    return T


def _point_of_axis(joints: tuple[ChainJoint, ...], axes: list[Vector], index: int, T: Frame) -> Vector:
    """Return a point on a joint's axis, in the frame of the preceding row.

    The motion of a prismatic joint depends on the direction of its axis only. The axis is therefore placed on that of
    the next joint if they are parallel, otherwise through the origin of the preceding row.

    Args:
        joints: all joints.
        axes: all axes, in the frames of the joints.
        index: index of the joint.
        T: frame of the joint at joint value 0, in the frame of the preceding row.
    """
    point: Vector = T[:3, 3]
    if joints[index].type == "revolute":
        return point
    if index + 1 < len(joints) and joints[index + 1].type == "revolute":
        following = joints[index + 1].origin
        sine = np.linalg.norm(np.cross(axes[index], following[:3, :3] @ axes[index + 1]))
        if sine < NEARLY_PARALLEL:
            joined: Vector = (T @ following)[:3, 3]
            return joined
    return np.zeros(3)


def _row_to(z: Vector, point: Vector, nearly_parallel: float) -> Parameters:
    """Return the row that leads from the z axis to a line, given by its direction and a point in the row's frame."""
    sine = math.hypot(z[0], z[1])
    if sine < nearly_parallel:
        foot = point - point[2] / z[2] * z
        a = zero_if_rounding(math.hypot(foot[0], foot[1]))
        theta, d = (math.atan2(foot[1], foot[0]) if a else 0.0), 0.0
    else:
        normal = np.array([-z[1], z[0]]) / sine
        a = zero_if_rounding(float(normal @ point[:2]))
        if a < 0 or (a == 0 and (normal[0] < -ROUNDING or (normal[0] <= ROUNDING and normal[1] < 0))):
            normal, a = -normal, abs(a)
        theta = math.atan2(normal[1], normal[0])
        d = zero_if_rounding(point[2] - (z[0] * point[0] + z[1] * point[1]) / sine**2 * z[2])
    theta = snap_right_angle(theta)
    x, y, up = rotation(2, -theta)[:3, :3] @ z
    beta = snap_right_angle(math.atan2(x, math.hypot(y, up))) if sine < nearly_parallel else 0.0
    return theta, d, a, snap_right_angle(math.atan2(-y, up)), beta


def _last_row(T_row_tip: Frame) -> Parameters:
    """Return the row that leads to the tip if the tip is on the last axis, otherwise an empty row."""
    off_axis = max(math.hypot(*T_row_tip[:2, 2]), math.hypot(*T_row_tip[:2, 3]))
    if off_axis > ROUNDING:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    theta = snap_right_angle(math.atan2(T_row_tip[1, 0], T_row_tip[0, 0]))
    return theta, zero_if_rounding(T_row_tip[2, 3]), 0.0, 0.0 if T_row_tip[2, 2] > 0 else math.pi, 0.0
