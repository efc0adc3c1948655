"""DH parameters of Universal Robots, and their frames relative to the frames of a robot description."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64

from pisigma.deployment.export.approximation import ApproximationProblem, solve_approximation
from pisigma.deployment.export.controllers.controller_file import (
    ControllerFrames,
    ControllerRobot,
    check_plain_joints,
)
from pisigma.files.errors import RobotError
from pisigma.robot.chains import joint_origins, robot_of_origins
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.urdf_frames import Frame, frame_of, inverse, rotation, translation, xyz_zyx_of

JOINTS = 6
SOURCE = "universal-robots.com, DH parameters for calculations of kinematics and dynamics"
_D_AND_A = {
    "UR3": ((0.1519, 0.11235, 0.08535, 0.0819), (0.24365, 0.21325)),
    "UR3e": ((0.15185, 0.13105, 0.08535, 0.0921), (0.24355, 0.2132)),
    "UR5": ((0.089159, 0.10915, 0.09465, 0.0823), (0.425, 0.39225)),
    "UR5e": ((0.1625, 0.1333, 0.0997, 0.0996), (0.425, 0.3922)),
    "UR10": ((0.1273, 0.163941, 0.1157, 0.0922), (0.612, 0.5723)),
    "UR10e": ((0.1807, 0.17415, 0.11985, 0.11655), (0.6127, 0.57155)),
    "UR16e": ((0.1807, 0.17415, 0.11985, 0.11655), (0.4784, 0.36)),
    "UR20": ((0.2363, 0.2010, 0.1593, 0.1543), (0.8620, 0.7287)),
    "UR30": ((0.2363, 0.2010, 0.1593, 0.1543), (0.6370, 0.5037)),
}
"""d of joints 1, 4, 5 and 6, and minus a of joints 2 and 3 [m], by model.

