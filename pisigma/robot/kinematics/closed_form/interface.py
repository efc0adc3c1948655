"""Interface of closed forms, which return the joint values and the status of all branches for a pose."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, TypeVar

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from pisigma.robot.description import Robot
from pisigma.robot.kinematics.closed_form.canonical import CanonicalRows
from pisigma.robot.kinematics.components import Frame, Scalar, frame_of
from pisigma.robot.kinematics.joint_limits import wrap_into_limits, wrapped_difference
from pisigma.robot.kinematics.status import Status
from pisigma.robot.kinematics.tolerances import NEAREST_MARGIN
from pisigma.robot.se3 import check_transforms, invert, transform, wrap_to_pi

Own = TypeVar("Own", bound="AbstractClosedForm")


@dataclass(frozen=True, eq=False)
class InverseSolutions:
    """Joint values and status of all branches for every pose.

    Attributes:
        q: joint values [rad or m]; revolute joints in (-pi, pi], or shifted by a full turn if only the shifted value is
            within the limits. NaN if and only if the status is UNREACHABLE.
        status: a `Status` for every pose and branch.
        branches: names of the branches, in the order of the branch dimension.
    """

    q: Float[Tensor, "*batch branches dof"]
    status: Int64[Tensor, "*batch branches"]
    branches: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class AbstractClosedForm(ABC):
    """A closed-form inverse of one robot.

    Attributes:
        branches: names of the branches in order, the combinations of choices between two solutions (forks), with the
            last fork varying fastest.
        robot: the robot.
        rows: rows of the robot with canonical twists.
        margin: distance that cosines keep from 1: 0, except for `start_values`.
        name: name of the form in model files.
        compiled: the formulas as a plain function that the kernels compile; None if there is no such function. It is
            called as `compiled(form, P, only, rounding, q)` with `kernels.arrays.ClosedForm`, the pose `(4, 4)` (of
            which `_solve_components` gets the first three rows), the index of the only requested branch or -1 for
            all, and the relative size of rounding errors. It writes the canonical joint variables of branches that
            reach the pose into `q`, `(branches, dof)`, whose first column is NaN before; with -2 also the variables
            of branches that do not reach it, as near to it as possible (see `start_values`). The function and those
            that it calls may use numbers, entries of arrays and functions of `math` only; each is decorated by
            `typing.no_type_check`.
    """

    name: ClassVar[str]
    branches: ClassVar[tuple[str, ...]]
    compiled: ClassVar[Callable[..., None] | None] = None
    robot: Robot
    rows: CanonicalRows
    margin: float = 0.0

    @classmethod
    @abstractmethod
    def from_robot(cls: type[Own], robot: Robot) -> Own | None:
        """Return the solver for a robot, or None if its rows do not belong to this family."""

    @abstractmethod
    def _solve_components(
        self, T: Frame, signs: Sequence[Scalar]
    ) -> tuple[list[Scalar], Bool[Tensor, "..."], Bool[Tensor, "..."]]:
        """Return canonical joint variables, whether they reach the pose, and whether it is singular.

        Args:
            T: pose of the last joint's rotated frame in the frame before the first joint, as components.
            signs: +1 or -1 for every fork, numbers or tensors that broadcast with the components of T.
        """

    def solve(self, T: Tensor) -> InverseSolutions:
        """Find all joint values that reach the poses.

        Args:
            T: T_base_tool, `(*batch, 4, 4)` [m].

        Raises:
            PoseError: T is not a stack of rigid transforms; the message states the index of the first fault.
        """
        check_transforms(T, "T_base_tool")
        q, inside, reached, singular = self._solve_branches(T)
        status = torch.where(singular, int(Status.SINGULAR), int(Status.REACHED))
        status = torch.where(inside, status, int(Status.OUTSIDE_JOINT_LIMITS))
        status = torch.where(reached, status, int(Status.UNREACHABLE))
        return InverseSolutions(torch.where(reached[..., None], q, torch.nan), status, self.branches)

    def nearest(
        self, T: Float[Tensor, "poses 4 4"], q: Float[Tensor, "poses dof"]
    ) -> tuple[Float[Tensor, "poses dof"], Int64[Tensor, " poses"]]:
        """Return the joint values [rad or m] of the branch nearest to reference values, and the index of the branch.

        If no branch reaches a pose, the values are NaN and the index is 0.
        """
        every = self.solve(T).q
        distance = wrapped_difference(self.robot, every, q[:, None]).square().sum(-1)
        index = torch.where(torch.isfinite(distance), distance, torch.inf).argmin(-1)
        return every[torch.arange(len(q)), index], index

    def most_frequent_branches(self, index: Int64[Tensor, " poses"]) -> tuple[str, ...]:
        """Return the names of the branches with these indices, the most frequent first."""
        counts = torch.bincount(index, minlength=len(self.branches))
        order = counts.argsort(descending=True, stable=True).tolist()
        return tuple(self.branches[i] for i in order if counts[i] > 0)

    def start_values(self, T: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch branches dof"]:
        """Return joint values of all branches; if a branch does not reach a pose, its arm is stretched or folded.

        They serve as starts for an arm that differs slightly from this one and may reach the pose. A small margin
        keeps them away from singular joint values, which an iteration cannot leave.

        Args:
            T: T_base_tool [m].
        """
        return replace(self, margin=NEAREST_MARGIN)._solve_branches(T)[0]

    def upright_poses(self, T: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
        """Return the poses that a SCARA can reach if its tool may tilt.

        Each pose is rotated about the tool's origin until the axis of the last joint is parallel to the axis of the
        first.
        """
        axis = T[..., :3, :3] @ invert(self.rows.T_last_tool.to(T))[:3, 2]
        first = self.rows.T_base_first.to(T)[:3, 2].expand(axis.shape)
        c = torch.linalg.cross(axis, first)
        cosine = (axis * first).sum(-1, keepdim=True)[..., None]
        columns = T[..., :3, :3]
        across = torch.linalg.cross(c[..., None].expand(columns.shape), columns, dim=-2)
        along = c[..., None] * (c[..., None, :] @ columns) / (1 + cosine).clamp(min=1e-6)
        return transform(cosine * columns + across + along, T[..., :3, 3])

    def _solve_branches(
        self, T: Tensor
    ) -> tuple[
        Float[Tensor, "*batch branches dof"],
        Bool[Tensor, "*batch branches"],
        Bool[Tensor, "*batch branches"],
        Bool[Tensor, "*batch branches"],
    ]:
        """Return joint values, and whether they are inside the limits, reach the pose, and are singular."""
        T_first_base, T_tool_last = invert(self.rows.T_base_first.to(T)), invert(self.rows.T_last_tool.to(T))
        variables, reached, singular = self._solve_canonical(T_first_base @ T @ T_tool_last)
        return (*self._wrapped(self.rows.joint_values(variables)), reached, singular)

    def _solve_canonical(
        self, T: Float[Tensor, "*batch 4 4"]
    ) -> tuple[
        Float[Tensor, "*batch branches dof"], Bool[Tensor, "*batch branches"], Bool[Tensor, "*batch branches"]
    ]:
        """Return canonical joint variables of all branches, whether they reach the pose, and whether it is singular."""
        n, batch = len(self.branches).bit_length() - 1, T.shape[:-2]
        signs = [T.new_tensor([1.0, -1.0]).reshape([2 if i == k else 1 for i in range(n)]) for k in range(n)]
        each = T.reshape(*batch, *[1] * n, 4, 4)
        variables, reached, singular = self._solve_components(frame_of(each), signs)
        shape = (*batch, *[2] * n)
        flags = [value.expand(shape).reshape(*batch, 2**n) for value in (reached, singular)]
        columns = [torch.as_tensor(v).to(T).expand(shape).reshape(*batch, 2**n) for v in variables]
        return torch.stack(columns, -1), flags[0], flags[1]

    def _wrapped(
        self, q: Float[Tensor, "*batch dof"]
    ) -> tuple[Float[Tensor, "*batch dof"], Bool[Tensor, "*batch"]]:
        """Wrap joint values to the turn nearest to 0, or to another turn if only this one is within the limits."""
        revolute = torch.tensor(self.robot.revolute, device=q.device)
        return wrap_into_limits(self.robot, torch.where(revolute, wrap_to_pi(q), q))
