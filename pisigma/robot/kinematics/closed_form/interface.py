"""What every closed form gives: all branches of a pose, each with its status."""

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
        branches: names of the branches, in the order in which they come: 2 to the number of choices between two
            solutions (forks), through which they count, the last one fastest.
        robot: the robot it belongs to.
        rows: its rows with canonical twists.
        margin: what is kept between cosines and 1: 0, but for `starts`.
        name: of the form, which model files say.
        compiled: the same formulas as a plain function that the kernels compile; None where there is none. It is called
            as `compiled(form, P, only, rounding, q)` with `kernels.arrays.ClosedForm`, the pose `(4, 4)` of which
            `_solve_components` gets the first three rows, the index of the only branch that is wanted or -1 for all,
            and the relative size of what counts as rounding. It writes the canonical joint variables of branches that
            reach the pose into `q`, `(branches, dof)`, whose first column is NaN before; with -2 those of the branches
            that do not reach it too, as near to it as they come (see `starts`). It and the plain functions
            that it calls work on numbers and entries of arrays, and call functions of `math`; each is decorated by
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
    def of(cls: type[Own], robot: Robot) -> Own | None:
        """The solver for a robot, or None where the robot's rows are not of this family."""

    @abstractmethod
    def _solve_components(
        self, T: Frame, signs: Sequence[Scalar]
    ) -> tuple[list[Scalar], Bool[Tensor, "..."], Bool[Tensor, "..."]]:
        """Canonical joint variables, whether they reach the pose, and whether it is singular.

        Args:
            T: pose of the last joint's frame, turned, in the frame before the first joint, on components.
            signs: +1 or -1 for every fork, numbers or tensors that broadcast with the components of T.
        """

    def solve(self, T: Tensor) -> InverseSolutions:
        """All joint values that take the tool to the poses.

        Args:
            T: T_base_tool, `(*batch, 4, 4)` [m].

        Raises:
            PoseError: T is no stack of rigid transforms; the message gives the index.
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
        """Joint values [rad or m] on the branch whose are nearest to others, and its index.

        Where no branch reaches a pose they are NaN, and the index is 0.
        """
        every = self.solve(T).q
        distance = wrapped_difference(self.robot, every, q[:, None]).square().sum(-1)
        index = torch.where(torch.isfinite(distance), distance, torch.inf).argmin(-1)
        return every[torch.arange(len(q)), index], index

    def frequent(self, index: Int64[Tensor, " poses"]) -> tuple[str, ...]:
        """Names of the branches of these indices, the most frequent first."""
        counts = torch.bincount(index, minlength=len(self.branches))
        order = counts.argsort(descending=True, stable=True).tolist()
        return tuple(self.branches[i] for i in order if counts[i] > 0)

    def starts(self, T: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch branches dof"]:
        """Joint values of all branches, of those that do not reach a pose the nearest: almost stretched or folded.

        They are starts for an arm that differs a little from this one and may reach the pose. A small margin keeps them
        from the singular joint values themselves, which no iteration leaves.

        Args:
            T: T_base_tool [m].
        """
        return replace(self, margin=NEAREST_MARGIN)._solve_branches(T)[0]

    def upright(self, T: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
        """Poses as a SCARA can take them whose tool may lean.

        They are turned about the tool's point until the last joint's axis is parallel to the first's.
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
        """Joint values, and whether they are inside the limits, reach the pose, and are singular."""
        T_first_base, T_tool_last = invert(self.rows.T_base_first.to(T)), invert(self.rows.T_last_tool.to(T))
        variables, reached, singular = self._solve_canonical(T_first_base @ T @ T_tool_last)
        return (*self._turned(self.rows.joint_values(variables)), reached, singular)

    def _solve_canonical(
        self, T: Float[Tensor, "*batch 4 4"]
    ) -> tuple[
        Float[Tensor, "*batch branches dof"], Bool[Tensor, "*batch branches"], Bool[Tensor, "*batch branches"]
    ]:
        """Canonical joint variables of all branches, whether they reach the pose, and whether it is singular."""
        n, batch = len(self.branches).bit_length() - 1, T.shape[:-2]
        signs = [T.new_tensor([1.0, -1.0]).reshape([2 if i == k else 1 for i in range(n)]) for k in range(n)]
        each = T.reshape(*batch, *[1] * n, 4, 4)
        variables, reached, singular = self._solve_components(frame_of(each), signs)
        shape = (*batch, *[2] * n)
        flags = [value.expand(shape).reshape(*batch, 2**n) for value in (reached, singular)]
        columns = [torch.as_tensor(v).to(T).expand(shape).reshape(*batch, 2**n) for v in variables]
        return torch.stack(columns, -1), flags[0], flags[1]

    def _turned(
        self, q: Float[Tensor, "*batch dof"]
    ) -> tuple[Float[Tensor, "*batch dof"], Bool[Tensor, "*batch"]]:
        """Joint values on the turn nearest to 0 or, where only that is within the limits, on another."""
        revolute = torch.tensor(self.robot.revolute, device=q.device)
        return wrap_into_limits(self.robot, torch.where(revolute, wrap_to_pi(q), q))
