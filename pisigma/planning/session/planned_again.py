"""What is left of a plan, planned again by what the rows say."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.planning.candidates import Candidates
from pisigma.planning.choice import choose
from pisigma.planning.plan_file import StoredPlan
from pisigma.planning.session.reached import Reached
from pisigma.planning.session.row_alarms import NEAR_POSE, joint_differences
from pisigma.planning.session.stopping import AHEAD
from pisigma.planning.surroundings.motion import Motions
from pisigma.planning.tour import order_of_use, tour

CANDIDATES = 1_000
"""So many of the plan's candidates are looked at."""
ROUNDS = 3
"""So often poses that no free motion leads to are replaced."""


@dataclass(frozen=True, eq=False)
class FurtherPoses:
    """Poses that can be planned.

    Attributes:
        q: joint values [rad or m].
        number: of every pose among the candidates.
        motions: free ones between poses.
        task: joint values [rad or m] where the robot shall be accurate.
    """

    q: Float64[Tensor, "candidates dof"]
    number: Int64[Tensor, " candidates"]
    motions: Motions
    task: Float64[Tensor, "tasks dof"]

    @staticmethod
    def of(plan: StoredPlan, candidates: Candidates, task: Float64[Tensor, "tasks dof"]) -> "FurtherPoses":
        """Take some of a plan's candidates."""
        count = len(candidates.q)
        some = torch.linspace(0, count - 1, min(count, CANDIDATES)).round().long()
        motions = Motions(plan.arm, candidates.workspace[:CANDIDATES])
        return FurtherPoses(candidates.q[some], candidates.number[some], motions, task)

    def planned_again(
        self,
        plan: StoredPlan,
        poses: int,
        so_far: Reached,
        measured: Float64[Tensor, "rows dof"],
        remaining: Int64[Tensor, " remaining"],
    ) -> StoredPlan | None:
        """Choose the poses that are left anew, by what is known by now; the next one and those to check with stay.

        Args:
            plan: that holds now.
            poses: to calibrate with, in all.
            so_far: what the rows came to.
            measured: joint values of the rows that count [rad or m].
            remaining: numbers of the poses that are left, the next one first.

        Returns:
            The plan; None where nothing can be chosen.
        """
        first = remaining[:1]
        check = remaining[1:][plan.check[remaining[1:]]]
        count = poses - so_far.point.poses - int((~plan.check[first]).sum())
        new = self._new(plan, torch.cat([measured, plan.q[first]]))
        knowledge = so_far.knowledge
        if not len(first) or not 0 < count <= len(new):
            return None
        if not bool(plan.check[first]):
            knowledge = knowledge.informed(plan.q[first])
        seen, tool = knowledge.measured(self.q), knowledge.tool(self.task)
        for _ in range(ROUNDS):
            if count > len(new):
                return None
            chosen = new[choose(seen[new], tool, count, plan.settings.criterion)]
            use = order_of_use(count, len(check))
            q = torch.cat([self.q[chosen], plan.q[check]])[use]
            way = tour(self.motions, q, plan.settings.pace, plan.q[first[0]], stages=(AHEAD,))
            left_out = use[way.left_out]
            shut_in = left_out[left_out < count]
            new = new[~torch.isin(new, chosen[shut_in])]
            if not len(shut_in):
                break
        number = torch.cat([self.number[chosen], plan.candidate[check]])[use]
        return replace(
            plan.part(first),
            q=torch.cat([plan.q[first], q[way.order]]),
            check=torch.cat([plan.check[first], use[way.order] >= count]),
            candidate=torch.cat([plan.candidate[first], number[way.order]]),
            way_points=(plan.way_points[int(first)], *way.before),
            number=(),
        )

    def _new(self, plan: StoredPlan, known: Float64[Tensor, "known dof"]) -> Int64[Tensor, " new"]:
        """Numbers of the poses that are neither measured nor next."""
        off = joint_differences(plan.arm.robot, self.q, known).abs().amax(-1)
        return (off > NEAR_POSE).all(1).nonzero()[:, 0]
