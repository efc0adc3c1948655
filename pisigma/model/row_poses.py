"""Poses that a model predicts for measured rows, each of the row's target in the row's frame."""

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.files.errors import MeasurementError, nearest_choice
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.hybrid_motion import corrected_joints
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import invert, transform_from_xyzrpy

Frames = dict[str, Float64[np.ndarray, " 6"]]
"""Bases per frame or tools per target: x, y, z [m], roll, pitch, yaw [rad]."""


def poses_of_rows(model: CalibratedModel, measurements: Measurements) -> Float64[Tensor, "rows 4 4"]:
    """Where a model of any kind says that the targets were, each in the frame of its row.

    NaN where the model predicts nothing; see `CalibratedModel.forward`. Under the conditions (payload, temperature)
    of the rows, where a hybrid knows of them; `CalibratedModel.forward` is under the usual ones.

    Raises:
        MeasurementError: the model does not know a frame or target of the rows.
        PoseError: the joint values do not fit the robot.
    """
    arm = model.hybrid
    if arm is None:
        return _seen(model.forward(measurements.q), model.robot, model.bases, model.tools, measurements)
    model.robot.check_joint_count(measurements.q.shape[-1])
    T = forward_kinematics(arm.robot, corrected_joints(arm, measurements))
    return _seen(T, arm.robot, model.hybrid_bases, model.hybrid_tools, measurements)


def nominal_poses_of_rows(model: CalibratedModel, measurements: Measurements) -> Float64[Tensor, "rows 4 4"]:
    """The same for the model's robot without any correction, its bases and tools as fitted.

    For errors see `poses_of_rows`.
    """
    T = forward_kinematics(model.robot, measurements.q)
    return _seen(T, model.robot, model.bases, model.tools, measurements)


def bases_of_rows(model: CalibratedModel, measurements: Measurements) -> Float64[Tensor, "#rows 4 4"]:
    """Where the robot's base stands in the frame of every row; for errors see `poses_of_rows`."""
    bases = _of_rows(model.bases, measurements.frame, "frame", measurements)
    return transform_from_xyzrpy(torch.from_numpy(model.robot.base[None].copy())) if bases is None else bases


def known_names(
    known: Frames, names: tuple[str, ...], what: str, measurements: Measurements
) -> tuple[str, ...]:
    """The frame or target of every row as the model calls it.

    A model that was fitted to rows without names takes rows of any one name, and one that was fitted to a
    single name takes rows without.

    Args:
        known: what the model knows.
        names: of the rows.
        what: "frame" or "target".
        measurements: the rows, for messages.

    Raises:
        MeasurementError: the model does not know a name.
    """
    if not set(known) - {""}:
        if len(set(names)) > 1:
            other = next(row for row, name in enumerate(names) if name != names[0])
            raise MeasurementError(
                f"{measurements.place(other)}: {what} '{names[other]}' stands there, but "
                f"{measurements.place(0)} has '{names[0]}', and the model knows one {what} only; give a file for each."
            )
        return ("",) * len(names)
    if len(known) == 1 and not any(names):
        return tuple(known) * len(names)
    for row, name in enumerate(names):
        if name not in known:
            crossed = (measurements.target if what == "frame" else measurements.frame)[row] in known
            hint = " (of a camera, check --fixed-camera)" if name and crossed else ""
            raise MeasurementError(
                f"{measurements.place(row)}: the model was not fitted to {what} '{name}'{hint}; "
                f"{nearest_choice(name, known)}"
            )
    return names


def _seen(
    T: Float64[Tensor, "rows 4 4"], robot: Robot, bases: Frames, tools: Frames, measurements: Measurements
) -> Float64[Tensor, "rows 4 4"]:
    """Poses T_base_tool as poses of the rows' targets in the rows' frames."""
    before = _of_rows(bases, measurements.frame, "frame", measurements)
    behind = _of_rows(tools, measurements.target, "target", measurements)
    if before is not None:
        T = before @ invert(transform_from_xyzrpy(torch.from_numpy(robot.base.copy()))) @ T
    if behind is not None:
        T = T @ invert(transform_from_xyzrpy(torch.from_numpy(robot.tool.copy()))) @ behind
    return T


def _of_rows(
    known: Frames, names: tuple[str, ...], what: str, measurements: Measurements
) -> Float64[Tensor, "rows 4 4"] | None:
    """The base or tool of every row; None where there is one only, which the robot has already."""
    names = known_names(known, names, what, measurements)
    if len(known) < 2:
        return None
    order = list(known)
    frames = transform_from_xyzrpy(torch.from_numpy(np.stack([known[name] for name in order])))
    return frames[torch.tensor([order.index(name) for name in names], dtype=torch.int64)]
