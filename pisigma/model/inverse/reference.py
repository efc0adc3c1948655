"""Corrected inverse kinematics in torch that leaves nothing untried: every model, at some milliseconds a pose.

It is the oracle that the kernels are tested against, and the route of models whose correction has no compiled form.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pisigma.files.errors import ModelError, PoseError, nearest_choice
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.inverse.finishing import Finishing
from pisigma.model.inverse.identified_arm import IdentifiedArm, levelled, search, tolerated
from pisigma.model.inverse.joint_input import as_array, checked_approach, pose_array
from pisigma.model.inverse.solution import Solution
from pisigma.model.inverse.spare_joints import solve_with_spare_joints
from pisigma.model.stored_starts import StoredStarts, nearest_branch
from pisigma.robot.kinematics import tolerances
from pisigma.robot.kinematics.closed_form import closed_form_solver
from pisigma.robot.kinematics.status import Status
from pisigma.robot.kinematics.task_axes import TaskAxes, default_axes
from pisigma.robot.kinematics.task_error import task_error
from pisigma.robot.se3 import check_transforms, pose_error, transform_faults

NUMERIC = "numeric"
"""Name of the only branch of a robot without closed-form inverse: the one of the nearest training rows."""


class ReferenceIK:
    """The corrected inverse kinematics of a model: call it with poses. Solutions are tensors in float64 on the CPU.

    Attributes:
        model: the model.
        branches: names of the branches.
        order: indices of the branches: those that training rows lie on, most frequent first, then the others.
        arm: its identified arm, where it has one and the nominal one a closed form.
        axes: which axes of the tool count.
    """

    def __init__(self, model: CalibratedModel, axes: TaskAxes | None = None) -> None:
        """Prepare a model.

        Args:
            model: the model.
            axes: which axes of the tool count; None for those that do by default. The elbow angle has no part here.

        Raises:
            ModelError: the model names branches that its robot does not have, or gives the numeric inverse no
                start.
        """
        self.model, self._solver = model, closed_form_solver(model.robot)
        self.branches: tuple[str, ...] = self._solver.branches if self._solver else (NUMERIC,)
        for name in model.branches:
            if name not in self.branches:
                choices = nearest_choice(name, self.branches)
                raise ModelError(f"model '{model.name}': its robot has no branch '{name}'; {choices}")
        if self._solver is None and not len(model.starts):
            raise ModelError(
                f"model '{model.name}': its robot has no closed-form inverse, and the model holds no joint "
                "values to start from; train it again."
            )
        trained = [self.branches.index(name) for name in model.branches] or list(range(len(self.branches)))
        self.order = (*trained, *(index for index in range(len(self.branches)) if index not in trained))
        self._starts = StoredStarts(model.identified, model.starts)
        whole = model.network is not None and self._solver is None
        self.axes = axes or (TaskAxes() if whole else default_axes(model.robot.dof))
        self.arm: IdentifiedArm | None = None
        if model.calibrated is not None and self._solver is not None:
            self.arm = IdentifiedArm(
                model.robot, model.identified, self._solver, self._starts, model.hybrid, self.axes
            )
        self._finishing = Finishing(model, self.branches, trained, self.axes)

    def __call__(
        self,
        T_base_tool: Any,
        *,
        near: Any = None,
        branch: str | None = None,
        throw: bool = True,
        approach: Any = None,
        single: bool | None = None,
        axes: TaskAxes | None = None,
    ) -> Solution:
        """Find corrected joint values for poses; for arguments, errors and what comes back see `CorrectedIK`.

        Where no branch leads to a pose, and none was asked for, it is looked for from stored joint values too, and the
        branch is that whose nominal joint values are nearest.

        Args:
            T_base_tool: `(*batch, 4, 4)`.
            near: `(*batch, dof)` or `(dof,)`.
            branch: name of the branch to take.
            throw: whether what is no pose, or no posture, raises.
            approach: `(*batch, dof)` or `(dof,)`.
            single: whether the poses were rounded to float32; None to see that from their type.
            axes: which axes of the tool count, where these are others than `axes`.
        """
        if axes is not None and axes != self.axes:
            return ReferenceIK(self.model, axes)(
                T_base_tool, near=near, branch=branch, throw=throw, approach=approach, single=single
            )
        if branch is not None and branch not in self.branches:
            raise PoseError(f"there is no branch '{branch}'; {nearest_choice(branch, self.branches)}")
        T, given, fine = _checked_poses(T_base_tool, single, throw)
        start = None
        if near is not None:
            start, finite = self._joint_rows(near, "near", T.shape[:-2], throw)
            fine = fine & finite
        order = self.order if branch is None else (self.branches.index(branch),)
        result = self._by_approach(approach, T.shape[:-2], lambda ik: ik._solve(T, given, start, order))
        return _marked(self._with_residuals(result, T), fine)

    def all_branches(
        self,
        T_base_tool: Any,
        *,
        approach: Any = None,
        single: bool | None = None,
        axes: TaskAxes | None = None,
    ) -> Solution:
        """Solutions on every branch, as `(*batch, branches)`; one for a robot without closed-form inverse."""
        if axes is not None and axes != self.axes:
            return ReferenceIK(self.model, axes).all_branches(T_base_tool, approach=approach, single=single)
        T, given, _ = _checked_poses(T_base_tool, single, True)
        result = self._by_approach(approach, T.shape[:-2], lambda ik: ik._solve_branches(T, given))
        return self._with_residuals(result, T.unsqueeze(-3).expand(*result.status.shape, 4, 4))

    def _by_approach(
        self, approach: Any, batch: Sequence[int], solve: Callable[["ReferenceIK"], Solution]
    ) -> Solution:
        """Solve for poses, once for every combination of sides that some of them are to be reached from."""
        hybrid = self.model.hybrid
        if approach is None or hybrid is None:
            return solve(self)
        sides, _ = self._joint_rows(checked_approach(approach), "approach", batch, True)
        kinds, index = torch.unique(sides.reshape(-1, sides.shape[-1]), dim=0, return_inverse=True)
        result = solve(self) if not len(kinds) else None
        for kind, side in enumerate(kinds):
            arm = replace(hybrid, approach=side)
            solved = solve(ReferenceIK(replace(self.model, hybrid=arm), self.axes))
            result = solved if result is None else _where(index.reshape(tuple(batch)) == kind, solved, result)
        assert result is not None
        return result

    def _joint_rows(self, values: Any, what: str, batch: Sequence[int], throw: bool) -> tuple[Tensor, Tensor]:
        """Joint values for every pose, and where they are finite; elsewhere they are 0.

        Raises:
            PoseError: they do not fit, or are not finite and `throw`.
        """
        try:
            rows = torch.from_numpy(np.array(as_array(values), dtype=np.float64))
        except (TypeError, ValueError):
            raise PoseError(
                f"{what} is no array of numbers; give joint values of shape (*batch, joints)."
            ) from None
        self.model.robot.check_joint_count(rows.shape[-1] if rows.ndim else 0)
        finite = torch.isfinite(rows)
        if throw and not finite.all():
            raise PoseError(
                f"{what} holds joint values that are no finite numbers; give a number for every joint."
            )
        try:
            rows = torch.where(finite, rows, 0.0).expand(*batch, rows.shape[-1])
        except RuntimeError:
            raise PoseError(
                f"{what} has the batch shape {tuple(rows.shape[:-1])}, which does not broadcast to "
                f"{tuple(batch)} of the poses; give one row of joint values for each pose, or one for all."
            ) from None
        return rows, finite.all(-1).expand(*batch)

    def _with_residuals(self, result: Solution, T: Tensor) -> Solution:
        """The same with translation [m] and angle [rad] from where the tool goes to where it was to go."""
        q = result.q.reshape(-1, result.q.shape[-1])
        left = torch.full((len(q), 6), torch.nan, dtype=torch.float64)
        rows = torch.isfinite(q).all(-1).nonzero()[:, 0]
        if len(rows):
            reached = self.model.forward(q[rows])
            wanted, safe = T.reshape(-1, 4, 4)[rows], torch.nan_to_num(reached)
            error = pose_error(wanted, safe) if self.axes.whole else task_error(self.axes, wanted, safe)[0]
            left[rows] = torch.where(torch.isfinite(reached).flatten(1).all(-1)[:, None], error, torch.nan)
        left = left.reshape(*result.status.shape, 6)
        if not self.axes.whole:
            result = _without(result, ~tolerated(self.axes, left.nan_to_num()), Status.UNREACHABLE)
            left = torch.where(torch.tensor(self.axes.free), 0.0 * left, left)
        position, rotation = left[..., :3].norm(dim=-1), left[..., 3:].norm(dim=-1)
        return replace(
            result, position_residual=position, rotation_residual=rotation, ignored_axes=self.axes.ignored
        )

    def _solve(self, T: Tensor, given: Tensor, near: Tensor | None, order: Sequence[int]) -> Solution:
        """Find a solution for every pose.

        Args:
            T: `(*batch, 4, 4)` poses T_base_tool, float64 on the CPU.
            given: the same as they were given; the closed form is computed in their dtype.
            near: `(*batch, dof)` joint values [rad or m] to be near to, or None.
            order: indices of the branches that will do, the better ones first; `near` only chooses the turns where
                that is one.
        """
        if self._solver is None:
            return self._numeric(T, near)
        free = len(order) == len(self.branches)
        if near is not None and free:
            every = self._on_branches(T, given, near, range(len(self.branches)))
            result = _on_branch(every, self._nearest(every, near))
        else:
            result = self._in_order(T, given, near, order)
        if self.arm is not None:
            result = self._recovered(T, result, near, anywhere=free)
            if near is not None and free:
                result = self._continued(T, result, near)
        return result

    def _solve_branches(self, T: Tensor, given: Tensor) -> Solution:
        """Solutions on every branch, as a last batch axis."""
        if self._solver is None:
            return self._numeric(T, None).map(lambda values: values.unsqueeze(T.ndim - 2))
        every = self._on_branches(T, given, None, range(len(self.branches)))
        if self.arm is None:
            return every
        each = T.unsqueeze(-3).expand(*every.status.shape, 4, 4)
        return self._recovered(each, every, None, anywhere=False)

    def _in_order(self, T: Tensor, given: Tensor, near: Tensor | None, order: Sequence[int]) -> Solution:
        """On the first branch that leads to the pose inside the limits, else on the first that leads there at all."""
        if self.arm is None:  # all branches cost little
            return self._first(self._on_branches(T, given, near, range(len(self.branches))), order)
        result = self._first(self._on_branches(T, given, near, order[:1]), (0,))
        status = result.status.reshape(-1)
        rows = ((status == Status.UNREACHABLE) | (status == Status.OUTSIDE_JOINT_LIMITS)).nonzero()[:, 0]
        if not len(rows) or len(order) == 1:
            return result
        beside = None if near is None else near.reshape(-1, near.shape[-1])[rows]
        as_given = given.reshape(-1, 4, 4)[rows]
        every = self._on_branches(T.reshape(-1, 4, 4)[rows], as_given, beside, order)
        return _with_rows(result, rows, self._first(every, range(len(order))))

    def _first(self, every: Solution, order: Sequence[int]) -> Solution:
        """Of solutions on some branches the first in an order that is inside the limits, else outside, else any."""
        status = every.status[..., torch.tensor(tuple(order))]
        rank = (status == Status.OUTSIDE_JOINT_LIMITS).long() + 2 * (status == Status.UNREACHABLE).long()
        place = (torch.arange(len(order)) + len(order) * rank).argmin(-1)
        return _on_branch(every, torch.tensor(tuple(order))[place])

    def _on_branches(self, T: Tensor, given: Tensor, near: Tensor | None, indices: Sequence[int]) -> Solution:
        """Solutions on some branches, as a last batch axis, each from its nominal joint values on."""
        assert self._solver is not None
        result = self._solver.solve(levelled(self._solver, given, self.axes))
        branch = torch.tensor(indices).expand(*T.shape[:-2], len(indices))
        q, status = result.q[..., indices, :].double(), result.status[..., indices]
        each = T.unsqueeze(-3).expand(*branch.shape, 4, 4)
        beside = None if near is None else near.unsqueeze(-2).expand(*branch.shape, -1)
        if self.arm is None:
            return self._finishing.of_nominal(each, q, status, branch, beside)
        reached, status = self.arm.follow(each, q)
        return self._finishing.of_identified(each, reached, q, status, branch, beside)

    def _recovered(self, T: Tensor, result: Solution, near: Tensor | None, anywhere: bool) -> Solution:
        """Look again for what was not found, where the identified arm reaches and the nominal one does not.

        Any other branch than the wanted one will do where `anywhere`.
        """
        assert self.arm is not None
        lost = (result.status == Status.UNREACHABLE).reshape(-1).nonzero()[:, 0]
        if not len(lost):
            return result
        T_lost, branch = T.reshape(-1, 4, 4)[lost], result.branch.reshape(-1)[lost]
        q, status, branch = self.arm.recover(T_lost, branch, torch.full((len(lost),), anywhere))
        beside = None if near is None else near.reshape(-1, q.shape[-1])[lost]
        nominal = torch.full_like(q, torch.nan)
        finished = self._finishing.of_identified(T_lost, q, nominal, status, branch, beside)
        return _with_rows(result, lost, finished)

    def _continued(self, T: Tensor, result: Solution, near: Tensor) -> Solution:
        """Look from `near` itself where nothing was found close to it.

        Near singular poses the nominal arm may lack the branch on which the identified one is.
        """
        assert self.arm is not None
        q_near, q_found = near.reshape(-1, near.shape[-1]), result.q.reshape(-1, near.shape[-1])
        off = (q_found - q_near).norm(dim=-1).nan_to_num(torch.inf)
        away = (off > tolerances.AWAY).nonzero()[:, 0]
        T_away, start = T.reshape(-1, 4, 4)[away], q_near[away]
        q, status = search(self.arm.identified, T_away, start[:, None], self.model.hybrid, axes=self.axes)
        lies = nearest_branch(self.arm.solver, q)
        nominal, _ = search(self.model.robot, T_away, q[:, None], axes=self.axes)
        other = self._finishing.of_identified(T_away, q, nominal, status, lies, start)
        good = (other.status != Status.UNREACHABLE) & (other.status != Status.OUTSIDE_JOINT_LIMITS)
        kept = (good & ((other.q - start).norm(dim=-1) < off[away])).nonzero()[:, 0]
        return _with_rows(result, away[kept], other.select(kept))

    def _numeric(self, T: Tensor, near: Tensor | None) -> Solution:
        """Numeric inverse from `near`, then from the training rows whose poses are nearest, then from more of them."""
        flat, dof = T.reshape(-1, 4, 4), self.model.robot.dof
        if self.model.network is None and sum(self.axes.weights(dof)) < dof:
            beside = None if near is None else near.reshape(-1, dof)
            q, status = solve_with_spare_joints(self._starts, self.model.hybrid, flat, beside, self.axes)
            return self._finished_numeric(T, q, status, near)
        starts = self.model.starts[self._starts.nearest(flat, tolerances.ATTEMPTS, self.axes)]
        if near is not None:
            starts = torch.cat([near.reshape(-1, 1, dof), starts], 1)
        q, status = search(self._starts.robot, flat, starts, self.model.hybrid, axes=self.axes)
        left = ((status == Status.UNREACHABLE) | (status == Status.OUTSIDE_JOINT_LIMITS)).nonzero()[:, 0]
        if len(left):
            more = self.model.starts[self._starts.nearest(flat[left], tolerances.MORE_ATTEMPTS, self.axes)]
            other, fate = search(
                self._starts.robot, flat[left], more, self.model.hybrid, inside=True, axes=self.axes
            )
            better = (status[left] == Status.UNREACHABLE) | (fate < Status.OUTSIDE_JOINT_LIMITS)
            q[left[better]], status[left[better]] = other[better], fate[better]
        return self._finished_numeric(T, q, status, near)

    def _finished_numeric(self, T: Tensor, q: Tensor, status: Tensor, near: Tensor | None) -> Solution:
        """Solutions from joint values `(poses, dof)` that reach all poses, one after the other."""
        flat, shape, dof = T.reshape(-1, 4, 4), T.shape[:-2], q.shape[-1]
        branch = torch.zeros(shape, dtype=torch.int64)
        if self.model.calibrated is None:
            return self._finishing.of_nominal(T, q.reshape(*shape, dof), status.reshape(shape), branch, near)
        nominal, _ = search(self.model.robot, flat, q[:, None], axes=self.axes)
        q, nominal = (values.reshape(*shape, dof) for values in (q, nominal))
        return self._finishing.of_identified(T, q, nominal, status.reshape(shape), branch, near)

    def _nearest(self, every: Solution, near: Tensor) -> Tensor:
        """Index of the branch nearest to `near`: of those that reach, else of those outside limits."""
        distance = (every.q - near.unsqueeze(-2)).square().sum(-1)
        lost = every.status == Status.UNREACHABLE
        rank = (every.status == Status.OUTSIDE_JOINT_LIMITS).long() + 2 * lost.long()
        distance = torch.where(rank == rank.amin(-1, keepdim=True), distance, torch.inf)
        return torch.where(lost.all(-1), self.order[0], distance.argmin(-1))


def _checked_poses(values: Any, single: bool | None, throw: bool) -> tuple[Tensor, Tensor, Tensor]:
    """The poses in float64 and in the type that they were given in, and which of them are poses; others are identities.

    Raises:
        PoseError: see `pose_array`; a matrix is no pose, and `throw`.
    """
    array, rounded = pose_array(values)
    T = torch.from_numpy(np.array(array))
    single = rounded if single is None else single
    tolerance = tolerances.POSE_TOLERANCE_SINGLE if single else tolerances.POSE_TOLERANCE
    if throw:
        check_transforms(T, "T_base_tool", tolerance)
    fine = ~torch.stack([bad for bad, _ in transform_faults(T, tolerance)]).any(0)
    T = torch.where(fine[..., None, None], T, torch.eye(4, dtype=torch.float64))
    return T, T.float() if single else T, fine


def _marked(result: Solution, fine: Tensor) -> Solution:
    """The solutions, INVALID_POSE and NaN where there was no pose to solve for."""
    return _without(result, ~fine, Status.INVALID_POSE)


def _without(result: Solution, lost: Tensor, status: Status) -> Solution:
    """The solutions, NaN and with another status where something holds."""
    if not bool(lost.any()):
        return result
    nothing = result.map(
        lambda values: torch.full_like(values, torch.nan) if values.is_floating_point() else values
    )
    kept = _where(lost, nothing, result)
    return replace(kept, status=torch.where(lost, int(status), result.status))


def _where(condition: Tensor, first: Solution, second: Solution) -> Solution:
    """One solution where a condition holds, another elsewhere."""

    def choose(values: Tensor, others: Tensor) -> Tensor:
        axes = values.ndim - condition.ndim
        return torch.where(condition.reshape(*condition.shape, *(1,) * axes), values, others)

    return first.map(choose, second)


def _on_branch(every: Solution, index: Tensor) -> Solution:
    """Of solutions whose last batch axis is the branch, one per pose."""
    axis = index.ndim

    def pick(values: Tensor) -> Tensor:
        place = index.reshape(*index.shape, *(1,) * (values.ndim - axis))
        return torch.take_along_dim(values, place, axis).squeeze(axis)

    return every.map(pick)


def _with_rows(result: Solution, index: Tensor, rows: Solution) -> Solution:
    """The same with other solutions at an index that counts through all batch axes."""
    batch = result.status.ndim

    def put(values: Tensor, others: Tensor) -> Tensor:
        flat = values.reshape(-1, *values.shape[batch:])
        return flat.index_copy(0, index, others).reshape(values.shape)

    return result.map(put, rows)
