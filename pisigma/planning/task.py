"""Where a robot is to be accurate: joint values, or poses of its tool, from a file."""

import os
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.files.errors import PlanningError
from pisigma.measurement.csv.columns import find_column
from pisigma.measurement.csv.poses import read_poses
from pisigma.measurement.csv.reading import read_joints
from pisigma.measurement.csv.table import read_table
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.inverse.corrected_ik import CorrectedIK
from pisigma.planning.plan_settings import PlanSettings
from pisigma.planning.surroundings.arm_in_cell import ArmInCell
from pisigma.robot import Robot
from pisigma.robot.kinematics.status import Status
from pisigma.robot.kinematics.tolerances import LIMIT_TOLERANCE

REACHED = (Status.REACHED, Status.OUTSIDE_DOMAIN)


TASK_POSES = 300
"""Joint values that stand for the task, where more are stated or none."""
STARTS = 200
"""Joint values that the inverse kinematics of a drawn robot without a closed form starts from."""


def task_poses(
    arm: ArmInCell,
    settings: PlanSettings,
    q: Float64[Tensor, "poses dof"],
    model: CalibratedModel | None = None,
) -> Float64[Tensor, "tasks dof"]:
    """Give joint values [rad or m] where the robot shall be accurate: of the task's file, or where it can be measured.

    Args:
        arm: the robot in its cell.
        settings: which name the file.
        q: joint values [rad or m] of the workspace.
        model: of the robot, where there is one.

    Raises:
        MeasurementError: the file cannot be used; the message names file, line and column.
        PlanningError: a pose cannot be reached; the message names its line.
    """
    if settings.task is not None:
        drawn = CalibratedModel(arm.drawn.name, "as drawn", arm.drawn, None, None, (), q[:STARTS])
        q = read_task(settings.task, model or drawn)
    return q[torch.linspace(0, len(q) - 1, min(len(q), TASK_POSES)).round().long()]


def read_task(path: str | os.PathLike[str], model: CalibratedModel) -> Float64[Tensor, "tasks dof"]:
    """Read joint values [rad or m], or poses that the inverse kinematics turns into joint values.

    Args:
        path: a CSV file with the columns of joint values, or of wanted poses (see `read_poses`).
        model: of the robot; poses are of its tool, in its base frame.

    Raises:
        MeasurementError: the file cannot be used; the message names file, line and column.
        PlanningError: a pose cannot be reached, or a joint value is outside its limits; the message names the line.
    """
    table = read_table(path)
    if any(column.joint for name in table.header if (column := find_column(name))):
        q = read_joints(path, model.robot)
        _refuse_outside(model.robot, q, [f"{path}, line {line}" for line in table.lines])
        return q
    poses = read_poses(path)
    solution = CorrectedIK(model)(poses.T)
    for line, status in zip(poses.line, map(Status, solution.status.tolist()), strict=True):
        if status not in REACHED:
            raise PlanningError(f"{path}, line {line}: {status.name.lower()}. {status.sentence}")
    reached: Tensor = model.robot.to_dh(torch.as_tensor(solution.q))
    return reached


def _refuse_outside(robot: Robot, q: Float64[Tensor, "tasks dof"], places: Sequence[str]) -> None:
    """Refuse joint values [rad or m] that the robot cannot have.

    Raises:
        PlanningError: one is outside its limits; the message names its place.
    """
    values, (lower, upper) = robot.to_controller(q).numpy(), robot.axis_limits.T
    outside = (values < lower - LIMIT_TOLERANCE) | (values > upper + LIMIT_TOLERANCE)
    for row, number in np.argwhere(outside)[:1].tolist():
        axis = robot.axes[number]
        value, low, high = (axis.in_file_unit(some) for some in (values[row, number], axis.lower, axis.upper))
        raise PlanningError(
            f"{places[row]}: joint '{axis.name}' at {value:.6g} {axis.file_unit} is outside its limits {low:.6g} to "
            f"{high:.6g} {axis.file_unit}; give joint values that robot '{robot.name}' can have, and check their unit."
        )