The UR30 is from UniversalRobots/Universal_Robots_ROS2_Description, config/ur30/default_kinematics.yaml."""
_ALPHA = np.array([1.0, 0.0, 0.0, 1.0, -1.0, 0.0]) * np.pi / 2

_FARTHEST = 5e-3
"""Largest mean distance between tools [m] at which a description belongs to a model: factory calibrations move the tool
by 1 to 4 mm, and the models differ by 10 mm and more."""
_EXACT = 1e-9
_NEAR_ANGLE, _NEAR_LENGTH = np.deg2rad(0.5), 0.01
"""Distances of a calibrated robot's frames from right angles [rad] and from the origin [m] up to which the frames are
rounded to these."""
_POSES = 200
_TILTED = 1e-6
"""Sine of the angle between two axes below which they are treated as parallel; otherwise their common normal could be
1,000 km away, and rounding of such large numbers would move the tool."""


_DRIVER = "github.com/UniversalRobots/Universal_Robots_ROS_Driver"
_DEFAULTS = "github.com/ros-industrial/universal_robot, ur_description/config, default_kinematics.yaml"
_USERS = {
    "UR3": "a user's calibration.conf (github.com/MyRobotLab/pyrobotlab/issues/145)",
    "UR5": "a user's calibration.conf (github.com/ros-industrial-attic/ur_modern_driver/issues/179), another's DH "
    f"parameters with the driver's hash ({_DRIVER}/issues/457)",
    "UR5e": "a user's calibration.conf with 18 poses of the controller (github.com/weijieyong/UR_kinematics_calib)",
    "UR10": "two calibrations and two positions of the driver's tests (ur_calibration/test/calibration_test.cpp)",
    "UR10e": "the calibration of the driver's documentation (ur_calibration/doc/algorithm.rst)",
}
"""Published values, by model, with which the files were tested, in addition to `_DEFAULTS` of `_WITH_DEFAULTS`."""
_WITH_DEFAULTS = frozenset(("UR3", "UR3e", "UR5", "UR5e", "UR10", "UR10e"))


@dataclass(frozen=True, eq=False)
class ControllerGeometry:
    """Geometry in the controller's convention, `Π RotZ(theta + q) Trans(a, 0, d) RotX(alpha)` from `base` to flange.

    Attributes:
            model: the manufacturer's name of the model, for example "UR5e", or the robot's name if it is not in the
                table.
            robot: nominal parameters, with the names and limits of the description.
            T_poses_base: maps the controller's frame `base` into the frame of the description's poses.
            T_flange_tool: maps the description's tool into the controller's flange.
            described_robot: robot as described.
    """

    model: str
    robot: Robot
    T_poses_base: Frame
    T_flange_tool: Frame
    described_robot: Robot

    def origins(self, calibrated: Robot) -> tuple[list[Frame], Robot]:
        """Return the frames of a calibrated robot's joints as the controller defines them, each in the previous frame.

        Shifting the frame of a joint along and about its axis does not change the motion or the tool.

        Args:
            calibrated: the description with other parameters, base and tool.

        Returns:
            The frames, the first one in `base`, and the nominal robot with the base and tool that belong to them.
        """
        T_rows_base = inverse(frame_of(self.described_robot.base)) @ self.T_poses_base
        before, moved = T_rows_base, []
        origins, end = joint_origins(calibrated)
        for origin, screw in zip(origins, self._screws(T_rows_base), strict=True):
            moved.append(inverse(before) @ origin @ screw)
            before = screw
        base = frame_of(calibrated.base) @ T_rows_base
        tool = inverse(before) @ end @ frame_of(calibrated.tool)
        return moved, self.robot.with_geometry(base=xyz_zyx_of(base), tool=xyz_zyx_of(tool))

    def _screws(self, T_rows_base: Frame) -> list[Frame]:
        """Return every joint's shift along and about its axis from the description's frame to the controller's."""
        described, own, screws = np.eye(4), T_rows_base, []
        origins, end = joint_origins(self.described_robot)
        for described_origin, own_origin in zip(origins[:-1], joint_origins(self.robot)[0][:-1], strict=True):
            described, own = described @ described_origin, own @ own_origin
            screws.append(_screw(inverse(described) @ own))
        # After the last joint there is only the flange.
        return [*screws, _screw(end @ frame_of(self.described_robot.tool) @ inverse(self.T_flange_tool))]

    def frames(self) -> ControllerFrames:
        """Return the differences between the description's frames and the controller's."""
        base, tool = xyz_zyx_of(self.T_poses_base), xyz_zyx_of(self.T_flange_tool)
        return ControllerFrames(self._sentence(), base, tool)

    def _sentence(self) -> str:
        base, tool = _frame_words(self.T_poses_base), _frame_words(self.T_flange_tool)
        poses = f"Poses are those of the {self.model}'s flange in the controller's frame 'base'"
        if not base and not tool:
            return f"{poses}, which are also the frames of robot '{self.described_robot.name}'."
        differences = [
            f"'base' is at {base} in the frame of its poses" if base else "",
            f"its tool is at {tool} on the flange" if tool else "",
        ]
        other = " and ".join(filter(None, differences))
        return f"{poses}; robot '{self.described_robot.name}' has other frames: {other}."


def _screw(T: Frame) -> Frame:
    """Return the part of a transform along and about the z axis."""
    angle = float(np.arctan2(T[1, 0] - T[0, 1], T[0, 0] + T[1, 1]))
    screw: Frame = rotation(2, angle) @ translation(0.0, 0.0, float(T[2, 3]))
    return screw


def _frame_words(T: Frame) -> str:
    """Format a frame as text; "" for the identity."""
    x, y, z, *angles = xyz_zyx_of(T)
    lengths = [f"{name} {value * 1e3:.6g} mm" for name, value in zip("xyz", (x, y, z), strict=True) if value]
    names = ("roll", "pitch", "yaw")
    turns = [f"{name} {np.rad2deg(a):.6g} deg" for name, a in zip(names, angles, strict=True) if a]
    return ", ".join(lengths + turns)


