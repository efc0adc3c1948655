"""The few poses that Newton steps from one branch do not solve: all places to begin at are tried at once."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.inverse.fast_model import FastModel, as_frame, entries_of, follow
from pisigma.inverse.fast_rows import FastRows
from pisigma.inverse.identified_arm import ATTEMPTS
from pisigma.inverse.nearest_turn import nearest_turn
from pisigma.inverse.reference import AWAY
from pisigma.kinematics.status import Status

BEND = 0.02
"""[rad] All joints are bent by that much away from joint values that may be singular."""


class PatientPoses:
    """Poses that are worked on together, with damped steps.

    Attributes:
        found: what became of them.
    """

    def __init__(
        self,
        model: FastModel,
        T: Float64[Tensor, "poses 4 4"],
        near: Float64[Tensor, "poses dof"] | None,
    ) -> None:
        """Take poses, and joint values [rad] to be near to, or None."""
        self._model, self._T, self._near = model, T, near
        self._entries = entries_of(T)
        self.found = FastRows.none(len(T), model.robot.dof)

    def solve(self, order: Sequence[int]) -> FastRows:
        """Solutions by the rules of `FastSolver.solve`; nothing where one of the starts led to an unclear end."""
        nominal, exists = self._branches(order, self._entries)
        pose, place = exists.nonzero().unbind(1)
        followed = self._follow(pose, nominal[pose, place], torch.tensor(order)[place])
        free = len(order) > 1
        cost = place.double() / len(order)
        if self._near is not None and free:
            off = (followed.q - self._near[pose]).norm(dim=-1)
            cost = off / (1 + off)
        least = self._choose(pose, followed, cost + (followed.status == Status.OUTSIDE_JOINT_LIMITS))
        ahead = (cost < least[pose]) if self._near is None else torch.ones_like(pose, dtype=torch.bool)
        unclear = torch.zeros(len(self._T), dtype=torch.bool)
        unclear[pose[ahead & ~followed.done & ~followed.lost]] = True
        if free and self._near is not None:
            self._continue((~unclear).nonzero()[:, 0])
        if free:
            self._recover((~unclear & ~self.found.done).nonzero()[:, 0], order)
            nowhere = (~unclear & self.found.lost & ~self.found.done).nonzero()[:, 0]
            self.found.done[nowhere], self.found.status[nowhere] = True, int(Status.UNREACHABLE)
            self.found.branch[nowhere] = order[0]
        self.found.done.logical_and_(~unclear)
        return self.found

    def _branches(self, order: Sequence[int], entries: Tensor) -> tuple[Tensor, Tensor]:
        """Nominal joint values `(poses, branches, dof)` and whether there are any."""
        solved = [self._model.solver.solve_branch(as_frame(entries), branch) for branch in order]
        return torch.stack([q for q, _ in solved], 1), torch.stack([reached for _, reached in solved], 1)

    def _follow(self, pose: Tensor, start: Tensor, branch: int | Tensor) -> FastRows:
        near = None if self._near is None else self._near[pose]
        return follow(self._model, as_frame(self._entries[:, pose]), start, branch, near, patient=True)

    def _choose(
        self, pose: Int64[Tensor, " tries"], tries: FastRows, cost: Float64[Tensor, " tries"]
    ) -> Float64[Tensor, " poses"]:
        """Of all tries for a pose that led there take the one that costs least; its cost, inf where none did."""
        cost = torch.where(tries.done, cost, torch.inf)
        least = torch.full((len(self._T),), torch.inf, dtype=torch.float64)
        least.scatter_reduce_(0, pose, cost, "amin")
        kept = (tries.done & (cost == least[pose])).nonzero()[:, 0]
        self.found.put(pose[kept], tries.select(kept))
        return least

    def _continue(self, rows: Tensor) -> None:
        """Look from `near` itself where nothing was found close to it; see `ReferenceIK`."""
        assert self._near is not None
        off = (self.found.q - self._near).norm(dim=-1).nan_to_num(torch.inf)
        rows = rows[off[rows] > AWAY]
        followed = self._follow(rows, self._near[rows], 0)
        better = followed.done & (followed.status != Status.OUTSIDE_JOINT_LIMITS)
        better &= (followed.q - self._near[rows]).norm(dim=-1) < off[rows]
        rows, followed = rows[better], followed.select(better)
        nominal = self._model.nominal.follow(
            as_frame(self._entries[:, rows]), followed.q.T.contiguous(), patient=True
        )
        q_nominal = nearest_turn(self._model.robot, nominal.q.T, followed.q, within_limits=False)
        self._take(rows, followed, torch.where(nominal.good[:, None], q_nominal, torch.nan))

    def _recover(self, rows: Tensor, order: Sequence[int]) -> None:
        """Look for poses that no branch leads to, from the starts of `IdentifiedArm.recover`; the first one counts.

        Then from the joint values that come nearest to them on every branch of the nominal arm, bent a little.
        """
        arm, T = self._model.identified, self._T[rows]
        if not len(rows) or not len(arm.starts.q):
            return
        index = arm.starts.nearest(T, ATTEMPTS)
        drawn = entries_of(arm.drawn(T, arm.starts.T[index[:, 0], :3, 3]))
        nominal, exists = self._branches((order[0], *range(len(order))), drawn)
        exists = torch.cat([exists, torch.ones_like(index, dtype=torch.bool)], 1)
        self._try_all(rows, torch.cat([nominal, arm.starts.q[index]], 1), exists)
        rows = rows[~self.found.done[rows]]
        nearest, _ = self._branches(order, self._entries[:, rows])
        bent = torch.cat([nearest + BEND, nearest - BEND], 1)
        self._try_all(rows, bent, torch.isfinite(bent).all(-1))

    def _try_all(self, rows: Tensor, starts: Float64[Tensor, "rows starts dof"], exists: Tensor) -> None:
        """Of starts for every row take the first that leads there; without any the pose is lost."""
        row, place = exists.nonzero().unbind(1)
        followed = self._follow(rows[row], starts[row, place], 0)
        followed = replace(followed, q_nominal=torch.full_like(followed.q, torch.nan))
        self._choose(rows[row], followed, place.double())
        lost = torch.ones(len(self._T), dtype=torch.bool)
        lost[rows[row[~followed.lost]]] = False
        self.found.lost[rows] = lost[rows]
        rows = rows[self.found.done[rows]]
        self.found.branch[rows] = self._model.identified.branch_of(self.found.q[rows])

    def _take(self, rows: Tensor, followed: FastRows, q_nominal: Tensor) -> None:
        branch = self._model.identified.branch_of(followed.q)
        self.found.put(rows, replace(followed, branch=branch, q_nominal=q_nominal))
