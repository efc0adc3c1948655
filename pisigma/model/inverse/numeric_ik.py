"""Corrected inverse kinematics in torch, for models or machines without compiled kernels."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pisigma.files.errors import ModelError, PoseError, check_choice
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.inverse.joint_input import checked_approach, fault_error, joint_rows, pose_array
from pisigma.model.inverse.numeric_arm import NumericArm
from pisigma.model.inverse.solution import Solution
from pisigma.model.stored_starts import SAME, StoredStarts, nearest_branch
from pisigma.robot.kernels.arrays import NEAR_NOT_FINITE
from pisigma.robot.kinematics import tolerances
from pisigma.robot.kinematics.closed_form import closed_form_solver
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.joint_limits import nearest_turn, wrap_into_limits
from pisigma.robot.kinematics.numeric import solve_numeric
from pisigma.robot.kinematics.status import Status
from pisigma.robot.kinematics.task_axes import TaskAxes, default_axes
from pisigma.robot.kinematics.task_error import is_within_tolerances, task_error
from pisigma.robot.se3 import check_transforms, pose_error, transform_faults

NUMERIC = "numeric"
"""Name of the only branch of a robot without a closed-form inverse."""
_OUTSIDE, _LOST = 1e9, 1e15
"""Penalties on the rank of solutions outside the joint limits and of starts that do not converge."""


class NumericIK:
    """Iterative corrected inverse kinematics of a model; solutions are float64 tensors on the CPU.

    Every pose is solved by damped Newton steps, which take a few milliseconds each, from several starts: the nominal
    arm's branches (or the nearest joint values if they do not reach the pose), `near`, and stored joint values with the
    nearest poses. The best solution is returned.

    Attributes:
        model: calibrated model.
        branches: names of the branches.
        branch_order: indices of the branches: those of training rows, most frequent first, then all others.
        task_axes: axes of the tool that are constrained.
    """

    def __init__(self, model: CalibratedModel, axes: TaskAxes | None = None) -> None:
        """Prepare a model.

        Args:
            model: calibrated model.
            axes: axes of the tool that are constrained; None for the default axes.

        Raises:
            ModelError: the model states branches that its robot lacks, or has no initial values for the numeric
                inverse.
            PoseError: an elbow angle is given, which only the kernels support.
        """
        self.model, self._solver = model, closed_form_solver(model.robot)
        self.branches: tuple[str, ...] = self._solver.branches if self._solver else (NUMERIC,)
        for name in model.branches:
            check_choice(ModelError, "branches", name, self.branches)
        if self._solver is None and not len(model.starts):
            raise ModelError(
                f"the robot of model '{model.name}' has no closed-form inverse, and the model has no initial joint "
                "values",
                value="starts",
                remedy="train it again",
            )
        trained = [self.branches.index(name) for name in model.branches] or list(range(len(self.branches)))
        self.branch_order = (
            *trained,
            *(index for index in range(len(self.branches)) if index not in trained),
        )
        self._trained = torch.tensor(trained)
        whole = model.network is not None and self._solver is None
        self.task_axes = axes or (TaskAxes() if whole else default_axes(model.robot.dof))
        if self.task_axes.elbow_angle is not None:
            raise PoseError(
                f"the argument requires compiled kernels, which are not available for model '{model.name}'",
                value=self.task_axes.elbow_angle,
                option="elbow_angle",
                remedy="omit it",
            )
        self._network = model.network if model.calibrated is None else None
        self._arm = NumericArm(model.robot, model.identified, model.hybrid, self.task_axes)
        self._spare = self._arm.has_spare_joints and self._network is None
        self._stored = StoredStarts(model.identified, model.starts.double().cpu())

    def solve_batch(
        self,
        T_base_tool: Any,
        *,
        near: Any = None,
        branch: str | None = None,
        throw: bool = True,
        approach: Any = None,
        is_float32: bool | None = None,
        axes: TaskAxes | None = None,
    ) -> Solution:
        """Find corrected joint values for poses; see `CorrectedIK` for arguments, errors and solutions.

        Args:
            T_base_tool: target poses `(*batch, 4, 4)` [m].
            near: joint values or directions, `(*batch, dof)` or `(dof,)`.
            branch: name of the branch to use.
            throw: whether invalid poses and joint values raise an error.
            approach: joint values or directions, `(*batch, dof)` or `(dof,)`.
            is_float32: whether the poses were rounded to float32; None to infer it from their type.
            axes: axes of the tool that are constrained; None for `task_axes`.
        """
        if branch is not None:
            check_choice(PoseError, "branch", branch, self.branches)
        requested = self.branch_order if branch is None else (self.branches.index(branch),)
        poses = _Poses.from_values(T_base_tool, is_float32, throw)
        valid, near_rows = poses.valid, None
        if near is not None:
            near_rows = self._joint_rows(near, "near", poses, throw)
            valid = valid & torch.isfinite(near_rows).all(-1)

        def solve(ik: "NumericIK", rows: Tensor) -> Solution:
            start = None if near_rows is None else near_rows[rows].nan_to_num()
            return _best(*ik._candidates(poses.T[rows], poses.single, start, requested), requested)

        result = self._by_approach(approach, poses, axes, solve)
        return _without(result, ~valid, Status.INVALID_POSE).map(poses.shaped)

    def all_branches(
        self,
        T_base_tool: Any,
        *,
        approach: Any = None,
        is_float32: bool | None = None,
        axes: TaskAxes | None = None,
    ) -> Solution:
        """Find solutions on every branch, `(*batch, branches)`; a robot that is solved numerically has one branch."""
        poses = _Poses.from_values(T_base_tool, is_float32, True)

        def solve(ik: "NumericIK", rows: Tensor) -> Solution:
            every = ik._candidates(poses.T[rows], poses.single, None, ik.branch_order)
            own = [_best(*every, (index,)) for index in range(len(ik.branches))]
            return own[0].map(lambda *values: torch.stack(values, 1), *own[1:])

        return self._by_approach(approach, poses, axes, solve).map(poses.shaped)

    def _by_approach(
        self,
        approach: Any,
        poses: "_Poses",
        axes: TaskAxes | None,
        solve: Callable[["NumericIK", Tensor], Solution],
    ) -> Solution:
        """Solve rows of poses in groups of equal approach directions."""
        ik = self if axes is None or axes == self.task_axes else NumericIK(self.model, axes)
        hybrid, rows = self.model.hybrid, torch.arange(len(poses.T))
        if approach is None or hybrid is None or not len(rows):
            return solve(ik, rows)
        sides = self._joint_rows(checked_approach(approach), "approach", poses, True)
        kinds, index = torch.unique(sides, dim=0, return_inverse=True)
        parts = []
        for kind, side in enumerate(kinds):
            model = replace(self.model, hybrid=replace(hybrid, approach=side))
            parts.append(solve(NumericIK(model, ik.task_axes), (index == kind).nonzero()[:, 0]))
        place = index.argsort(stable=True).argsort()
        return parts[0].map(lambda *values: torch.cat(values)[place], *parts[1:])

    def _joint_rows(self, values: Any, what: str, poses: "_Poses", throw: bool) -> Tensor:
        """Return joint values as `(poses, dof)`, one row for every pose.

        Raises:
            PoseError: the shape is wrong, or values are not finite and `throw` is True.
        """
        joints = [joint.name for joint in self.model.robot.joints]
        rows = torch.tensor(joint_rows(values, poses.batch, what, throw, joints))
        if throw and not bool(torch.isfinite(rows).all()):
            raise fault_error(NEAR_NOT_FINITE)
        return rows.expand(len(poses.T), -1)

    def _candidates(
        self, T: Tensor, single: bool, near: Tensor | None, requested: Sequence[int]
    ) -> tuple[Solution, Tensor]:
        """Find solutions `(poses, starts)` from all starts, and their ranks; the lowest rank is best."""
        starts, branch = self._starts(T, single)
        plausible = torch.isfinite(starts).all(-1).any(1) | (self._solver is None)
        if near is not None and len(requested) == len(self.branches):
            starts = torch.cat([starts, near[:, None]], 1)
        numeric = self._solver is None or self._spare
        if numeric:
            few = self._stored.q[self._stored.nearest(T, tolerances.ATTEMPTS, self.task_axes)]
            starts = torch.cat([starts, few], 1)
        unknown = branch.new_full((len(T), starts.shape[1] - branch.shape[1]), -1)
        every, rank = self._solved(T, starts, torch.cat([branch, unknown], 1), near)
        # Only poses that no start solves are tried from additional starts.
        lost = ((_among(every, rank, requested) >= _OUTSIDE).all(1) & plausible).nonzero()[:, 0]
        if not len(lost):
            return every, rank
        attempts = tolerances.MORE_ATTEMPTS if numeric else tolerances.ATTEMPTS
        more = self._stored.q[self._stored.nearest(T[lost], attempts, self.task_axes)]
        starts = more.new_full((len(T), *more.shape[1:]), torch.nan).index_copy(0, lost, more)
        others, ranks = self._solved(T, starts, branch.new_full(starts.shape[:2], -1), near)
        return every.map(lambda *values: torch.cat(values, 1), others), torch.cat([rank, ranks], 1)

    def _starts(self, T: Tensor, single: bool) -> tuple[Tensor, Tensor]:
        """Return nominal joint values `(poses, branches, dof)` and their branches, -1 if they do not reach the pose.

        Joint values that do not reach the pose are as near to it as possible, or NaN.
        """
        if self._solver is None:
            return T.new_zeros(len(T), 0, self.model.robot.dof), torch.zeros(len(T), 0, dtype=torch.int64)
        # A SCARA cannot tilt its tool, so its closed form gets the upright pose if the tilt is ignored.
        if len(self.model.robot.joints) == 4 and all(self.task_axes.tolerance[3:5]):
            T = self._solver.upright_poses(T)
        q, near_rows = self._solver.solve(T.float() if single else T).q.double(), self._solver.start_values(T)
        reached, robot = torch.isfinite(q).all(-1), self.model.identified
        # The calibrated arm may reach poses that the nominal arm just misses, so iterations start at the nearest joint
        # values, unless these miss the pose by far more than geometric errors explain. Lengths are divided by the reach
        # to be added to angles.
        each = T[:, None].expand(*near_rows.shape[:-1], 4, 4).reshape(-1, 4, 4)
        off, _ = task_error(self.task_axes, each, forward_kinematics(robot, near_rows.reshape(-1, robot.dof)))
        off = off * off.new_tensor([*[1 / robot.reach] * 3, 1, 1, 1]) * off.new_tensor(self._arm.weights)
        plausible = (off.norm(dim=-1) <= tolerances.BRANCH_MISS).reshape(reached.shape)
        q = torch.where(reached[..., None], q, torch.where(plausible[..., None], near_rows, torch.nan))
        known = torch.arange(q.shape[1]).expand(len(T), -1)
        return q, torch.where(reached & (not self._spare), known, -1)

    def _solved(
        self, T: Tensor, starts: Tensor, branch: Tensor, near: Tensor | None
    ) -> tuple[Solution, Tensor]:
        """Solve poses within reach from the starts that are not NaN, and return solutions and ranks."""
        usable = torch.isfinite(starts).all(-1) & self._arm.within_reach(T)[:, None]
        pose, place = usable.nonzero().unbind(1)
        start, known = starts[pose, place], branch[pose, place] >= 0
        q, reached = self._arm.iterate_to_poses(T[pose], start)
        if self.model.calibrated is None:  # the closed form already allows for the rounding of the pose
            q, reached = torch.where(known[:, None], start, q), known | reached
        kept = reached.nonzero()[:, 0]
        pose, place = pose[kept], place[kept]
        near_rows = None if near is None else near[pose]
        solution, rank = self._finished(T[pose], q[kept], start[kept], branch[pose, place], near_rows)
        index = pose * branch.shape[1] + place

        def spread(values: Tensor, nothing: float = 0.0) -> Tensor:
            every = values.new_full((branch.numel(), *values.shape[1:]), nothing)
            return every.index_copy(0, index, values).reshape(*branch.shape, *values.shape[1:])

        return solution.map(spread), spread(rank, _LOST)

    def _finished(
        self, T: Tensor, q: Tensor, start: Tensor, branch: Tensor, near: Tensor | None
    ) -> tuple[Solution, Tensor]:
        """Return solutions and their ranks from joint values that reach poses.

        Args:
            T: `(rows, 4, 4)` target poses.
            q: `(rows, dof)` joint values of the identified arm, or nominal joint values that a network corrects.
            start: joint values from which the iteration started.
            branch: branch of the starts that reach the pose, otherwise -1.
            near: joint values near which the solutions should be, or None.
        """
        robot, known = self.model.robot, branch >= 0
        if self._spare:
            q = self._arm.with_redundancy_resolved(T, q, near)
        nearest = torch.zeros_like(branch) if self._solver is None else nearest_branch(self._solver, q)
        branch = torch.where(known, branch, nearest)
        nominal = self._nominal(T, torch.where(known[:, None], start, q), known)
        q, measure = self._corrected(T, q)
        commanded, inside = wrap_into_limits(robot, q)
        if near is not None:
            commanded = nearest_turn(robot, commanded, near, within_limits=True)
        reached = torch.ones_like(inside)
        if self.model.hybrid is not None:
            if not self.model.hybrid.correction.is_periodic:  # the correction depends on the turn of a joint
                commanded, reached = self._arm.iterate_to_poses(T, commanded)
                inside = (wrap_into_limits(robot, commanded)[0] == commanded).all(-1) & inside
            measure = 1 + self.model.hybrid.coverage.distance_outside(commanded).amax(-1)
        nominal = nearest_turn(robot, nominal, commanded, within_limits=False)
        singular = self._arm.singularity_measure(T, nominal if self._network else commanded)
        status = torch.where(
            self._is_outside(measure, branch), int(Status.OUTSIDE_DOMAIN), int(Status.REACHED)
        )
        status = torch.where(singular < tolerances.SINGULAR_TOLERANCE, int(Status.SINGULAR), status)
        status = torch.where(inside, status, int(Status.OUTSIDE_JOINT_LIMITS))
        error = self._error(T, self.model.forward(commanded))
        reached = reached & is_within_tolerances(self.task_axes, error.nan_to_num())
        error = torch.where(torch.tensor(self.task_axes.free), 0.0 * error, error)
        left = error[:, :3].norm(dim=-1), error[:, 3:].norm(dim=-1)
        rank = self._rank(T, commanded, branch, near) + torch.where(inside, 0.0, _OUTSIDE)
        solution = Solution(commanded, nominal, branch, self.branches, status, *left, measure)
        return replace(solution, ignored_axes=self.task_axes.ignored), torch.where(reached, rank, _LOST)

    def _nominal(self, T: Tensor, q: Tensor, known: Tensor) -> Tensor:
        """Return the nominal arm's joint values near q, or q where these are `known`; NaN if there is no solution."""
        if self.model.calibrated is None:
            return q
        solved = solve_numeric(self.model.robot, T, q, axes=self.task_axes, weights=self._arm.weights)
        found = torch.where((solved.status != Status.NOT_CONVERGED)[:, None], solved.q, torch.nan)
        return torch.where(known[:, None], q, found)

    def _corrected(self, T: Tensor, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return joint values with the network's correction added, and the domain measure."""
        measure = torch.full((len(T),), torch.nan, dtype=torch.float64)
        if self._network is None:
            return q, measure
        turned = self.model.wrapped_near_training(q)
        if self.model.domain is not None:
            measure = self.model.domain.measure(self._network.scaled_inputs(T, turned))
        return q + self.model.correction(T, turned), measure

    def _is_outside(self, measure: Tensor, branch: Tensor) -> Tensor:
        """Return whether solutions are outside the measured region."""
        if self.model.hybrid is not None:
            return measure > 1 + tolerances.MEASURED_ROUNDING
        if self._network is None or self.model.domain is None:
            return torch.zeros_like(branch, dtype=torch.bool)
        return ~(measure <= 1) | ~torch.isin(branch, self._trained)

    def _error(self, T: Tensor, reached: Tensor) -> Tensor:
        """Compute the residuals [m, rad] in the axes of the tool; NaN where the model has no prediction."""
        known = torch.isfinite(reached).flatten(1).all(-1)[:, None]
        safe = torch.nan_to_num(reached)
        error = pose_error(T, safe) if self.task_axes.is_exact else task_error(self.task_axes, T, safe)[0]
        return torch.where(known, error, torch.nan)

    def _rank(self, T: Tensor, q: Tensor, branch: Tensor, near: Tensor | None) -> Tensor:
        """Return the ranks of joint values by distance from `near`, by `posture_rating`, or by branch."""
        if near is not None:
            rank: Tensor = ((q - near).norm(dim=-1) / SAME).round()
        elif self._spare:
            rank = -self._arm.posture_rating(T, q)
        else:
            rank = torch.tensor(self.branch_order).argsort()[branch].double()
        return rank


@dataclass(frozen=True)
class _Poses:
    """Checked poses as rows.

    Attributes:
        T: `(poses, 4, 4)`, the identity for invalid poses.
        valid: mask of the valid poses.
        single: whether the poses were rounded to float32.
        batch: batch shape of the argument.
    """

    T: Tensor
    valid: Tensor
    single: bool
    batch: tuple[int, ...]

    @staticmethod
    def from_values(values: Any, single: bool | None, throw: bool) -> "_Poses":
        """Convert and check poses.

        Raises:
            PoseError: the argument is invalid, see `pose_array`, or a matrix is not a valid pose and `throw` is True.
        """
        array, rounded, _ = pose_array(values)
        T = torch.from_numpy(np.array(array))
        single = rounded if single is None else single
        tolerance = tolerances.POSE_TOLERANCE_SINGLE if single else tolerances.POSE_TOLERANCE
        if throw:
            check_transforms(T, "T_base_tool", tolerance)
        rows = T.reshape(-1, 4, 4)
        valid = ~torch.stack([bad for bad, *_ in transform_faults(rows, tolerance)]).any(0)
        rows = torch.where(valid[:, None, None], rows, torch.eye(4, dtype=torch.float64))
        return _Poses(rows, valid, single, tuple(T.shape[:-2]))

    def shaped(self, values: Tensor) -> Tensor:
        """Return values of the rows in the batch shape of the argument."""
        return values.reshape((*self.batch, *values.shape[1:]))


def _among(every: Solution, rank: Tensor, branches: Sequence[int]) -> Tensor:
    """Return ranks of solutions, with `_LOST` on branches that are not requested."""
    return torch.where(torch.isin(every.branch, torch.tensor(branches)), rank, _LOST)


def _best(every: Solution, rank: Tensor, branches: Sequence[int]) -> Solution:
    """Return the best solution of every pose on the requested branches."""
    least, index = _among(every, rank, branches).min(1)
    lost = least >= _LOST
    best = every.map(lambda values: values[torch.arange(len(index)), index])
    best = replace(best, branch=torch.where(lost, branches[0], best.branch))
    return _without(best, lost, Status.UNREACHABLE)


def _without(result: Solution, lost: Tensor, status: Status) -> Solution:
    """Return solutions with NaN and the given status where `lost`."""

    def kept(values: Tensor) -> Tensor:
        where = lost.reshape(-1, *[1] * (values.ndim - 1))
        return torch.where(where, torch.nan, values) if values.is_floating_point() else values

    return replace(result.map(kept), status=torch.where(lost, int(status), result.status))