def controller_geometry(described_robot: Robot) -> ControllerGeometry:
    """Return the Universal Robots model to which a nominal or calibrated robot belongs, and its relative frames.

    Raises:
        RobotError: the robot is not a known model.
    """
    check_robot(described_robot)
    candidates = [_placed(model, _robot(described_robot, model), described_robot) for model in _D_AND_A]
    distance, own = min(candidates, key=lambda candidate: candidate[0])
    if distance <= _FARTHEST:
        return own
    if _has_own_convention(described_robot):
        plain = described_robot.with_geometry(base=np.zeros(6), tool=np.zeros(6))
        return ControllerGeometry(
            described_robot.name,
            plain,
            frame_of(described_robot.base),
            frame_of(described_robot.tool),
            described_robot,
        )
    raise RobotError(
        f"expected an arm of Universal Robots ({', '.join(_D_AND_A)}), got robot '{described_robot.name}', whose tool "
        f"is on average {distance * 1e3:.3g} mm from that of a {own.model}",
        expected="an arm of Universal Robots",
        value=described_robot.name,
        remedy="for another arm of Universal Robots, give a robot file with the maker's DH parameters (theta 0, a "
        "negative, alpha 90, 0, 0, 90, -90, 0 deg)",
    )


def without_beta(origins: list[Frame], robot: Robot) -> Robot:
    """Convert a robot to the manufacturer's rows, in which beta is 0 and the last row has neither a nor alpha.

    Two lines have one common normal. If the lines are nearly parallel, the normal is far away, so d of this row and of
    the next are large and nearly cancel, as in the manufacturer's files. Of the two directions of a normal, the one
    that changes theta by less than 90 deg is used.

    Args:
        origins: frames of the joints, see `ControllerGeometry.origins`.
        robot: nominal robot with the base and tool that belong to these frames.
    """
    plain = robot_of_origins(robot, origins, np.eye(4), _TILTED)
    dh = plain.dh.copy()
    dh[:, 4] = 0.0  # axes that are parallel up to `_TILTED`
    turned = 0.0
    for joint, (row, theta) in enumerate(zip(dh, robot.dh[:, 0].tolist(), strict=True), 1):
        row[0] = theta + math.remainder(row[0] + turned - theta, 2 * math.pi)
        turned = 0.0
        if abs(row[0] - theta) > math.pi / 2 and joint < len(dh):
            # RotZ(t + pi) Trans(-a, 0, d) RotX(-alpha) = RotZ(t) Trans(a, 0, d) RotX(alpha) RotZ(pi)
            turned = math.pi
            row[0] -= math.copysign(turned, row[0] - theta)
            row[2:4] *= -1
    return plain.with_geometry(dh=dh)


def controller_robot(described_robot: Robot) -> ControllerRobot:
    """Return the controller's description of an arm, and the values with which its files were tested."""
    own = controller_geometry(described_robot)
    values = [_USERS[own.model]] if own.model in _USERS else []
    if own.model in _WITH_DEFAULTS:
        values.append(f"the maker's default kinematics and hash of the {own.model} ({_DEFAULTS})")
    return ControllerRobot(own.robot, own.frames(), " and ".join(values) or None)


def check_robot(robot: Robot) -> None:
    """Raise an error for robots that the manufacturer's files cannot describe.

    Raises:
        RobotError: the robot does not have exactly six joints, all revolute.
    """
    check_plain_joints(robot, "a file of Universal Robots", JOINTS)


def _robot(described_robot: Robot, model: str) -> Robot:
    """Return the nominal robot of a model with the names and limits of a description."""
    (d_1, *wrist), (a_2, a_3) = _D_AND_A[model]
    dh = np.zeros((JOINTS, 5))
    dh[:, 1], dh[:, 2], dh[:, 3] = (d_1, 0, 0, *wrist), (0, -a_2, -a_3, 0, 0, 0), _ALPHA
    return described_robot.with_geometry(dh, np.zeros(6), np.zeros(6))


