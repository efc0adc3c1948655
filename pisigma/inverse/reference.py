"""Corrected inverse kinematics that leaves nothing untried: every model, every pose, at some milliseconds each."""

from collections.abc import Sequence

import torch
from torch import Tensor

from pisigma.inverse.finishing import Finishing
from pisigma.inverse.identified_arm import ATTEMPTS, IdentifiedArm, search
from pisigma.inverse.solution import Solution
from pisigma.kinematics.closed_form import AbstractClosedForm
from pisigma.kinematics.status import Status
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.hybrid_motion import HybridMotion
from pisigma.model.stored_starts import StoredStarts

AWAY = 0.1
"""[rad or m] A solution farther from where it was to be near to may not be the one that was meant."""

MORE_ATTEMPTS = 128
"""Starts that are tried in all where there is no closed form."""


class ReferenceIK:
    """The ways to solutions of one model.

    Attributes:
        model: the model.
        branches: names of the branches.
        arm: its identified arm, where it has one and the nominal one a closed form.
    """

    def __init__(
        self,
        model: CalibratedModel,
        solver: AbstractClosedForm | None,
        branches: tuple[str, ...],
        trained: Sequence[int],
    ) -> None:
        """Prepare a model.

        Args:
            model: the model.
            solver: closed form of its nominal arm, or None.
            branches: names of the branches.
            trained: indices of those that training rows lie on, most frequent first.
        """
        self.model, self._solver, self.branches, self._default = model, solver, branches, trained[0]
        self._starts = StoredStarts(model.calibrated or model.robot, model.starts)
        self.arm: IdentifiedArm | None = None
        self._motion = None if model.hybrid is None else HybridMotion(model.hybrid)
        if model.calibrated is not None and solver is not None:
            self.arm = IdentifiedArm(model.robot, model.calibrated, solver, self._starts, model.hybrid)
        self._finishing = Finishing(model, branches, trained, self._motion)

    def solve(self, T: Tensor, given: Tensor, near: Tensor | None, order: Sequence[int]) -> Solution:
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
            found = every.on_branch(self._nearest(every, near))
        else:
            found = self._in_order(T, given, near, order)
        if self.arm is not None:
            found = self._recovered(T, found, near, anywhere=free)
            if near is not None and free:
                found = self._continued(T, found, near)
        return found

    def all_branches(self, T: Tensor, given: Tensor) -> Solution:
        """Solutions on every branch, as a last batch axis."""
        if self._solver is None:
            return self._numeric(T, None).with_branch_axis()
        every = self._on_branches(T, given, None, range(len(self.branches)))
        if self.arm is None:
            return every
        each = T.unsqueeze(-3).expand(*every.status.shape, 4, 4)
        return self._recovered(each, every, None, anywhere=False)

    def _in_order(self, T: Tensor, given: Tensor, near: Tensor | None, order: Sequence[int]) -> Solution:
        """On the first branch that leads to the pose inside the limits, else on the first that leads there at all."""
        if self.arm is None:  # all branches cost little
            return self._first(self._on_branches(T, given, near, range(len(self.branches))), order)
        found = self._first(self._on_branches(T, given, near, order[:1]), (0,))
        status = found.status.reshape(-1)
        rows = ((status == Status.UNREACHABLE) | (status == Status.OUTSIDE_JOINT_LIMITS)).nonzero()[:, 0]
        if not len(rows) or len(order) == 1:
            return found
        beside = None if near is None else near.reshape(-1, near.shape[-1])[rows]
        as_given = given.detach().reshape(-1, 4, 4)[rows.to(given.device)]
        every = self._on_branches(T.reshape(-1, 4, 4)[rows], as_given, beside, order)
        return found.with_rows(rows, self._first(every, range(len(order))))

    def _first(self, every: Solution, order: Sequence[int]) -> Solution:
        """Of solutions on some branches the first in an order that is inside the limits, else outside, else any."""
        status = every.status[..., torch.tensor(tuple(order))]
        rank = (status == Status.OUTSIDE_JOINT_LIMITS).long() + 2 * (status == Status.UNREACHABLE).long()
        place = (torch.arange(len(order)) + len(order) * rank).argmin(-1)
        return every.on_branch(torch.tensor(tuple(order))[place])

    def _on_branches(self, T: Tensor, given: Tensor, near: Tensor | None, indices: Sequence[int]) -> Solution:
        """Solutions on some branches, as a last batch axis, each from its nominal joint values on."""
        assert self._solver is not None
        found = self._solver.solve(given.detach().to("cpu"))
        branch = torch.tensor(indices).expand(*T.shape[:-2], len(indices))
        q, status = found.q[..., indices, :].double(), found.status[..., indices]
        each = T.unsqueeze(-3).expand(*branch.shape, 4, 4)
        beside = None if near is None else near.unsqueeze(-2).expand(*branch.shape, -1)
        if self.arm is None:
            return self._finishing.of_nominal(each, q, status, branch, beside)
        reached, status = self.arm.follow(each, q)
        return self._finishing.of_identified(each, reached, q, status, branch, beside)

    def _recovered(self, T: Tensor, found: Solution, near: Tensor | None, anywhere: bool) -> Solution:
        """Look again for what was not found, where the identified arm reaches and the nominal one does not.

        Any other branch than the wanted one will do where `anywhere`.
        """
        assert self.arm is not None
        lost = (found.status == Status.UNREACHABLE).reshape(-1).nonzero()[:, 0]
        if not len(lost):
            return found
        T_lost, branch = T.reshape(-1, 4, 4)[lost], found.branch.reshape(-1)[lost]
        q, status, branch = self.arm.recover(T_lost, branch, torch.full((len(lost),), anywhere))
        beside = None if near is None else near.reshape(-1, q.shape[-1])[lost]
        nominal = torch.full_like(q, torch.nan)
        finished = self._finishing.of_identified(T_lost, q, nominal, status, branch, beside)
        return found.with_rows(lost, finished)

    def _continued(self, T: Tensor, found: Solution, near: Tensor) -> Solution:
        """Look from `near` itself where nothing was found close to it.

        Near singular poses the nominal arm may lack the branch on which the identified one is.
        """
        assert self.arm is not None
        q_near, q_found = near.reshape(-1, near.shape[-1]), found.q.reshape(-1, near.shape[-1])
        off = (q_found - q_near).norm(dim=-1).nan_to_num(torch.inf)
        away = (off > AWAY).nonzero()[:, 0]
        T_away, start = T.reshape(-1, 4, 4)[away], q_near[away]
        q, status = search(self.arm.calibrated, T_away, start[:, None], self._motion)
        lies = self.arm.branch_of(q)
        nominal, _ = search(self.model.robot, T_away, q[:, None])
        other = self._finishing.of_identified(T_away, q, nominal, status, lies, start)
        good = (other.status != Status.UNREACHABLE) & (other.status != Status.OUTSIDE_JOINT_LIMITS)
        kept = (good & ((other.q - start).norm(dim=-1) < off[away])).nonzero()[:, 0]
        return found.with_rows(away[kept], other.select(kept))

    def _numeric(self, T: Tensor, near: Tensor | None) -> Solution:
        """Numeric inverse from `near`, then from the training rows whose poses are nearest, then from more of them."""
        flat, shape = T.reshape(-1, 4, 4), T.shape[:-2]
        dof = self.model.robot.dof
        starts = self.model.starts[self._starts.nearest(flat, ATTEMPTS)]
        if near is not None:
            starts = torch.cat([near.reshape(-1, 1, dof), starts], 1)
        q, status = search(self._starts.robot, flat, starts, self._motion)
        left = ((status == Status.UNREACHABLE) | (status == Status.OUTSIDE_JOINT_LIMITS)).nonzero()[:, 0]
        if len(left):
            more = self.model.starts[self._starts.nearest(flat[left], MORE_ATTEMPTS)]
            other, fate = search(self._starts.robot, flat[left], more, self._motion, inside=True)
            better = (status[left] == Status.UNREACHABLE) | (fate < Status.OUTSIDE_JOINT_LIMITS)
            q[left[better]], status[left[better]] = other[better], fate[better]
        branch = torch.zeros(shape, dtype=torch.int64)
        if self.model.calibrated is None:
            return self._finishing.of_nominal(T, q.reshape(*shape, dof), status.reshape(shape), branch, near)
        nominal, _ = search(self.model.robot, flat, q[:, None])
        q, nominal = (values.reshape(*shape, dof) for values in (q, nominal))
        return self._finishing.of_identified(T, q, nominal, status.reshape(shape), branch, near)

    def _nearest(self, every: Solution, near: Tensor) -> Tensor:
        """Index of the branch nearest to `near`: of those that reach, else of those outside limits."""
        distance = (every.q - near.unsqueeze(-2)).square().sum(-1)
        lost = every.status == Status.UNREACHABLE
        rank = (every.status == Status.OUTSIDE_JOINT_LIMITS).long() + 2 * lost.long()
        distance = torch.where(rank == rank.amin(-1, keepdim=True), distance, torch.inf)
        return torch.where(lost.all(-1), self._default, distance.argmin(-1))
