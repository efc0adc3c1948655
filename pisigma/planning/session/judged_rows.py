"""The rows of a session: which of them count, what is wrong with the others, and which poses are left by them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.calibration.geometric.prediction import predicted_poses
from pisigma.measurement.camera.corner_file import with_one_noise
from pisigma.measurement.dataset import Measurements, join
from pisigma.measurement.fields import LeftOut
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.planning.candidates import Candidates
from pisigma.planning.choice import choose
from pisigma.planning.plan_file import StoredPlan
from pisigma.planning.session.reached import Reached
from pisigma.planning.session.row_alarms import (
    NEAR_POSE,
    cleared,
    contradicted,
    is_wrong,
    joint_differences,
    other_joint_values,
    stale_readings,
    unreadable,
)
from pisigma.planning.session.row_judgement import FEW_ROWS, RowJudgement, judge_rows
from pisigma.planning.session.state import Alarm
from pisigma.planning.session.stopping import AHEAD
from pisigma.planning.surroundings.motion import Motions
from pisigma.planning.tour import order_of_use, tour
from pisigma.robot.description import Robot
from pisigma.robot.se3 import invert, transform_from_xyzrpy
from pisigma.validation.checks.rows.mixed_rows import MOST_WRONG
from pisigma.validation.checks.rows.row_check import MOVES
from pisigma.validation.gate import check_rows

CANDIDATES = 1_000
"""So many of the plan's candidates are looked at."""
ROUNDS = 3
"""So often poses that no free motion leads to are replaced."""


class JudgedRows:
    """Rows that are judged as they come, each by all others.

    Attributes:
        rows: all of them that can be read, in the order of the file; None where there are none.
        usable: those that are no copies.
        judgement: of the usable ones.
        alarms: what is wrong with which line, beside all rows alike.
    """

    def __init__(self, robot: Robot, sigma: float) -> None:
        """Begin without rows.

        Args:
            robot: as drawn.
            sigma: standard deviation of the sensor's lengths [m] where rows state none.
        """
        self._robot, self._sigma = robot, sigma
        self.rows: Measurements | None = None
        self.usable = torch.zeros(0, dtype=torch.bool)
        self.judgement = RowJudgement(self.usable)
        self._fixed: list[Alarm] = []
        self._contradicted: dict[int, Alarm] = {}

    @property
    def alarms(self) -> tuple[Alarm, ...]:
        """See the class."""
        return (*self._fixed, *self._contradicted.values())

    @property
    def counting(self) -> Bool[Tensor, " rows"]:
        """Rows that count."""
        counting = self.usable.clone()
        counting[self.usable] = self.judgement.counts
        return counting

    def add(
        self,
        new: Measurements | None,
        left_out: Sequence[LeftOut],
        planned: Float64[Tensor, "poses dof"],
        names: Sequence[str],
    ) -> list[Alarm]:
        """Judge rows that were measured since, all of them together.

        Args:
            new: the rows in their order; None where there are none.
            left_out: rows that cannot be read.
            planned: joint values of all poses that were planned [rad or m].
            names: of these.

        Returns:
            What is wrong with them, or with earlier ones in the light of them.
        """
        alarms = [unreadable(row) for row in left_out]
        changed: list[Alarm] = []
        if new is not None and new.rows:
            start = 0 if self.rows is None else self.rows.rows
            self.rows = rows = new if self.rows is None else with_one_noise(join([self.rows, new]))
            stale = list(stale_readings(rows, start))
            copies = {alarm.line for alarm in stale}
            usable = torch.tensor([line not in copies for line in rows.line[start:]])
            remarks = other_joint_values(self._robot, rows, start, planned, names)
            alarms += [*stale, *(alarm for alarm in remarks if alarm.line not in copies)]
            self.usable = torch.cat([self.usable, usable])
            changed = self._judge(rows, planned, names)
        self._fixed += [*alarms, *(alarm for alarm in changed if alarm.kind == "cleared")]
        return [*alarms, *changed]

    def _judge(
        self, rows: Measurements, planned: Float64[Tensor, "poses dof"], names: Sequence[str]
    ) -> list[Alarm]:
        """Judge all rows that are no copies, and say what is new."""
        numbers = self.usable.nonzero()[:, 0]
        usable, judgement = rows.select(numbers), self.judgement
        for upto in _steps(len(judgement.counts), len(numbers)):
            trusted = torch.zeros(upto, dtype=torch.bool)
            trusted[: len(judgement.counts)] = judgement.counts
            some = usable.select(torch.arange(upto))
            judgement = judge_rows(self._robot, some, self._sigma, trusted)
        self.judgement = judgement
        wrong = {
            int(numbers[row]): contradicted(usable, judgement, row, planned, names)
            for row in is_wrong(judgement).nonzero()[:, 0].tolist()
        }
        agreed = [cleared(rows.line[row]) for row in self._contradicted if row not in wrong]
        new = [alarm for row, alarm in wrong.items() if row not in self._contradicted]
        self._contradicted = {row: self._contradicted.get(row, alarm) for row, alarm in wrong.items()}
        return [*new, *agreed]

    def errors(self) -> tuple[Float64[np.ndarray, "rows 3"], Float64[np.ndarray, "rows 3"]]:
        """Where the target is predicted, and measured - predicted position, in the robot's base frame [m].

        NaN where they cannot be said.
        """
        rows, model, errors = self.rows, self.judgement.model, self.judgement.errors
        position, error = torch.full((2, len(self.usable), 3), torch.nan, dtype=torch.float64)
        if rows is not None and model is not None and errors is not None:
            geometry, usable = model.geometry, self.usable
            at = replace(rows.select(usable), rotation=None)
            T = predicted_poses(geometry.robot, geometry.bases, geometry.tools, at)
            those = [torch.from_numpy(geometry.bases[name]) for name in at.frame]
            bases = transform_from_xyzrpy(torch.stack(those))
            position[usable] = (invert(bases) @ T)[:, :3, 3]
            error[usable] = (bases[:, :3, :3].mT @ errors.position[..., None])[..., 0]
        return position.numpy(), error.numpy()


def _steps(known: int, count: int) -> Iterator[int]:
    """Numbers of rows that are judged in turn, when some were judged before.

    As rows are judged by those that counted before, no more than these are added at once; of several that were added at
    once, each is then judged by the others, too.
    """
    upto = known
    while upto < count:
        upto = min(count, max(FEW_ROWS, 2 * upto))
        yield upto
    if count > max(known + 1, FEW_ROWS):
        yield count


def setup_sentence(
    rows: Measurements, counts: Bool[Tensor, " rows"], against: Robot | CalibratedModel
) -> str:
    """Say what the rows have in common that is wrong; "" where nothing is.

    Where a quarter of the rows or more contradict the others, all of them are judged together.

    Args:
        rows: all rows that are no copies.
        counts: those that others do not contradict.
        against: the robot as drawn, or the model that was planned for.
    """
    some = rows.select(counts) if counts.double().mean() > 1 - MOST_WRONG else rows
    found = check_rows(some, against, may_move=MOVES).implausible
    return found[0].sentence if found else ""


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
