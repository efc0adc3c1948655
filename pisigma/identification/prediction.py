"""How far a robot is from measurements that it was not fitted to."""

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.errors import IdentificationError, nearest_choice
from pisigma.kinematics.forward import forward_kinematics
from pisigma.measurement.dataset import Measurements
from pisigma.robot.description import Robot
from pisigma.se3 import rotation_vector, transform_from_xyzrpy


def predicted_poses(
    robot: Robot,
    bases: dict[str, Float64[np.ndarray, " 6"]],
    tools: dict[str, Float64[np.ndarray, " 6"]],
    measurements: Measurements,
) -> Float64[Tensor, "rows 4 4"]:
    """Where a robot says that the targets were, each in the frame of its row.

    Args:
        robot: its rows are used, its base and tool are not.
        bases: per frame x, y, z [m], roll, pitch, yaw [rad].
        tools: the same per target.
        measurements: joint values, frames and targets.

    Raises:
        IdentificationError: a row has a frame or a target that is not known.
        PoseError: the joint values do not fit the robot.
    """
    T_arm = forward_kinematics(robot.with_geometry(base=np.zeros(6), tool=np.zeros(6)), measurements.q)
    T_base = _of_rows(bases, measurements.frame, "frame", measurements)
    T_tool = _of_rows(tools, measurements.target, "target", measurements)
    return T_base @ T_arm @ T_tool


def prediction_errors(
    robot: Robot,
    bases: dict[str, Float64[np.ndarray, " 6"]],
    tools: dict[str, Float64[np.ndarray, " 6"]],
    measurements: Measurements,
) -> dict[str, Float64[Tensor, "rows 3"]]:
    """Measured minus predicted, NaN where nothing was measured; see `predicted_poses`.

    Returns:
        "position" [m] and, where measured, "rotation" (rotation vectors [rad]), both in the frame of the row.
    """
    T = predicted_poses(robot, bases, tools, measurements)
    found = {}
    if measurements.position is not None:
        found["position"] = measurements.position - T[:, :3, 3]
    if measurements.rotation is not None:
        seen = torch.isfinite(measurements.rotation).flatten(1).all(-1)
        rotation = torch.where(seen[:, None, None], measurements.rotation, T[:, :3, :3])
        turn = rotation_vector(rotation @ T[:, :3, :3].mT)
        found["rotation"] = torch.where(seen[:, None], turn, torch.nan)
    return found


def _of_rows(
    known: dict[str, Float64[np.ndarray, " 6"]], names: tuple[str, ...], what: str, measurements: Measurements
) -> Float64[Tensor, "rows 4 4"]:
    order = tuple(known)
    for name in dict.fromkeys(names):
        if name not in known:
            row = names.index(name)
            raise IdentificationError(
                f"{measurements.place(row)}: {what} '{name}' was not calibrated; "
                f"{nearest_choice(name, order)}"
            )
    frames = transform_from_xyzrpy(torch.from_numpy(np.stack([known[name] for name in order])))
    index = torch.tensor([order.index(name) for name in names], dtype=torch.int64)
    return frames[index].to(measurements.q.device)
