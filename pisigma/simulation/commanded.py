"""Which joint values are commanded: drawn as such, or those that take the true robot to wanted poses."""

import torch
from jaxtyping import Bool, Float64
from pydantic import Field, model_validator
from torch import Tensor

from pisigma.files.errors import RecipeError, UnreachablePoseError, nearest_choice
from pisigma.files.yaml_file import Section
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.closed_form import AbstractClosedForm, InverseSolutions, closed_form_solver
from pisigma.robot.kinematics.joint_limits import wrap_into_limits, wrapped_difference
from pisigma.robot.kinematics.numeric import solve_numeric
from pisigma.robot.kinematics.status import Status
from pisigma.simulation.errors.source import stated_joints
from pisigma.simulation.poses import JointsRandom, WhereToMeasure
from pisigma.simulation.true_robot import TrueRobot


class BranchSection(Section):
    """Which of several solutions of the inverse kinematics is taken, the same for all poses of a simulation.

    Attributes:
        name: a branch of the nominal robot's closed form, by name; or
        near_deg: joint values to be near to, by name of a revolute joint [deg], 0 where not stated; with a
            closed form its nearest reachable solution is taken, without one the search for the true solution
            starts here.
        near_mm: the same for prismatic joints [mm].
    """

    name: str | None = None
    near_deg: dict[str, float] | None = None
    near_mm: dict[str, float] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _one_way(self) -> "BranchSection":
        if (self.name is None) == (self.near_deg is None):
            raise ValueError("state either the name of the branch or near_deg (with near_mm)")
        if self.name is not None and self.near_mm:
            raise ValueError("near_mm goes with near_deg, not with name; remove it")
        return self

    def start(self, robot: Robot, T: Float64[Tensor, "poses 4 4"]) -> Float64[Tensor, "poses dof"]:
        """Joint values [rad or m] near which the true robot reaches the poses.

        Args:
            robot: the nominal robot.
            T: T_base_tool wanted.

        Raises:
            RecipeError: no such branch or joint, or the robot has no closed form whose branch could be named.
            UnreachablePoseError: the nominal robot does not reach a pose on this branch.
        """
        near = self._near(robot).to(T.device)
        solver = closed_form_solver(robot)
        if solver is None and self.name is None:
            return near.expand(len(T), robot.dof)
        solutions = self._solutions(solver, robot, T)
        reached = solutions.status != Status.UNREACHABLE
        if not reached.any(-1).all():
            unreachable = ~reached.any(-1)
            where = f"branch '{self.name}'" if self.name else "any branch"
            raise UnreachablePoseError(
                f"wanted pose {int(unreachable.nonzero()[0])} (counted from 0; {int(unreachable.sum())} of "
                f"{len(unreachable)} poses) cannot be reached by the nominal robot on {where}; "
                "change the region of the poses or the branch."
            )
        return _nearest(solutions, robot, near, reached)

    def find(
        self, robot: Robot, T: Float64[Tensor, "poses 4 4"]
    ) -> tuple[Float64[Tensor, "poses dof"], Bool[Tensor, " poses"]]:
        """Joint values [rad or m] of the nominal robot at poses of which not all need be reachable.

        Args:
            robot: the nominal robot.
            T: T_base_tool wanted.

        Returns:
            Joint values, and whether they reach the pose on this branch, within the limits and away from
            singularities; where they do not, the values mean nothing.

        Raises:
            RecipeError: no such branch or joint, or the robot has no closed form whose branch could be named.
        """
        near = self._near(robot).to(T.device)
        solver = closed_form_solver(robot)
        if solver is None and self.name is None:
            solved = solve_numeric(robot, T, near)
            return solved.q, solved.status == Status.REACHED
        solutions = self._solutions(solver, robot, T)
        reached = solutions.status == Status.REACHED
        return _nearest(solutions, robot, near, reached).nan_to_num(), reached.any(-1)

    def _near(self, robot: Robot) -> Float64[Tensor, " dof"]:
        """The joint values to be near to [rad or m], which are stated as the controller counts."""
        fields = ("near_deg", "near_mm")
        stated = stated_joints(robot, self.near_deg or {}, self.near_mm, fields, "branch", axes=True)
        values = [axis.from_file_unit(stated.get(index, 0.0)) for index, axis in enumerate(robot.axes)]
        near: Tensor = robot.to_dh(torch.tensor(values, dtype=torch.float64))
        return near

    def _solutions(
        self, solver: AbstractClosedForm | None, robot: Robot, T: Float64[Tensor, "poses 4 4"]
    ) -> InverseSolutions:
        """All solutions, or those on the branch that is named alone."""
        if solver is None:
            raise RecipeError(
                f"branch: robot '{robot.name}' has no closed form and so no branch '{self.name}'; "
                "state near_deg instead."
            )
        if self.name is None:
            return solver.solve(T)
        if self.name not in solver.branches:
            raise RecipeError(
                f"branch: robot '{robot.name}' has no branch '{self.name}'; "
                f"{nearest_choice(self.name, solver.branches)}"
            )
        index = solver.branches.index(self.name)
        solutions = solver.solve(T)
        return InverseSolutions(solutions.q[:, index, None], solutions.status[:, index, None], (self.name,))


