"""Which joint values are commanded: drawn as such, or those that take the true robot to wanted poses."""

from typing import TypeVar

from jaxtyping import Float64
from pydantic import model_validator
from torch import Tensor

from pisigma.errors import RecipeError
from pisigma.kinematics.joint_limits import wrap_into_limits
from pisigma.simulation.branch import BranchSection
from pisigma.simulation.poses import WhereToMeasure
from pisigma.simulation.random_joints import JointsRandom
from pisigma.simulation.true_robot import TrueRobot
from pisigma.yaml_file import Section

Own = TypeVar("Own", bound="AbstractCommanded")


class AbstractCommanded(Section):
    """What sections share that measure at poses.

    Attributes:
        poses: wanted poses, or joint values to command.
        branch: on which branch wanted poses are reached; not for joint values.
    """

    poses: WhereToMeasure
    branch: BranchSection | None = None

    @model_validator(mode="after")
    def _branch_for_poses(self: Own) -> Own:
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
            f"simulation: wanted pose {int(outside[0])} (counted from 0; {len(outside)} of {len(T)} poses) "
            f"needs joint values outside the limits of robot '{robot.nominal.name}'; "
            "change the region of the poses or the branch."
        )
    return q
