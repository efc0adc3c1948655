"""Convert robots to joint frames and back, independently of the DH convention of their rows."""

from dataclasses import replace

import numpy as np

from pisigma.robot.description import Robot
from pisigma.robot.urdf_chain import Chain, ChainJoint
from pisigma.robot.urdf_frames import Frame, frame_of, rotation, row_frame, translation, xyzrpy_of
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
    like: Robot, origins: list[Frame], end: Frame, nearly_parallel: float = NEARLY_PARALLEL
) -> Robot:
    """Return a robot with the given joint frames, and with base, tool, names and limits of another robot.

    Args:
        like: the other robot, with the same number of joints.
        origins: joint frames as returned by `joint_origins`.
        end: transform from the last joint to the frame to which the tool is attached.
        nearly_parallel: see `rows_of_chain`.

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
        for row, origin in zip(like.joints, origins, strict=True)
    )
    fields = rows_of_chain(Chain(like.name, "", "", joints, end, ""), nearly_parallel).fields
    moved = replace(like, rows=like.joints, dh=fields.dh, urdf=None)
    base, tool = frame_of(like.base) @ frame_of(fields.base), frame_of(fields.tool) @ frame_of(like.tool)
    return moved.with_geometry(base=xyzrpy_of(base), tool=xyzrpy_of(tool))


def with_one_row_per_joint(robot: Robot) -> Robot:
    """Return an equivalent robot with one row per joint, and Hayati parameters for nearly parallel axes."""
    return robot_of_origins(robot, *joint_origins(robot))
