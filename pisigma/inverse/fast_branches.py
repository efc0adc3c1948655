"""One chunk of poses, followed from branches of the nominal arm to the identified one."""

from collections.abc import Sequence

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.inverse.fast_model import FastModel, as_frame, follow
from pisigma.inverse.fast_rows import FastRows
from pisigma.inverse.nearest_turn import nearest_turn
from pisigma.inverse.reference import AWAY
from pisigma.kinematics.components import Frame
from pisigma.kinematics.status import Status

MARGIN = 1.0
"""[rad] Corrections are smaller, so that branches that are farther off need not be followed to be compared."""


class ChunkOfPoses:
    """Poses that are worked on together.

    Attributes:
        found: what became of them.
    """

    def __init__(
        self,
        model: FastModel,
        T: Float64[Tensor, "poses 4 4"],
        near: Float64[Tensor, "poses dof"] | None,
        found: FastRows,
    ) -> None:
        """Lay the poses out with the entries of the matrices one after the other.

        Args:
            model: what they are solved with.
            T: wanted poses T_base_tool.
            near: joint values [rad] to be near to, or None.
            found: where solutions are written.
        """
        self._model, self._near, self.found = model, near, found
        self._entries = T.reshape(-1, 16).T[:12].contiguous()

    def solve_in_order(self, order: Sequence[int]) -> None:
        """The first branch that leads to the pose inside the limits; else the first that does outside."""
        rows = torch.arange(self._entries.shape[1])
        outside = torch.zeros(len(rows), dtype=torch.bool)
        for branch in order:
            if not len(rows):
                return
            nominal, reached = self._model.solver.solve_branch(self._frame(rows), branch)
            tried = reached.nonzero()[:, 0]
            if not len(tried):
                continue
            followed = self._follow(rows[tried], nominal[tried], branch)
            within = followed.status != Status.OUTSIDE_JOINT_LIMITS
            taken = followed.done & (within | ~outside[rows[tried]])
            self.found.put(rows[tried[taken]], followed.select(taken))
            outside[rows[tried[taken]]] = True
            self.found.done[rows[tried]] &= (
                followed.done
            )  # what is left to others they decide from the first branch on
            rows = rows[~reached.index_put((tried,), within | ~followed.done)]

    def solve_nearest(self) -> None:
        """The nearest branch to `near`: of those that lead to the pose inside the limits, else of the others."""
        assert self._near is not None
        nominal, distance = self._all_branches()
        rank = torch.full(distance.shape[1:], 2)
        best = torch.full_like(distance[0], torch.inf)
        lost = torch.zeros_like(rank, dtype=torch.bool)
        for _ in range(len(nominal)):
            least, branch = distance.min(0)
            open_ = torch.isfinite(least) & ~lost & ((rank > 0) | (least - MARGIN <= best))
            rows = open_.nonzero()[:, 0]
            if not len(rows):
                break
            tried = branch[rows]
            distance[tried, rows] = torch.inf
            followed = self._follow(rows, nominal[tried, rows], tried)
            lost[rows[~followed.done]] = True
            off = (followed.q - self._near[rows]).norm(dim=-1)
            order = (followed.status == Status.OUTSIDE_JOINT_LIMITS).long()
            better = followed.done & ((order < rank[rows]) | ((order == rank[rows]) & (off < best[rows])))
            taken = rows[better]
            self.found.put(taken, followed.select(better))
            rank[taken], best[taken] = order[better], off[better]
        self.found.done.logical_and_(~lost & (best <= AWAY))

    def _all_branches(self) -> tuple[Tensor, Tensor]:
        """Nominal joint values `(branches, poses, dof)`, and how far they are from `near`; inf where there are none."""
        assert self._near is not None
        frame, values, distances = self._frame(slice(None)), [], []
        for branch in range(len(self._model.solver.branches)):
            q, reached = self._model.solver.solve_branch(frame, branch)
            beside = nearest_turn(self._model.robot, q, self._near, within_limits=True)
            distances.append(torch.where(reached, (beside - self._near).norm(dim=-1), torch.inf))
            values.append(q)
        return torch.stack(values), torch.stack(distances)

    def _follow(self, rows: Tensor, nominal: Float64[Tensor, "poses dof"], branch: int | Tensor) -> FastRows:
        """Solve some of the poses from nominal joint values on."""
        near = None if self._near is None else self._near[rows]
        return follow(self._model, self._frame(rows), nominal, branch, near)

    def _frame(self, rows: Tensor | slice) -> Frame:
        """Some of the poses on components, in their order."""
        all_of_them = isinstance(rows, Tensor) and len(rows) == self._entries.shape[1]
        return as_frame(self._entries if all_of_them else self._entries[:, rows])
