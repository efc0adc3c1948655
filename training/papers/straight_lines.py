"""Straight lines: how far the true tool leaves them when the controller's parameters are not quite right."""

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
    """A controller that turns poses into joint values with the parameters it was given.

    Attributes:
        nominal: the robot as drawn.
        robot: the same with the parameters that the controller has; its base is the robot's frame.
        branch: on which branch of the inverse kinematics it works.
    """

    nominal: Robot
    robot: Robot
    branch: BranchSection

    @property
    def is_closed_form(self) -> bool:
        """Whether the nominal inverse kinematics takes these parameters, as those of Lim et al. were chosen to."""
        return closed_form_solver(self.robot) is not None

    def joints(self, T: Float64[Tensor, "poses 4 4"]) -> Float64[Tensor, "poses dof"]:
        """Joint values [rad or m] that the controller commands for T_base_tool [m].

        By the nominal, closed-form inverse kinematics where that takes the parameters, else numerically from the
        nominal solution.

        Raises:
            UnreachablePoseError: a pose cannot be reached on this branch.
        """
        arm = self.robot if self.is_closed_form else self.nominal
        q, reached = self.branch.find(arm, T)
        if reached.all() and not self.is_closed_form:
            solution = solve_numeric(self.robot, T, q)
            q, reached = solution.q, solution.status != Status.NOT_CONVERGED
        if not reached.all():
            index = int((~reached).nonzero()[0])
            x, y, z = (1e3 * T[index, :3, 3]).tolist()
            raise UnreachablePoseError(
                f"robot '{self.nominal.name}' does not reach pose {index} (counted from 0) at {x:.1f}, {y:.1f}, "
                f"{z:.1f} mm on the branch that was asked for; move the pose or turn the tool."
            )
        return q


@dataclass(frozen=True, eq=False)
class TrackedLine:
    """What the true tool did on a line.

    Attributes:
        wanted: positions on the straight line [m], in the robot's frame.
        reached: the true tool's positions for them [m].
        length_error: distance of the true ends minus the length that was asked for [m].
    """

    wanted: Float64[Tensor, "steps 3"]
    reached: Float64[Tensor, "steps 3"]
    length_error: float

    @property
    def deviation(self) -> Float64[Tensor, "steps 3"]:
        """Reached minus wanted [m]."""
        return self.reached - self.wanted

    @property
    def largest(self) -> Float64[Tensor, " 3"]:
        """Per axis of the robot's frame the deviation that is largest in size, with its sign [m]."""
        deviation = self.deviation
        return deviation.take_along_dim(deviation.abs().argmax(0, keepdim=True), 0)[0]

    @property
    def largest_across(self) -> float:
        """Largest distance of the true tool from the straight line through the wanted ends [m]."""
        along = self.wanted[-1] - self.wanted[0]
        along = along / along.norm()
        away = self.reached - self.wanted[0]
        return float((away - (away @ along)[:, None] * along).norm(dim=-1).max())


def move_l(
    true_robot: TrueRobot, controller: Controller, T_ends: Float64[Tensor, "2 4 4"], steps: int = 101
) -> TrackedLine:
    """Move along a straight line between two taught poses.

    Both ends are taught with the true robot, so it gets there whatever the controller believes. In between, the
    controller interpolates what it believes of the ends, positions linearly and orientations about one axis, and
    solves the inverse kinematics of every pose.

    Args:
        true_robot: the robot.
        controller: with the parameters to judge.
        T_ends: true poses of the ends [m], in the robot's frame.
        steps: poses on the line, with the ends.

    Raises:
        UnreachablePoseError: the robot does not reach a pose.
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
    """Move from a taught pose by a shift, keeping the orientation.

    Only the start is taught; direction and distance are what the controller believes them to be.

    Args:
        true_robot: the robot.
        controller: with the parameters to judge.
        T_start: true pose of the start [m], in the robot's frame.
        shift: how far to go [m], in the robot's frame.
        steps: poses on the line, with the ends.

    Raises:
        UnreachablePoseError: the robot does not reach a pose.
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
    """Joint values at which the true tool is at T."""
    near = Controller(controller.nominal, controller.nominal, controller.branch).joints(T)
    return true_robot.inverse(T, near)


def _length(reached: Float64[Tensor, "steps 3"]) -> float:
    return float((reached[-1] - reached[0]).norm())