def _has_own_convention(robot: Robot) -> bool:
    """Return whether a robot is described in the manufacturer's convention, with any lengths."""
    theta, _, a, alpha, beta = robot.dh.T
    return not (theta.any() or beta.any() or a[[0, 3, 4, 5]].any()) and bool(
        (a[[1, 2]] < 0).all() and np.allclose(alpha, _ALPHA, atol=1e-8)
    )


def _placed(model: str, own: Robot, described_robot: Robot) -> tuple[float, ControllerGeometry]:
    """Align a model with a description, and return the mean distance [m] between their tools."""
    base, tool = _by_first_axes(own, described_robot)
    q = torch.rand((_POSES, JOINTS), generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 6 - 3
    T = forward_kinematics(described_robot, q)

    def described_with(base: Frame, tool: Frame) -> tuple[float, Robot]:
        robot = own.with_geometry(base=xyz_zyx_of(base), tool=xyz_zyx_of(tool))
        return float((forward_kinematics(robot, q) - T)[:, :3, 3].norm(dim=-1).mean()), robot

    distance, robot = described_with(base, tool)
    if _EXACT < distance < 4 * _FARTHEST:
        robot, _ = solve_approximation(ApproximationProblem(robot, q, T, ()))
        base, tool = _right(frame_of(robot.base)), _right(frame_of(robot.tool))
        distance, robot = described_with(base, tool)
    return distance, ControllerGeometry(model, own, base, tool, described_robot)


def _by_first_axes(own: Robot, described_robot: Robot) -> tuple[Frame, Frame]:
    """Determine the controller's base from axes 1 and 2, and the description's tool on the flange at zero."""
    first, second = _zero_frames(described_robot)[:2]
    z, across = first[:3, 2], second[:3, 2] - first[:3, 2] * (second[:3, 2] @ first[:3, 2])
    base = np.eye(4)
    if np.linalg.norm(across) > _EXACT:
        y = -across / np.linalg.norm(across)
        base[:3, :3] = np.column_stack([np.cross(y, z), y, z])
    # the foot of the common normal on the first axis
    apart = second[:3, 3] - first[:3, 3]
    along = apart @ z - (apart @ base[:3, 1]) * (second[:3, 2] @ z) / (second[:3, 2] @ base[:3, 1] or 1.0)
    base[:3, 3] = first[:3, 3] + (along - own.dh[0, 1]) * z
    base = _clean(base)
    zero = torch.zeros(1, JOINTS, dtype=torch.float64)
    ends = [forward_kinematics(robot, zero)[0].numpy() for robot in (own, described_robot)]
    return base, _clean(inverse(base @ ends[0]) @ ends[1])


def _zero_frames(robot: Robot) -> list[Frame]:
    """Return the frames of the joints at zero joint values, in the frame of poses."""
    frames, last = [], frame_of(robot.base)
    for origin in joint_origins(robot)[0]:
        last = last @ origin
        frames.append(last)
    return frames


def _clean(T: Frame) -> Frame:
    """Remove rounding errors from a frame: right angles to 1e-9 rad, zeros to 1e-12 m."""
    return frame_of(_rounded(xyz_zyx_of(T), 1e-9, 1e-12))


def _right(T: Frame) -> Frame:
    """Return the frame before calibration if it had right angles at the origin, otherwise the given frame."""
    values = xyz_zyx_of(T)
    rounded = _rounded(values, _NEAR_ANGLE, _NEAR_LENGTH)
    quarters = rounded[3:] / (np.pi / 2)
    whole = not rounded[:3].any() and bool((quarters == np.rint(quarters)).all())
    return frame_of(rounded if whole else values)


def _rounded(xyz_zyx: Float64[np.ndarray, " 6"], angle: float, length: float) -> Float64[np.ndarray, " 6"]:
    lengths, angles = xyz_zyx[:3], xyz_zyx[3:]
    quarters = np.rint(angles / (np.pi / 2)) * (np.pi / 2)
    return np.concatenate(
        [
            np.where(np.abs(lengths) <= length, 0.0, lengths),
            np.where(np.abs(angles - quarters) <= angle, quarters, angles),
        ]
    )
