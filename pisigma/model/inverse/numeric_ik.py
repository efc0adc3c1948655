"""Corrected inverse kinematics in torch, for models and machines without compiled kernels: some milliseconds a pose."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pisigma.files.errors import ModelError, PoseError, nearest_choice
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.inverse.joint_input import FAULTS, checked_approach, joint_rows, pose_array
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
from pisigma.robot.kinematics.task_error import task_error, tolerated
from pisigma.robot.se3 import check_transforms, pose_error, transform_faults

NUMERIC = "numeric"
"""Name of the only branch of a robot without closed-form inverse."""
_OUTSIDE, _LOST = 1e9, 1e15
"""What is added to the rank of joint values outside their limits, and of starts that lead nowhere."""


class NumericIK:
    """The corrected inverse kinematics of a model. Solutions are tensors in float64 on the CPU.

    Every pose is solved from several starts by damped Newton steps: the branches of the nominal arm, those that do not
    reach the pose as near as they come, `near`, and stored joint values whose poses are nearest. The best of all that
    lead there is taken.

    Attributes:
        model: the model.
        branches: names of the branches.
        order: indices of the branches: those that training rows lie on, most frequent first, then the others.
        axes: which axes of the tool count.
    """

    def __init__(self, model: CalibratedModel, axes: TaskAxes | None = None) -> None:
        """Prepare a model.

        Args:
            model: the model.
            axes: which axes of the tool count; None for those that do by default.

        Raises:
            ModelError: the model names branches that its robot does not have, or gives the numeric inverse no
                start.
            PoseError: an elbow angle is wanted, which only kernels solve for.
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
        self._trained = torch.tensor(trained)
        whole = model.network is not None and self._solver is None
        self.axes = axes or (TaskAxes() if whole else default_axes(model.robot.dof))
        if self.axes.elbow_angle is not None:
            raise PoseError(
                f"model '{model.name}' is solved without compiled kernels, which alone know elbow_angle; leave it out."
            )
        self._network = model.network if model.calibrated is None else None
        self._arm = NumericArm(model.robot, model.identified, model.hybrid, self.axes)
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
        single: bool | None = None,
        axes: TaskAxes | None = None,
    ) -> Solution:
        """Find corrected joint values for poses; for arguments, errors and what comes back see `CorrectedIK`.

        Args:
            T_base_tool: `(*batch, 4, 4)`.
            near: `(*batch, dof)` or `(dof,)`.
            branch: name of the branch to take.
            throw: whether what is no pose, or no posture, raises.
            approach: `(*batch, dof)` or `(dof,)`.
            single: whether the poses were rounded to float32; None to see that from their type.
            axes: which axes of the tool count, where these are others than `axes`.
        """
        if branch is not None and branch not in self.branches:
            raise PoseError(f"there is no branch '{branch}'; {nearest_choice(branch, self.branches)}")
        wanted = self.order if branch is None else (self.branches.index(branch),)
        poses = _Poses.of(T_base_tool, single, throw)
        fine, beside = poses.fine, None
        if near is not None:
            beside = self._joint_rows(near, "near", poses, throw)
            fine = fine & torch.isfinite(beside).all(-1)

        def solve(ik: "NumericIK", rows: Tensor) -> Solution:
            start = None if beside is None else beside[rows].nan_to_num()
            return _best(*ik._candidates(poses.T[rows], poses.single, start, wanted), wanted)

        result = self._by_approach(approach, poses, axes, solve)
        return _without(result, ~fine, Status.INVALID_POSE).map(poses.shaped)

    def all_branches(
        self,
        T_base_tool: Any,
        *,
        approach: Any = None,
        single: bool | None = None,
        axes: TaskAxes | None = None,
    ) -> Solution:
        """Solutions on every branch, as `(*batch, branches)`; one for a robot without closed-form inverse."""
        poses = _Poses.of(T_base_tool, single, True)

        def solve(ik: "NumericIK", rows: Tensor) -> Solution:
            every = ik._candidates(poses.T[rows], poses.single, None, ik.order)
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
        """Solve rows of poses, those together that are to be reached from the same sides."""
        ik = self if axes is None or axes == self.axes else NumericIK(self.model, axes)
        hybrid, rows = self.model.hybrid, torch.arange(len(poses.T))
        if approach is None or hybrid is None or not len(rows):
            return solve(ik, rows)
        sides = self._joint_rows(checked_approach(approach), "approach", poses, True)
        kinds, index = torch.unique(sides, dim=0, return_inverse=True)
        parts = []
        for kind, side in enumerate(kinds):
            model = replace(self.model, hybrid=replace(hybrid, approach=side))
            parts.append(solve(NumericIK(model, ik.axes), (index == kind).nonzero()[:, 0]))
        place = index.argsort(stable=True).argsort()
        return parts[0].map(lambda *values: torch.cat(values)[place], *parts[1:])

    def _joint_rows(self, values: Any, what: str, poses: "_Poses", throw: bool) -> Tensor:
        """Joint values `(poses, dof)`, one row for each pose.

        Raises:
            PoseError: they do not fit, or are not finite and `throw`.
        """
        joints = [joint.name for joint in self.model.robot.joints]
        rows = torch.tensor(joint_rows(values, poses.batch, what, throw, joints))
        if throw and not bool(torch.isfinite(rows).all()):
            raise PoseError(FAULTS[NEAR_NOT_FINITE].format(""))
        return rows.expand(len(poses.T), -1)

    def _candidates(
        self, T: Tensor, single: bool, near: Tensor | None, wanted: Sequence[int]
    ) -> tuple[Solution, Tensor]:
        """Solutions `(poses, starts)` from all starts, and their ranks, of which the lowest is the best."""
        starts, branch = self._starts(T, single)
        plausible = torch.isfinite(starts).all(-1).any(1) | (self._solver is None)
        if near is not None and len(wanted) == len(self.branches):
            starts = torch.cat([starts, near[:, None]], 1)
        numeric = self._solver is None or self._spare
        if numeric:
            few = self._stored.q[self._stored.nearest(T, tolerances.ATTEMPTS, self.axes)]
            starts = torch.cat([starts, few], 1)
        unknown = branch.new_full((len(T), starts.shape[1] - branch.shape[1]), -1)
        every, rank = self._solved(T, starts, torch.cat([branch, unknown], 1), near)
        lost = ((_among(every, rank, wanted) >= _OUTSIDE).all(1) & plausible).nonzero()[:, 0]
        if not len(lost):
            return every, rank
        attempts = tolerances.MORE_ATTEMPTS if numeric else tolerances.ATTEMPTS
        more = self._stored.q[self._stored.nearest(T[lost], attempts, self.axes)]
        starts = more.new_full((len(T), *more.shape[1:]), torch.nan).index_copy(0, lost, more)
        others, ranks = self._solved(T, starts, branch.new_full(starts.shape[:2], -1), near)
        return every.map(lambda *values: torch.cat(values, 1), others), torch.cat([rank, ranks], 1)

    def _starts(self, T: Tensor, single: bool) -> tuple[Tensor, Tensor]:
        """Nominal joint values `(poses, branches, dof)`, and on which branch they are if they reach the pose, else -1.

        Where they do not they come near to it, or are NaN.
        """
        if self._solver is None:
            return T.new_zeros(len(T), 0, self.model.robot.dof), torch.zeros(len(T), 0, dtype=torch.int64)
        if len(self.model.robot.joints) == 4 and all(self.axes.tolerance[3:5]):
            T = self._solver.upright(T)
        q, beside = self._solver.solve(T.float() if single else T).q.double(), self._solver.starts(T)
        reached, robot = torch.isfinite(q).all(-1), self.model.identified
        each = T[:, None].expand(*beside.shape[:-1], 4, 4).reshape(-1, 4, 4)
        off, _ = task_error(self.axes, each, forward_kinematics(robot, beside.reshape(-1, robot.dof)))
        off = off * off.new_tensor([*[1 / robot.reach] * 3, 1, 1, 1]) * off.new_tensor(self._arm.weights)
        plausible = (off.norm(dim=-1) <= tolerances.BRANCH_MISS).reshape(reached.shape)
        q = torch.where(reached[..., None], q, torch.where(plausible[..., None], beside, torch.nan))
        known = torch.arange(q.shape[1]).expand(len(T), -1)
        return q, torch.where(reached & (not self._spare), known, -1)

    def _solved(
        self, T: Tensor, starts: Tensor, branch: Tensor, near: Tensor | None
    ) -> tuple[Solution, Tensor]:
        """Solutions and ranks of starts, of which those that are NaN and of poses beyond the reach are not tried."""
        usable = torch.isfinite(starts).all(-1) & self._arm.within_reach(T)[:, None]
        pose, place = usable.nonzero().unbind(1)
        start, known = starts[pose, place], branch[pose, place] >= 0
        q, reached = self._arm.reach(T[pose], start)
        if self.model.calibrated is None:  # the closed form knows what is rounding of the pose
            q, reached = torch.where(known[:, None], start, q), known | reached
        kept = reached.nonzero()[:, 0]
        pose, place = pose[kept], place[kept]
        beside = None if near is None else near[pose]
        solution, rank = self._finished(T[pose], q[kept], start[kept], branch[pose, place], beside)
        index = pose * branch.shape[1] + place

        def spread(values: Tensor, nothing: float = 0.0) -> Tensor:
            every = values.new_full((branch.numel(), *values.shape[1:]), nothing)
            return every.index_copy(0, index, values).reshape(*branch.shape, *values.shape[1:])

        return solution.map(spread), spread(rank, _LOST)

    def _finished(
        self, T: Tensor, q: Tensor, start: Tensor, branch: Tensor, near: Tensor | None
    ) -> tuple[Solution, Tensor]:
        """Solutions, and their ranks, of joint values that reach poses.

        Args:
            T: `(rows, 4, 4)`.
            q: `(rows, dof)` of the arm as identified; of a network those that it corrects.
            start: where they were found from.
            branch: on which the starts reach the pose, else -1.
            near: joint values to be near to.
        """
        robot, known = self.model.robot, branch >= 0
        if self._spare:
            q = self._arm.settled(T, q, near)
        lies = torch.zeros_like(branch) if self._solver is None else nearest_branch(self._solver, q)
        branch = torch.where(known, branch, lies)
        nominal = self._nominal(T, torch.where(known[:, None], start, q), known)
        q, measure = self._corrected(T, q)
        commanded, inside = wrap_into_limits(robot, q)
        if near is not None:
            commanded = nearest_turn(robot, commanded, near, within_limits=True)
        reached = torch.ones_like(inside)
        if self.model.hybrid is not None:
            if not self.model.hybrid.correction.is_periodic:  # the turns to command are others
                commanded, reached = self._arm.reach(T, commanded)
                inside = (wrap_into_limits(robot, commanded)[0] == commanded).all(-1) & inside
            measure = 1 + self.model.hybrid.coverage.beyond(commanded).amax(-1)
        nominal = nearest_turn(robot, nominal, commanded, within_limits=False)
        singular = self._arm.singularity_measure(T, nominal if self._network else commanded)
        status = torch.where(
            self._is_outside(measure, branch), int(Status.OUTSIDE_DOMAIN), int(Status.REACHED)
        )
        status = torch.where(singular < tolerances.SINGULAR_TOLERANCE, int(Status.SINGULAR), status)
        status = torch.where(inside, status, int(Status.OUTSIDE_JOINT_LIMITS))
        error = self._error(T, self.model.forward(commanded))
        reached = reached & tolerated(self.axes, error.nan_to_num())
        error = torch.where(torch.tensor(self.axes.free), 0.0 * error, error)
        left = error[:, :3].norm(dim=-1), error[:, 3:].norm(dim=-1)
        rank = self._rank(T, commanded, branch, near) + torch.where(inside, 0.0, _OUTSIDE)
        solution = Solution(commanded, nominal, branch, self.branches, status, *left, measure)
        return replace(solution, ignored_axes=self.axes.ignored), torch.where(reached, rank, _LOST)

    def _nominal(self, T: Tensor, q: Tensor, known: Tensor) -> Tensor:
        """Joint values of the nominal arm near to others, which are known to be those, or not; NaN without solution."""
        if self.model.calibrated is None:
            return q
        solved = solve_numeric(self.model.robot, T, q, axes=self.axes, weights=self._arm.weights)
        found = torch.where((solved.status != Status.NOT_CONVERGED)[:, None], solved.q, torch.nan)
        return torch.where(known[:, None], q, found)

    def _corrected(self, T: Tensor, q: Tensor) -> tuple[Tensor, Tensor]:
        """Joint values with what a network corrects of nominal ones, and how far those are from its training rows."""
        measure = torch.full((len(T),), torch.nan, dtype=torch.float64)
        if self._network is None:
            return q, measure
        turned = self.model.wrapped_near_training(q)
        if self.model.domain is not None:
            measure = self.model.domain.measure(self._network.scaled_inputs(T, turned))
        return q + self.model.correction(T, turned), measure

    def _is_outside(self, measure: Tensor, branch: Tensor) -> Tensor:
        """Whether solutions are where nothing was measured."""
        if self.model.hybrid is not None:
            return measure > 1 + tolerances.MEASURED_ROUNDING
        if self._network is None or self.model.domain is None:
            return torch.zeros_like(branch, dtype=torch.bool)
        return ~(measure <= 1) | ~torch.isin(branch, self._trained)

    def _error(self, T: Tensor, reached: Tensor) -> Tensor:
        """What is left [m, rad] in the axes of the tool; NaN where it is not known where the arm goes."""
        known = torch.isfinite(reached).flatten(1).all(-1)[:, None]
        safe = torch.nan_to_num(reached)
        error = pose_error(T, safe) if self.axes.whole else task_error(self.axes, T, safe)[0]
        return torch.where(known, error, torch.nan)

    def _rank(self, T: Tensor, q: Tensor, branch: Tensor, near: Tensor | None) -> Tensor:
        """Ranks of joint values inside their limits: by how near they come, how free they are, or by their branch."""
        if near is not None:
            rank: Tensor = ((q - near).norm(dim=-1) / SAME).round()
        elif self._spare:
            rank = -self._arm.freedom(T, q)
        else:
            rank = torch.tensor(self.order).argsort()[branch].double()
        return rank


