"""Correct the joint values in LeRobot's observations and actions, from a policy or a data set."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float64

from pisigma.deployment.export.joint_offsets import JointOffsets, fit_joint_offsets
from pisigma.files.errors import MeasurementError, Phrase
from pisigma.files.model_files import DESCRIPTION, WEIGHTS, content_hash, read_model_file
from pisigma.measurement.foreign.lerobot_dataset import position_indices_of_motors
from pisigma.measurement.foreign.lerobot_motors import LeRobotUnits, Motor, radians_per_unit, read_motors
from pisigma.model.folder.model_folder import load_model
from pisigma.robot.description import Robot

if TYPE_CHECKING:
    from pisigma.model.calibrated_model import CalibratedModel

CHUNK = 10_000
"""Number of frames whose poses are computed at a time."""


@dataclass(frozen=True, eq=False)
class LeRobotCorrection:
    """Correction of frames of joint values in LeRobot's units.

    The real arm commanded to q is where the nominal arm is at q + offset. The offsets are those of `fit_joint_offsets`.
    Errors of lengths and of angles between the axes cannot be expressed in joint values and remain; `poses` takes them
    into account. Values that are not joints of the robot, such as the gripper's, are not changed.

    Attributes:
        model: calibrated model.
        units: units of the values.
        names: names of the values of a frame, in their order.
        joint_value_indices: index of the value of every joint of the robot in a frame.
        scale: rotation [rad] per unit of the value, for every joint.
        value_offsets: offset of every value of a frame [in its unit], 0 for values that are not joints.
        offsets: the joint offsets, with the deviation that they leave.
        prefix: prefix of the motor names of this arm, such as "left_".
        motors: motors in the arm's calibration file, by name; None if it is not known.
        version: name, SHA-256 and offsets of the model, as written to the metadata of data sets.
    """

    model: "CalibratedModel"
    units: LeRobotUnits
    names: tuple[str, ...]
    joint_value_indices: tuple[int, ...]
    scale: Float64[np.ndarray, " axes"]
    value_offsets: Float64[np.ndarray, " values"]
    offsets: JointOffsets
    prefix: str
    motors: Mapping[str, Motor] | None
    version: dict[str, Any]

    @staticmethod
    def load(
        model: str | os.PathLike[str],
        names: Sequence[str],
        units: LeRobotUnits,
        calibration: str | os.PathLike[str] | None = None,
        prefix: str = "",
    ) -> "LeRobotCorrection":
        """Load a model folder for frames with these values.

        Args:
            model: model folder, whose robot has LeRobot's names of joints.
            names: names of the values of a frame, such as "shoulder_pan.pos" or "shoulder_pan".
            units: "degrees" (LeRobot's `use_degrees=true`) or "normalized" (-100 to 100); the values do not show which
                applies.
            calibration: LeRobot's calibration file of this arm, needed for normalized values.
            prefix: prefix of the motor names of this arm, such as "left_" for one arm of a pair.

        Raises:
            ModelError: the folder is not a model.
            MeasurementError: the values are not those of the robot's joints, or their scale is unknown.
        """
        calibrated = load_model(model)
        robot = calibrated.robot
        joints = value_indices_of_axes(robot, names, prefix)
        motors = None if calibration is None else read_motors(calibration)
        scale = np.array([radians_per_unit(units, axis.name, motors) for axis in robot.axes])
        lost = fit_joint_offsets(calibrated)
        offset = np.zeros(len(names))
        offset[list(joints)] = lost.values / scale
        return LeRobotCorrection(
            calibrated,
            units,
            tuple(names),
            joints,
            scale,
            offset,
            lost,
            prefix,
            motors,
            _version(Path(model), robot, units, lost, motors),
        )

    def true_values(self, recorded_values: Any) -> Any:
        """Compute the joint values at which the nominal arm has the pose that the real arm had.

        Args:
            recorded_values: joint values as recorded or commanded: an array or tensor `(*batch, values)`, or a
                dictionary by name, such as an observation, whose other entries are kept.

        Returns:
            The same type, shape, dtype, device and order.

        Raises:
            MeasurementError: the last axis does not have one value per name, or a name is missing.
        """
        return self._moved(recorded_values, self.value_offsets)

    def commands(self, true_values: Any) -> Any:
        """Compute the joint values to command for true joint values; the inverse of `true_values`.

        LeRobot limits normalized values to -100 to 100 when it sends them, so an arm stops there.
        """
        return self._moved(true_values, -self.value_offsets)

    def joint_values(self, recorded_values: Any) -> Float64[np.ndarray, "*batch axes"]:
        """Convert frames `(*batch, values)` to the robot's joint values [rad]."""
        array = self._checked(np.asarray(recorded_values, dtype=np.float64))
        values: np.ndarray = array[..., list(self.joint_value_indices)] * self.scale
        return values

    def poses(self, recorded_values: Any) -> Float64[np.ndarray, "*batch 4 4"]:
        """Compute the poses T_base_tool [m] that the whole model predicts for recorded frames `(*batch, values)`."""
        q = self.joint_values(recorded_values)
        flat = torch.from_numpy(q.reshape(-1, q.shape[-1]))
        T = (
            torch.cat([self.model.forward(some) for some in torch.split(flat, CHUNK)])
            if len(flat)
            else flat[:, :0]
        )
        return T.numpy().reshape(*q.shape[:-1], 4, 4)

    def _moved(self, frames: Any, offset: Float64[np.ndarray, " values"]) -> Any:
        if isinstance(frames, Mapping):
            return self._moved_by_name(frames, offset)
        return _sum(self._checked(frames if isinstance(frames, torch.Tensor) else np.asarray(frames)), offset)

    def _moved_by_name(
        self, frame: Mapping[str, Any], offset: Float64[np.ndarray, " values"]
    ) -> dict[str, Any]:
        """Return a dictionary with the offsets added to the values; all entries keep their order."""
        if missing := [
            self.names[index] for index in self.joint_value_indices if self.names[index] not in frame
        ]:
            raise MeasurementError(
                expected=f"the values {', '.join(self.names[index] for index in self.joint_value_indices)}",
                value=Phrase(", ".join(frame)),
                remedy=f"add {missing[0]}",
            )
        moved = {self.names[index] for index in self.joint_value_indices}
        by_name = dict(zip(self.names, offset, strict=True))
        return {
            name: _sum(_checked_type(value, name), by_name[name]) if name in moved else value
            for name, value in frame.items()
        }

    def _checked(self, frames: Any) -> Any:
        """Return frames of numbers with one value per name.

        Raises:
            MeasurementError: the frames have a different number of values, or are integers.
        """
        if not frames.ndim or frames.shape[-1] != len(self.names):
            raise MeasurementError(
                expected=f"frames of {len(self.names)} values ({', '.join(self.names)})",
                value=str(tuple(frames.shape)),
                option="frames",
            )
        return _checked_type(frames, "frames")


def _sum(values: Any, offset: Any) -> Any:
    """Return values plus an offset, computed with 64 bits, in the type of the values."""
    if isinstance(values, torch.Tensor):
        return (values.double() + torch.as_tensor(offset, device=values.device)).to(values.dtype)
    return float(values + offset) if type(values) is float else (values + offset).astype(values.dtype)


def _checked_type(values: Any, what: str) -> Any:
    """Return values after checking that they are a float, or an array or a tensor of floats.

    Raises:
        MeasurementError: the values have another type; integers would truncate an offset.
    """
    dtype = getattr(values, "dtype", type(values))
    if not (dtype.is_floating_point if isinstance(dtype, torch.dtype) else np.issubdtype(dtype, np.floating)):
        raise MeasurementError(
            expected="floating-point values", value=str(dtype), option=what, remedy="convert the values"
        )
    return values


def value_indices_of_axes(robot: Robot, names: Sequence[str], prefix: str) -> tuple[int, ...]:
    """Return the index of the value of every axis of the robot's controller.

    Raises:
        MeasurementError: the motors are not the joints of the robot, or a joint is prismatic.
    """
    axes = [axis.name for axis in robot.axes]
    motors = position_indices_of_motors(names, prefix)
    if sorted(motors) != sorted(axes) or any(axis.type != "revolute" for axis in robot.axes):
        raise MeasurementError(
            expected=f"one value for each of the revolute joints {', '.join(axes)} of robot '{robot.name}'",
            value=Phrase(", ".join(names)),
            option="names",
            remedy="give the joints of the robot the names of LeRobot's motors, or state the prefix of the arm",
        )
    return tuple(motors[axis] for axis in axes)


def _version(
    folder: Path, robot: Robot, units: LeRobotUnits, lost: JointOffsets, motors: Mapping[str, Motor] | None
) -> dict[str, Any]:
    """Return the data that identify the model and the correction, for metadata."""
    sha256 = content_hash(read_model_file(folder, DESCRIPTION), read_model_file(folder, WEIGHTS))
    degrees = np.rad2deg(lost.values).tolist()
    return {
        "pisigma": version("pisigma"),
        "model": folder.name,
        "sha256": sha256,
        "robot": robot.name,
        "units": units,
        "offsets_deg": dict(zip([axis.name for axis in robot.axes], degrees, strict=True)),
        "unobservable": list(lost.unobservable),
        **lost.departures(),
        **({} if motors is None else {"ranges": {n: [m.range_min, m.range_max] for n, m in motors.items()}}),
    }
