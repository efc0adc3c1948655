"""Predict poses of targets, in the frames of measurements."""

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.files.errors import IdentificationError, choice_remedy
from pisigma.measurement.dataset import Measurements
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import transform_from_xyz_zyx


def predicted_poses(
    robot: Robot,
    bases: dict[str, Float64[np.ndarray, " 6"]],
    tools: dict[str, Float64[np.ndarray, " 6"]],
    measurements: Measurements,
) -> Float64[Tensor, "rows 4 4"]:
    """Return predicted poses of the targets, each in the frame of its row [m].

    Args:
        robot: the robot; its base and tool are not used.
        bases: base in every frame: x, y, z [m], roll, pitch, yaw [rad].
        tools: tool of every target, in the same form.
        measurements: joint values, frames and targets.

    Raises:
        IdentificationError: a row has a frame or a target that was not calibrated.
        PoseError: the joint values do not fit the robot.
    """
    T_arm = forward_kinematics(robot.with_geometry(base=np.zeros(6), tool=np.zeros(6)), measurements.q)
    T_base = _of_rows(bases, measurements.frame, "frame", measurements)
    T_tool = _of_rows(tools, measurements.target, "target", measurements)
    return T_base @ T_arm @ T_tool


def _of_rows(
    frames: dict[str, Float64[np.ndarray, " 6"]],
    names: tuple[str, ...],
    what: str,
    measurements: Measurements,
) -> Float64[Tensor, "rows 4 4"]:
    order = tuple(frames)
    for name in dict.fromkeys(names):
        if name not in frames:
            row = names.index(name)
            raise IdentificationError(
                f"{what} '{name}' was not calibrated",
                value=name,
                at=measurements.place_of(row, what),
                remedy=choice_remedy(name, order),
            )
    T = transform_from_xyz_zyx(torch.from_numpy(np.stack([frames[name] for name in order])))
    index = torch.tensor([order.index(name) for name in names], dtype=torch.int64)
    return T[index].to(measurements.q.device)
