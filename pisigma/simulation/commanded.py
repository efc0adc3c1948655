"""Commanded joint values, either random or those with which the true robot reaches desired poses."""

import torch
from jaxtyping import Bool, Float64
from pydantic import Field, model_validator
from torch import Tensor

from pisigma.files.errors import RecipeError, UnreachablePoseError, check_choice
from pisigma.files.yaml_file import Section
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.closed_form import AbstractClosedForm, InverseSolutions, closed_form_solver
from pisigma.robot.kinematics.joint_limits import wrap_into_limits, wrapped_difference
from pisigma.robot.kinematics.numeric import solve_numeric
from pisigma.robot.kinematics.status import Status
from pisigma.simulation.errors.source import values_by_joint_index
from pisigma.simulation.poses import JointsRandom, WhereToMeasure
from pisigma.simulation.true_robot import TrueRobot


class BranchSection(Section):
    """Branch of the inverse kinematics, common to all poses of a simulation.

    Attributes:
        name: name of a branch of the nominal robot's closed form, instead of joint values.
        near_deg: joint values by name of a revolute joint [deg], 0 by default. With a closed form, the nearest
            reachable solution is used; without one, the numeric solution starts here.
        near_mm: joint values by name of a prismatic joint [mm], 0 by default.
    """

    name: str | None = None
    near_deg: dict[str, float] | None = None
    near_mm: dict[str, float] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _one_way(self) -> "BranchSection":
        if (self.name is None) == (self.near_deg is None):
            raise ValueError("expected either name or near_deg (optionally with near_mm)")
        if self.name is not None and self.near_mm:
            raise ValueError("near_mm applies only to near_deg, not to name; remove it")
        return self

    def start_joints(self, robot: Robot, T: Float64[Tensor, "poses 4 4"]) -> Float64[Tensor, "poses dof"]:
        """Return joint values [rad or m] near which the true robot reaches the desired poses.

        Args:
            robot: the nominal robot.
            T: desired T_base_tool.

        Raises:
            RecipeError: there is no such branch or joint, or the robot has no closed-form inverse kinematics.
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
            first = int(unreachable.nonzero()[0])
            raise UnreachablePoseError(
                f"the nominal robot cannot reach {int(unreachable.sum())} of {len(unreachable)} poses on {where}; "
                f"the first is pose {first} (counted from 0)",
                option="poses",
                value=first,
                remedy="change the region of the poses or the branch",
            )
        return _nearest(solutions, robot, near, reached)

    def solve_nominal(
        self, robot: Robot, T: Float64[Tensor, "poses 4 4"]
    ) -> tuple[Float64[Tensor, "poses dof"], Bool[Tensor, " poses"]]:
        """Return joint values [rad or m] of the nominal robot at poses, some of which may be unreachable.

        Args:
            robot: the nominal robot.
            T: desired T_base_tool.

        Returns:
            Joint values, and whether they reach the pose on this branch, within the limits and away from
            singularities; the values of other poses are meaningless.

        Raises:
            RecipeError: there is no such branch or joint, or the robot has no closed-form inverse kinematics.
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
        """Return the controller values of `near_deg` and `near_mm` [rad or m]."""
        fields = ("near_deg", "near_mm")
        stated = values_by_joint_index(
            robot, self.near_deg or {}, self.near_mm, fields, "branch", by_axis_name=True
        )
        values = [axis.from_file_unit(stated.get(index, 0.0)) for index, axis in enumerate(robot.axes)]
        near: Tensor = robot.to_dh(torch.tensor(values, dtype=torch.float64))
        return near

    def _solutions(
        self, solver: AbstractClosedForm | None, robot: Robot, T: Float64[Tensor, "poses 4 4"]
    ) -> InverseSolutions:
        """Return the solutions of all branches, or only of the named branch."""
        if solver is None:
            raise RecipeError(
                f"robot '{robot.name}' has no closed-form inverse kinematics and therefore no branch '{self.name}'",
                option="branch",
                value=self.name,
                remedy="give near_deg instead",
            )
        if self.name is None:
            return solver.solve(T)
        check_choice(RecipeError, "branch", self.name, solver.branches)
        index = solver.branches.index(self.name)
        solutions = solver.solve(T)
        return InverseSolutions(solutions.q[:, index, None], solutions.status[:, index, None], (self.name,))


def _nearest(
    solutions: InverseSolutions,
    robot: Robot,
    near: Float64[Tensor, " dof"],
    allowed: Bool[Tensor, "poses branches"],
) -> Float64[Tensor, "poses dof"]:
    """Return the allowed solutions that are nearest to reference values."""
    difference = wrapped_difference(robot, solutions.q, near)
    distance = torch.where(allowed, (difference * difference).sum(-1), torch.inf)
    return torch.take_along_dim(solutions.q, distance.argmin(-1)[:, None, None], 1)[:, 0]


class AbstractCommandedJoints(Section):
    """Base class of sections of sensors that measure at poses.

    Attributes:
        poses: desired poses, or joint values to command.
        branch: branch of the inverse kinematics for desired poses; not for joint values.
    """

    poses: WhereToMeasure
    branch: BranchSection | None = None

    @model_validator(mode="after")
    def _branch_for_poses(self) -> "AbstractCommandedJoints":
        if isinstance(self.poses, JointsRandom) != (self.branch is None):
            raise ValueError(
                "desired poses need a branch; add one"
                if self.branch is None
                else "joints_random commands joint values and needs no branch; remove it"
            )
        return self

    def commanded_joints(self, robot: TrueRobot) -> Float64[Tensor, "rows dof"]:
        """Return the joint values to command [rad or m], identical for every call; see `joints_for_poses`."""
        if isinstance(self.poses, JointsRandom):
            return self.poses.joints(robot.nominal)
        assert self.branch is not None  # the validator has checked this
        T = self.poses.transforms()
        return joints_for_poses(robot, T, self.branch.start_joints(robot.nominal, T))


def joints_for_poses(
    robot: TrueRobot, T: Float64[Tensor, "poses 4 4"], start: Float64[Tensor, "poses dof"]
) -> Float64[Tensor, "poses dof"]:
    """Return the commanded joint values [rad or m] with which the true robot reaches desired poses.

    Encoder steps are ignored; without an encoder, the joint values would reach the poses exactly. With an encoder,
    the robot stops at the nearest pulse, so measured poses differ slightly from desired poses.

    Args:
        robot: the true robot.
        T: desired T_base_tool.
        start: joint values [rad or m] near the solution.

    Raises:
        UnreachablePoseError: the true robot does not reach a pose near the start values.
        RecipeError: joint values are outside the limits of the robot.
    """
    q, inside = wrap_into_limits(robot.nominal, robot.without_encoder().inverse(T, start))
    if not inside.all():
        outside = (~inside).nonzero()
        raise RecipeError(
            f"{len(outside)} of {len(T)} poses need joint values outside the limits of robot '{robot.nominal.name}'; "
            f"the first is pose {int(outside[0])} (counted from 0)",
            option="poses",
            value=int(outside[0]),
            remedy="change the region of the poses or the branch",
        )
    return q
