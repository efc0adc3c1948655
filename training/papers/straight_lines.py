"""Deviation of the true tool from straight lines, caused by errors of the controller's parameters."""

from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.files.errors import UnreachablePoseError
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.closed_form import closed_form_solver
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.numeric import solve_numeric
from pisigma.robot.kinematics.status import Status
from pisigma.robot.se3 import rotation_from_vector, rotation_vector, transform
from pisigma.simulation.commanded import BranchSection
from pisigma.simulation.true_robot import TrueRobot


@dataclass(frozen=True, eq=False)
class Controller:
    """A controller that computes joint values of poses with given parameters.

    Attributes:
        nominal: The nominal robot.
        robot: The same with the parameters of the controller; its base is the robot's frame.
        branch: Branch of the inverse kinematics.
    """

    nominal: Robot
    robot: Robot
    branch: BranchSection

    @property
    def is_closed_form(self) -> bool:
        """Whether the nominal inverse kinematics supports these parameters, as it does those of Lim et al."""
        return closed_form_solver(self.robot) is not None

    def joints(self, T: Float64[Tensor, "poses 4 4"]) -> Float64[Tensor, "poses dof"]:
        """Return the joint values [rad or m] that the controller commands for T_base_tool [m].

        The nominal, closed-form inverse kinematics is used if it supports the parameters, otherwise a numerical
        solution that starts from the nominal one.

        Raises:
            UnreachablePoseError: A pose cannot be reached on this branch.
        """
        arm = self.robot if self.is_closed_form else self.nominal
        q, reached = self.branch.solve_nominal(arm, T)
        if reached.all() and not self.is_closed_form:
            solution = solve_numeric(self.robot, T, q)
            q, reached = solution.q, solution.status != Status.NOT_CONVERGED
        if not reached.all():
            index = int((~reached).nonzero()[0])
            x, y, z = (1e3 * T[index, :3, 3]).tolist()
            raise UnreachablePoseError(
                f"robot '{self.nominal.name}' does not reach pose {index} (counted from 0) at {x:.1f}, {y:.1f}, "
                f"{z:.1f} mm on the requested branch",
                value=index,
                remedy="move the pose or rotate the tool",
            )
        return q


@dataclass(frozen=True, eq=False)
class TrackedLine:
    """Positions of the true tool along a line.

    Attributes:
        wanted: Requested positions on the straight line [m], in the robot's frame.
        reached: Corresponding positions of the true tool [m].
        length_error: True distance between the ends minus the requested length [m].
    """

    wanted: Float64[Tensor, "steps 3"]
    reached: Float64[Tensor, "steps 3"]
    length_error: float

    @property
    def deviation(self) -> Float64[Tensor, "steps 3"]:
        """Reached minus requested positions [m]."""
        return self.reached - self.wanted

    @property
    def largest(self) -> Float64[Tensor, " 3"]:
        """Return the deviation with the largest magnitude, with its sign, per axis of the robot's frame [m]."""
        deviation = self.deviation
        return deviation.take_along_dim(deviation.abs().argmax(0, keepdim=True), 0)[0]

    @property
    def largest_across(self) -> float:
        """Return the largest distance of the true tool from the straight line through the requested ends [m]."""
        along = self.wanted[-1] - self.wanted[0]
        along = along / along.norm()
        away = self.reached - self.wanted[0]
        return float((away - (away @ along)[:, None] * along).norm(dim=-1).max())


def move_l(
    true_robot: TrueRobot, controller: Controller, T_ends: Float64[Tensor, "2 4 4"], steps: int = 101
) -> TrackedLine:
    """Move along a straight line between two taught poses.

    Both ends are taught with the true robot, so it reaches them whatever parameters the controller uses. In between,
    the controller interpolates the poses of the ends that follow from its parameters, positions linearly and
    orientations about one axis, and solves the inverse kinematics of every pose.

    Args:
        true_robot: The true robot.
        controller: Controller with the parameters to evaluate.
        T_ends: True poses of the ends [m], in the robot's frame.
        steps: Number of poses on the line, including the ends.

    Raises:
        UnreachablePoseError: The robot does not reach a pose.
    """
    taught = _taught(true_robot, controller, T_ends)
    believed = forward_kinematics(controller.robot, taught)
    share = torch.linspace(0, 1, steps, dtype=T_ends.dtype)[:, None]
    start, end = believed[:, :3, 3]
    turn = rotation_vector(believed[1, :3, :3] @ believed[0, :3, :3].mT)
    R = rotation_from_vector(share * turn) @ believed[0, :3, :3]
    reached = true_robot.forward(controller.joints(transform(R, start + share * (end - start))))[:, :3, 3]
    first, last = T_ends[:, :3, 3]
    return TrackedLine(
        first + share * (last - first), reached, _length(reached) - float((last - first).norm())
    )


def i_move(
    true_robot: TrueRobot,
    controller: Controller,
    T_start: Float64[Tensor, "4 4"],
    shift: Float64[Tensor, " 3"],
    steps: int = 101,
) -> TrackedLine:
    """Move from a taught pose by a translation, keeping the orientation.

    Only the start is taught; direction and distance follow from the parameters of the controller.

    Args:
        true_robot: The true robot.
        controller: Controller with the parameters to evaluate.
        T_start: True pose of the start [m], in the robot's frame.
        shift: Translation [m], in the robot's frame.
        steps: Number of poses on the line, including the ends.

    Raises:
        UnreachablePoseError: The robot does not reach a pose.
    """
    taught = _taught(true_robot, controller, T_start[None])
    believed = forward_kinematics(controller.robot, taught)[0]
    way = torch.linspace(0, 1, steps, dtype=T_start.dtype)[:, None] * shift
    Ts = transform(believed[:3, :3].expand(steps, 3, 3), believed[:3, 3] + way)
    reached = true_robot.forward(controller.joints(Ts))[:, :3, 3]
    return TrackedLine(T_start[:3, 3] + way, reached, _length(reached) - float(shift.norm()))


def _taught(
    true_robot: TrueRobot, controller: Controller, T: Float64[Tensor, "poses 4 4"]
) -> Float64[Tensor, "poses dof"]:
    """Return joint values at which the true tool is at T."""
    near = Controller(controller.nominal, controller.nominal, controller.branch).joints(T)
    return true_robot.inverse(T, near)


def _length(reached: Float64[Tensor, "steps 3"]) -> float:
    return float((reached[-1] - reached[0]).norm())
