"""What every closed form gives: all branches of a pose, each with its status."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TypeVar

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from pisigma.kinematics.closed_form.canonical import CanonicalRows
from pisigma.kinematics.joint_limits import turn_into_limits
from pisigma.kinematics.status import Status
from pisigma.robot.description import Robot
from pisigma.se3 import check_transforms, invert, wrap_to_pi

Own = TypeVar("Own", bound="AbstractClosedForm")


@dataclass(frozen=True, eq=False)
class InverseSolutions:
    """All solutions of all poses.

    Attributes:
        q: joint values [rad or m], as the controller counts; revolute ones in (-pi, pi], or a full turn from
            there where only that is within the limits. NaN where the status is UNREACHABLE, and only there.
        status: a `Status` for every pose and branch.
        branches: name of every branch, in the order of the branch axis.
    """

    q: Float[Tensor, "*batch branches dof"]
    status: Int64[Tensor, "*batch branches"]
    branches: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class AbstractClosedForm(ABC):
    """A closed-form inverse of one robot.

    Attributes:
        robot: the robot it belongs to.
        rows: its rows with canonical twists.
    """

    robot: Robot
    rows: CanonicalRows

    @classmethod
    @abstractmethod
    def of(cls: type[Own], robot: Robot) -> Own | None:
        """The solver for a robot, or None where the robot's rows are not of this family."""

    @property
    @abstractmethod
    def branches(self) -> tuple[str, ...]:
        """Names of the branches, in the order in which they come."""

    @abstractmethod
    def _solve_canonical(
        self, T: Float[Tensor, "*batch 4 4"]
    ) -> tuple[
        Float[Tensor, "*batch branches dof"], Bool[Tensor, "*batch branches"], Bool[Tensor, "*batch branches"]
    ]:
        """Canonical joint variables, whether they reach the pose, and whether it is singular.

        Args:
            T: pose of the last joint's frame, turned, in the frame before the first joint.
        """

    def solve(self, T: Tensor) -> InverseSolutions:
        """All joint values that take the tool to the poses.

        Args:
            T: T_base_tool, `(*batch, 4, 4)` [m].

        Raises:
            PoseError: T is no stack of rigid transforms; the message gives the index.
        """
        check_transforms(T, "T_base_tool")
        T_first_base, T_tool_last = invert(self.rows.T_base_first.to(T)), invert(self.rows.T_last_tool.to(T))
        variables, reached, singular = self._solve_canonical(T_first_base @ T @ T_tool_last)
        q = self.rows.joint_values(variables)
        revolute = torch.tensor(self.robot.revolute, device=T.device)
        q, inside = turn_into_limits(self.robot, torch.where(revolute, wrap_to_pi(q), q))
        status = torch.where(singular, int(Status.SINGULAR), int(Status.REACHED))
        status = torch.where(inside, status, int(Status.OUTSIDE_JOINT_LIMITS))
        status = torch.where(reached, status, int(Status.UNREACHABLE))
        return InverseSolutions(torch.where(reached[..., None], q, torch.nan), status, self.branches)
