"""Task of a plan: joint values or tool poses at which the robot must be accurate."""

import os
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.files.errors import Place, PlanningError
from pisigma.measurement.csv.columns import find_column
from pisigma.measurement.csv.poses import read_poses
from pisigma.measurement.csv.reading import read_joints
from pisigma.measurement.csv.table import read_table
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.inverse.corrected_ik import CorrectedIK
from pisigma.planning.plan_settings import PlanSettings
from pisigma.planning.surroundings.arm_in_surroundings import ArmInSurroundings
from pisigma.robot import Robot
from pisigma.robot.kinematics.status import Status
from pisigma.robot.kinematics.tolerances import LIMIT_TOLERANCE

REACHED = (Status.REACHED, Status.OUTSIDE_DOMAIN)
"""Statuses of poses whose joint values can be used."""
TASK_POSES = 300
"""Number of joint vectors that represent the task if more, or none, are stated."""
_STARTS = 200
"""Number of joint vectors at which a numeric inverse kinematics starts."""


def task_joint_values(
    arm: ArmInSurroundings,
    settings: PlanSettings,
    q: Float64[Tensor, "poses dof"],
    model: CalibratedModel | None = None,
) -> Float64[Tensor, "tasks dof"]:
    """Return the joint values [rad or m] of the task, from the task file or else from the workspace.

    Args:
        arm: the robot in its surroundings.
        settings: settings that name the task file.
        q: joint values of the workspace [rad or m].
        model: model of the robot, if any.

    Raises:
        MeasurementError: the file cannot be used; the message names file, line and column.
        PlanningError: a pose cannot be reached; the message names its line.
    """
    if settings.task is not None:
        nominal = CalibratedModel(arm.nominal.name, "nominal", arm.nominal, None, None, (), q[:_STARTS])
        q = read_task(settings.task, model or nominal)
    return q[torch.linspace(0, len(q) - 1, min(len(q), TASK_POSES)).round().long()]


def read_task(path: str | os.PathLike[str], model: CalibratedModel) -> Float64[Tensor, "tasks dof"]:
    """Return the joint values [rad or m] in a file, or those that reach its poses, by inverse kinematics.

    Args:
        path: CSV file with columns of joint values, or of poses (see `read_poses`).
        model: model of the robot; poses are of its tool in its base frame.

    Raises:
        MeasurementError: the file cannot be used; the message names file, line and column.
        PlanningError: a pose cannot be reached, or a joint value is outside its limits; the message names the line.
    """
    table = read_table(path)
    if any(column.joint for name in table.header if (column := find_column(name))):
        q = read_joints(path, model.robot)
        _refuse_outside(model.robot, q, [Place(path, line) for line in table.lines])
        return q
    poses = read_poses(path)
    solution = CorrectedIK(model)(poses.T)
    for line, status in zip(poses.line, map(Status, solution.status.tolist()), strict=True):
        if status not in REACHED:
            raise PlanningError(
                f"the status of the pose is {status.name}: {status.sentence.rstrip('.')}",
                value=status.name,
                at=Place(path, line),
            )
    reached: Tensor = model.robot.to_dh(torch.as_tensor(solution.q))
    return reached


def _refuse_outside(robot: Robot, q: Float64[Tensor, "tasks dof"], places: Sequence[Place]) -> None:
    """Refuse joint values [rad or m] outside the joint limits.

    Raises:
        PlanningError: a joint value is outside its limits.
    """
    values, (lower, upper) = robot.to_controller(q).numpy(), robot.axis_limits.T
    outside = (values < lower - LIMIT_TOLERANCE) | (values > upper + LIMIT_TOLERANCE)
    for row, number in np.argwhere(outside)[:1].tolist():
        axis = robot.axes[number]
        value, low, high = (axis.in_file_unit(some) for some in (values[row, number], axis.lower, axis.upper))
        raise PlanningError(
            f"joint '{axis.name}' at {value:.6g} {axis.file_unit} is outside its limits {low:.6g} to {high:.6g} "
            f"{axis.file_unit}",
            value=axis.name,
            at=places[row],
            remedy=f"give joint values within the limits of robot '{robot.name}', and check their unit",
        )
