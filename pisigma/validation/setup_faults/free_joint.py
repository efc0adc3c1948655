"""A joint whose logged values are not those that it had: its values as the measurements show them."""

from dataclasses import replace

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.measurement.dataset import Measurements
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.jacobian import joint_jacobian
from pisigma.validation.held_out.frames.frame_fits import (
    MeasuredPoses,
    base_and_tool_step,
    best_base_and_tool,
    moved_base_and_tool,
)
from pisigma.validation.setup_faults.arm import PredictingArm
from pisigma.validation.setup_faults.cause import Cause

ROUNDS = 30
TRIED, HOPELESS = 8, 0.25
"""After so many rounds the search is given up where this share of the cost is left."""
SETTLED = 1e-3
"""The search ends when a step lowers the cost by less than this share."""
STILL = 1e-3
"""A joint that moves less [rad or m] is constant."""
EQUAL = 1e-6
"""Columns that differ by less [rad or m] are equal."""


def freed_joints(
    arm: PredictingArm, rows: Measurements, measured: MeasuredPoses
) -> list[tuple[Float64[Tensor, "rows dof"], Cause]]:
    """Find for every joint that turns the values that it must have had, the others being as logged.

    In turn, every row's value is the one that brings the tool nearest to what was measured there, in closed form: a
    target's position and axes move on circles about the joint's axis; then base and tool are fitted. Of positions two
    numbers a row are left to be explained, of poses five.

    Args:
        arm: with which is predicted.
        rows: rows with positions, of one frame and target.
        measured: their poses.
    """
    return [
        (_freed(arm, rows, measured, joint), _cause(arm.robot, rows.q, joint))
        for joint, revolute in enumerate(arm.robot.revolute)
        if revolute
    ]


def _freed(
    arm: PredictingArm, rows: Measurements, measured: MeasuredPoses, joint: int
) -> Float64[Tensor, "rows dof"]:
    """Find the values of one joint together with base and tool, by Levenberg and Marquardt's method."""
    q = rows.q.clone()
    if _copied(q, joint) is not None:
        q[:, joint] = q[:, joint].median()
    frames = best_base_and_tool(arm.poses(replace(rows, q=q)), measured)
    cost, damping = torch.tensor(torch.inf).double(), torch.tensor(1e-3).double()
    tried, first = (q, frames), cost
    for number in range(ROUNDS):
        turned, free = _turned(arm, rows, joint, tried[0], tried[1], measured)
        T = arm.poses(replace(rows, q=turned))
        error = measured.squares(tried[1][0] @ T @ tried[1][1]).sum()
        if error < cost:
            settled = bool(cost - error < SETTLED * cost)
            first = error if number == 0 else first
            q, frames, cost, damping = turned, tried[1], error, damping / 10
            here = T, free
            if settled:
                break
        else:
            damping = damping * 10
        if number >= TRIED and cost > HOPELESS * first:
            break
        step = base_and_tool_step(here[0], measured, *frames, damping, here[1])
        tried = q, moved_base_and_tool(*frames, step)
    return q


def _turned(
    arm: PredictingArm,
    rows: Measurements,
    joint: int,
    q: Float64[Tensor, "rows dof"],
    frames: tuple[Float64[Tensor, "4 4"], Float64[Tensor, "4 4"]],
    measured: MeasuredPoses,
) -> tuple[Float64[Tensor, "rows dof"], Float64[Tensor, "rows 6"]]:
    """Turn a joint so that the tool is nearest to every measured pose, in closed form.

    With `a` a vector of the tool from the joint's axis and `b` what was measured of it, both across the axis `z`, the
    angle is `atan2(Σ w z·(a × b), Σ w a·b)`, over the target's position and the columns of its rotation.

    Returns:
        The joint values, and the motion of the target by the joint: shift [m] and turn [rad] in the measuring frame.
    """
    base, tool = frames
    T = arm.poses(replace(rows, q=q))
    J = joint_jacobian(arm.robot, q)[1]
    axis = J[:, 3:, joint]
    foot = T[:, :3, 3] + torch.linalg.cross(axis, J[:, :3, joint])
    tip, R = T @ tool, base[:3, :3]
    position = (measured.position - base[:3, 3]) @ R
    pairs = [(tip[:, :3, 3] - foot, position - foot, torch.ones(len(q)).double())]
    weight = measured.has_rotation * measured.lever**2 / 2
    pairs += [(tip[:, :3, k], measured.rotation[:, :, k] @ R, weight) for k in range(3)]
    sine, cosine = torch.zeros(2, len(q)).double()
    for a, b, w in pairs:
        sine = sine + w * (axis * torch.linalg.cross(a, b)).sum(-1)
        cosine = cosine + w * ((a * b).sum(-1) - (axis * a).sum(-1) * (axis * b).sum(-1))
    turned = q.clone()
    turned[:, joint] += torch.atan2(sine, cosine)
    shift = torch.linalg.cross(axis, position - foot)
    return turned, torch.cat([shift @ R.mT, axis @ R.mT], 1)


def _copied(q: Float64[Tensor, "rows dof"], joint: int) -> int | None:
    """Find another joint whose column is the same."""
    same = (q - q[:, joint : joint + 1]).abs().amax(0) < EQUAL
    same[joint] = False
    return int(same.nonzero()[0, 0]) if bool(same.any()) else None


def _cause(robot: Robot, q: Float64[Tensor, "rows dof"], joint: int) -> Cause:
    name, other = f"joint {joint + 1}", _copied(q, joint)
    if float(q[:, joint].max() - q[:, joint].min()) < STILL:
        clause = f"{name} is logged as constant ({torch.rad2deg(q[0, joint]):.4g} deg in all rows), though it moved"
    elif other is not None:
        clause = f"the column of {name} holds the values of joint {other + 1}"
    else:
        clause = f"the values of {name} are not those that it had, while the other joints' are"
    return Cause("joint_values", clause, f"check what was logged for {name}", 3.0, (joint,))