@dataclass(frozen=True)
class _Poses:
    """Poses as rows.

    Attributes:
        T: `(poses, 4, 4)`, identities for what is no pose.
        fine: which are poses.
        single: whether they were rounded to float32.
        batch: shape in which they were given.
    """

    T: Tensor
    fine: Tensor
    single: bool
    batch: tuple[int, ...]

    @staticmethod
    def of(values: Any, single: bool | None, throw: bool) -> "_Poses":
        """What was given.

        Raises:
            PoseError: see `pose_array`; a matrix is no pose, and `throw`.
        """
        array, rounded = pose_array(values)
        T = torch.from_numpy(np.array(array))
        single = rounded if single is None else single
        tolerance = tolerances.POSE_TOLERANCE_SINGLE if single else tolerances.POSE_TOLERANCE
        if throw:
            check_transforms(T, "T_base_tool", tolerance)
        rows = T.reshape(-1, 4, 4)
        fine = ~torch.stack([bad for bad, *_ in transform_faults(rows, tolerance)]).any(0)
        rows = torch.where(fine[:, None, None], rows, torch.eye(4, dtype=torch.float64))
        return _Poses(rows, fine, single, tuple(T.shape[:-2]))

    def shaped(self, values: Tensor) -> Tensor:
        """Values of the rows in the shape in which the poses were given."""
        return values.reshape((*self.batch, *values.shape[1:]))


def _among(every: Solution, rank: Tensor, wanted: Sequence[int]) -> Tensor:
    """Ranks of solutions, of which those on other than the wanted branches do not count."""
    return torch.where(torch.isin(every.branch, torch.tensor(wanted)), rank, _LOST)


def _best(every: Solution, rank: Tensor, wanted: Sequence[int]) -> Solution:
    """The best solution of every pose on the wanted branches."""
    least, index = _among(every, rank, wanted).min(1)
    lost = least >= _LOST
    best = every.map(lambda values: values[torch.arange(len(index)), index])
    best = replace(best, branch=torch.where(lost, wanted[0], best.branch))
    return _without(best, lost, Status.UNREACHABLE)


def _without(result: Solution, lost: Tensor, status: Status) -> Solution:
    """Solutions with NaN and another status where something holds."""

    def kept(values: Tensor) -> Tensor:
        where = lost.reshape(-1, *[1] * (values.ndim - 1))
        return torch.where(where, torch.nan, values) if values.is_floating_point() else values

    return replace(result.map(kept), status=torch.where(lost, int(status), result.status))