def _nearest(
    solutions: InverseSolutions,
    robot: Robot,
    near: Float64[Tensor, " dof"],
    allowed: Bool[Tensor, "poses branches"],
) -> Float64[Tensor, "poses dof"]:
    """The nearest of the solutions that are allowed."""
    difference = wrapped_difference(robot, solutions.q, near)
    distance = torch.where(allowed, (difference * difference).sum(-1), torch.inf)
    return torch.take_along_dim(solutions.q, distance.argmin(-1)[:, None, None], 1)[:, 0]


class AbstractCommanded(Section):
    """What sections share that measure at poses.

    Attributes:
        poses: wanted poses, or joint values to command.
        branch: on which branch wanted poses are reached; not for joint values.
    """

    poses: WhereToMeasure
    branch: BranchSection | None = None

    @model_validator(mode="after")
    def _branch_for_poses(self) -> "AbstractCommanded":
        if isinstance(self.poses, JointsRandom) != (self.branch is None):
            raise ValueError(
                "wanted poses need a branch, but none is stated"
                if self.branch is None
                else "joints_random commands joint values and has no branch; remove it"
            )
        return self

    def commanded(self, robot: TrueRobot) -> Float64[Tensor, "rows dof"]:
        """Joint values to command [rad or m], the same at every call. See `joints_for_poses`."""
        if isinstance(self.poses, JointsRandom):
            return self.poses.joints(robot.nominal)
        assert self.branch is not None  # the section's validator sees to it
        T = self.poses.transforms()
        return joints_for_poses(robot, T, self.branch.start(robot.nominal, T))


def joints_for_poses(
    robot: TrueRobot, T: Float64[Tensor, "poses 4 4"], start: Float64[Tensor, "poses dof"]
) -> Float64[Tensor, "poses dof"]:
    """Joint values to command so that the true robot takes wanted poses.

    Encoder steps are left out here: the joint values are those that would reach the poses exactly, and with
    an encoder the robot stops at the nearest pulse, so what is measured there is a little off the wanted
    pose.

    Args:
        robot: the true robot.
        T: T_base_tool wanted.
        start: joint values [rad or m] near the solution.

    Raises:
        UnreachablePoseError: the true robot does not reach a pose near its start.
        RecipeError: joint values would have to leave the limits of the robot.
    """
    q, inside = wrap_into_limits(robot.nominal, robot.without_encoder().inverse(T, start))
    if not inside.all():
        outside = (~inside).nonzero()
        raise RecipeError(
            f"simulation: wanted pose {int(outside[0])} (counted from 0; {len(outside)} of {len(T)} poses) needs joint "
            f"values outside the limits of robot '{robot.nominal.name}'; change the region of the poses or the branch."
        )
    return q
