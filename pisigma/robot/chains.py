"""Robots as chains of joints and back, whatever rows they are written down with."""

from dataclasses import replace

import numpy as np

from pisigma.robot.description import Robot
from pisigma.robot.urdf_chain import Chain, ChainJoint
from pisigma.robot.urdf_frames import Frame, frame_of, row_frame, shift, turn, xyzrpy_of
from pisigma.robot.urdf_rows import NEARLY_PARALLEL, rows_of_chain


def joint_origins(robot: Robot) -> tuple[list[Frame], Frame]:
    """Frames of the joints at zero, each in that of the joint before, and what is behind the last one.

    A joint stands where its row has it after `RotZ(theta) · Trans(0, 0, d)` and turns about or slides along its z axis,
    against it where its direction is -1. Base and tool are left out.
    """
    origins, behind = [], np.eye(4)
    for row, (theta, d, a, alpha, beta) in zip(robot.rows, robot.dh.tolist(), strict=True):
        behind = behind @ turn(2, theta) @ shift(0.0, 0.0, d)
        if row.type != "fixed":
            origins.append(behind)
            behind = np.eye(4)
        behind = behind @ row_frame(0.0, 0.0, a, alpha, beta)
    return origins, behind


def robot_of_origins(
    like: Robot, origins: list[Frame], end: Frame, nearly_parallel: float = NEARLY_PARALLEL
) -> Robot:
    """The robot whose joints stand at these frames, with base, tool, names and limits of another.

    Args:
        like: the other robot, with as many joints that move.
        origins: as `joint_origins` gives them.
        end: what is behind the last joint, before the tool.
        nearly_parallel: see `rows_of_chain`.

    Returns:
        The robot with one row a joint, of DH parameters or, between nearly parallel axes, Hayati's.
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
    drawing = rows_of_chain(Chain(like.name, "", "", joints, end, ""), nearly_parallel).drawing
    moved = replace(like, rows=like.joints, dh=drawing.dh, urdf=None)
    base, tool = frame_of(like.base) @ frame_of(drawing.base), frame_of(drawing.tool) @ frame_of(like.tool)
    return moved.with_geometry(base=xyzrpy_of(base), tool=xyzrpy_of(tool))


def in_few_rows(robot: Robot) -> Robot:
    """The same robot with one row a joint and no length larger than it is: nearly parallel axes take Hayati's rows."""
    return robot_of_origins(robot, *joint_origins(robot))
