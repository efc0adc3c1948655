"""Measure with a plan: rows in as they come; what is wrong with them, the next pose, and when to stop out."""

import math
import os
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Int64
from torch import Tensor

from pisigma.camera.corner_file import with_one_noise
from pisigma.errors import PlanningError
from pisigma.identification.prediction import predicted_poses
from pisigma.judging.progress import Progress
from pisigma.measurement.dataset import Measurements, join
from pisigma.measurement.fields import LeftOut
from pisigma.measuring.coverage import coverage
from pisigma.measuring.reached import Reached, expected, reached
from pisigma.measuring.row_alarms import (
    NEAR_POSE,
    cleared,
    contradicted,
    is_wrong,
    joint_differences,
    of_all_rows,
    other_joint_values,
    stale_readings,
    unreadable,
)
from pisigma.measuring.row_judgement import RowJudgement, judge_rows
from pisigma.measuring.setup_sentence import setup_sentence
from pisigma.measuring.state import AccuracyPoint, Advice, Alarm, NextPose, RowsSoFar, SessionState
from pisigma.measuring.stopping import AHEAD, advice
from pisigma.planning.cell.motion import Motions
from pisigma.planning.choice import choose
from pisigma.planning.plan_file import StoredPlan, read_plan
from pisigma.planning.subject import Subject
from pisigma.planning.task import task_poses
from pisigma.planning.tour import order_of_use, tour
from pisigma.se3 import invert, transform_from_xyzrpy

CANDIDATES = 1_000
"""So many of the plan's candidates are looked at when the rest is planned again."""
ROUNDS = 3
"""So often poses that no free motion leads to are replaced."""
STEP = 5
"""Poses between two points of the curve."""


@dataclass(frozen=True)
class MeasureSettings:
    """When a session stops, and how often it is judged.

    Attributes:
        limit_mm: 95 % of the tool's position errors over the task are to stay below [mm]; None for no limit.
        least_gain_mm: the session ends where the next 10 poses would lower that by less [mm].
        every: the accuracy is worked out, and the rest planned again, after so many rows.
        replan: whether what is left is planned again.

    Raises:
        PlanningError: a setting is no number that it can be.
    """

    limit_mm: float | None = None
    least_gain_mm: float = 0.005
    every: int = 3
    replan: bool = True

    def __post_init__(self) -> None:
        """Refuse settings that are none."""
        if self.limit_mm is not None and not 0 < self.limit_mm < math.inf:
            raise PlanningError(f"limit: a length above 0 was wanted, got {self.limit_mm:g} mm.")
        if not 0 <= self.least_gain_mm < math.inf:
            raise PlanningError(
                f"least gain: a length of 0 or more was wanted, got {self.least_gain_mm:g} mm."
            )
        if self.every < 1:
            raise PlanningError(f"every: 1 row or more was wanted, got {self.every}.")


class MeasuringSession:
    """A robot that is being measured with a plan.

    `add` judges new rows within a second. `work_out` calibrates with the rows so far and plans the rest again, which
    takes some seconds; it may run in another thread than `add`, and what it finds shows in the next `state`.

    Attributes:
        plan: the poses that hold now.
        replanned: whether they are others than those that the session began with.
    """

    def __init__(self, plan: StoredPlan, settings: MeasureSettings = MeasureSettings()) -> None:
        """Begin.

        Args:
            plan: the poses, and what they were planned with.
            settings: see `MeasureSettings`.
        """
        self.plan = plan
        self.replanned = False
        self._lock = threading.RLock()
        self._settings = settings
        candidates = plan.settings.find_candidates(plan.arm)
        some = torch.linspace(0, len(candidates.q) - 1, min(len(candidates.q), CANDIDATES)).round().long()
        self._candidates, self._number = candidates.q[some], candidates.number[some]
        self._motions = Motions(plan.arm, candidates.workspace[:CANDIDATES])
        subject = Subject(plan.arm.drawn) if plan.model is None else Subject.of(plan.model)
        self._task = task_poses(plan.arm, plan.settings, candidates.workspace, subject.model)
        self._before = subject.knowledge(plan.arm, replace(plan.settings, measured=None))
        self._planned, self._planned_check = plan.q, plan.check
        self._names = [f"pose {number} of the plan" for number in range(1, len(plan.q) + 1)]
        self._rows: Measurements | None = None
        self._fixed: list[Alarm] = []
        self._contradicted: dict[int, Alarm] = {}
        self._usable = torch.zeros(0, dtype=torch.bool)
        self._judgement = RowJudgement(self._usable)
        self._setup = ""
        self._reached: list[AccuracyPoint] = []
        self._expected: tuple[AccuracyPoint, ...] = ()
        self._worked_out = 0
        self._poses = int((~plan.check).sum())

    @staticmethod
    def read(
        path: str | os.PathLike[str], settings: MeasureSettings = MeasureSettings()
    ) -> "MeasuringSession":
        """Begin with the plan in a file.

        Raises:
            PlanningError: the file is no plan.
            MeasurementError: its poses cannot be used.
        """
        return MeasuringSession(read_plan(path), settings)

    def add(self, rows: Measurements | None, left_out: Sequence[LeftOut] = ()) -> tuple[Alarm, ...]:
        """Judge rows that were measured since.

        Args:
            rows: the rows in their order; None where there are none.
            left_out: rows that cannot be read.

        Returns:
            What is wrong with them, or with earlier ones in the light of them, in the order of the file.
        """
        alarms = [unreadable(row) for row in left_out]
        with self._lock:
            for row in range(0 if rows is None else rows.rows):
                assert rows is not None
                alarms += self._add(rows.select(torch.tensor([row])))
            if rows is not None:
                alarms += self._judge_setup()
            self._fixed += [alarm for alarm in alarms if alarm.kind not in ("off", "swapped")]
        return tuple(sorted(alarms, key=lambda alarm: alarm.line))

    @property
    def is_due(self) -> bool:
        """Whether enough rows came since the accuracy was worked out."""
        return self._training_rows >= self._worked_out + self._settings.every

    def work_out(self, progress: Progress = lambda what: None) -> None:
        """Calibrate with the rows so far, judge that, and plan the rest again."""
        with self._lock:
            self._worked_out = self._training_rows
            if self._rows is None or self._setup:
                return
            counting, check, rows, remaining = self._counting, self._check, self._rows, self._open
        training = rows.select(counting & ~check)
        kept_apart = rows.select(counting & check) if bool((counting & check).any()) else None
        # a session that begins with rows has the figure before its first one, too, as if it had gone on
        counts = [training.rows] if self._reached else [training.rows - self._settings.every, training.rows]
        parts = [training.select(torch.arange(max(count, 0))) for count in counts]
        known = (kept_apart, self._task, progress)
        found = [reached(self.plan, self._before, some, *known) for some in parts]
        came_to = found[-1]
        if came_to is None:
            return
        progress("planning what is left")
        again = self._planned_again(came_to, remaining) if self._settings.replan else None
        with self._lock:
            if again is not None:
                self._adopt(again, came_to.point.poses)
            remaining = self._open
            poses = self.plan.q[remaining[~self.plan.check[remaining]]]
        ahead = expected(came_to.knowledge, training.rows, poses, self._candidates, self._task, STEP)
        with self._lock:
            self._expected = ahead
            self._reached += [one.point for one in found if one is not None]

    @property
    def rows(self) -> Measurements | None:
        """The rows that count; None where there are none."""
        return None if self._rows is None else self._rows.select(self._counting)

    @property
    def state(self) -> SessionState:
        """What the session has come to."""
        with self._lock:
            return self._state()

    def _state(self) -> SessionState:
        rows, open_poses, model, counting = self._so_far(), self._open, self._judgement.model, self.rows
        following = None
        if len(open_poses):
            first, count = int(open_poses[0]), len(self.plan.q)
            q, check = self.plan.q[first].numpy(), bool(self.plan.check[first])
            following = NextPose(first + 1, count, q, check, self.plan.arm.robot.to_controller(q))
        base = None
        if model is not None:
            base = transform_from_xyzrpy(torch.from_numpy(next(iter(model.geometry.bases.values())))).numpy()
        return SessionState(
            rows=rows,
            alarms=tuple(sorted([*self._fixed, *self._contradicted.values()], key=lambda alarm: alarm.line)),
            next_pose=following,
            remaining=self.plan.q[open_poses].numpy(),
            coverage=() if counting is None else coverage(self.plan.arm.robot, counting.q, self._planned),
            reached=tuple(self._reached),
            expected=self._expected,
            advice=self._advice(len(open_poses)),
            revolute=tuple(axis.type == "revolute" for axis in self.plan.arm.robot.axes),
            base=base,
        )

    def write_rest(self, path: Path) -> None:
        """Write the poses that are left as a plan of its own.

        Raises:
            OutputError: a file cannot be written there.
        """
        self._part(self.plan, self._open).write(path)

    def _add(self, row: Measurements) -> list[Alarm]:
        """Judge one more row."""
        self._rows = rows = row if self._rows is None else with_one_noise(join([self._rows, row]))
        new = rows.rows - 1
        alarms = list(stale_readings(rows, new))
        usable = torch.tensor([not alarms], dtype=torch.bool)
        if not alarms:
            alarms += other_joint_values(self.plan.arm.robot, rows, new, self._planned, self._names)
        self._usable = torch.cat([self._usable, usable])
        return alarms + self._judge(rows)

    def _judge_setup(self) -> list[Alarm]:
        """Look for a fault that all rows have in common, and say it where it is new."""
        assert self._rows is not None
        usable, before = self._rows.select(self._usable), self._setup
        self._setup = setup_sentence(self.plan.arm.robot, usable, self._judgement.counts)
        return [of_all_rows(self._setup)] if self._setup and not before else []

    def _judge(self, rows: Measurements) -> list[Alarm]:
        """Judge all rows that are no copies, and say what is new."""
        numbers = self._usable.nonzero()[:, 0]
        trusted = torch.zeros(len(numbers), dtype=torch.bool)
        trusted[: len(self._judgement.counts)] = self._judgement.counts
        usable = rows.select(numbers)
        sigma = self._before.instrument.sigma
        self._judgement = judgement = judge_rows(self.plan.arm.robot, usable, sigma, trusted)
        wrong = {
            int(numbers[row]): contradicted(usable, judgement, row, self._planned, self._names)
            for row in is_wrong(judgement).nonzero()[:, 0].tolist()
        }
        agreed = [cleared(rows.line[row]) for row in self._contradicted if row not in wrong]
        alarms = [alarm for row, alarm in wrong.items() if row not in self._contradicted]
        self._contradicted = {row: self._contradicted.get(row, alarm) for row, alarm in wrong.items()}
        return [*alarms, *agreed]

    def _planned_again(self, came_to: Reached, remaining: Int64[Tensor, " remaining"]) -> StoredPlan | None:
        """Choose the poses that are left anew, by what is known by now; the next one and those to check with stay."""
        plan, first = self.plan, remaining[:1]
        check = remaining[1:][plan.check[remaining[1:]]]
        count = self._poses - came_to.point.poses - int((~plan.check[first]).sum())
        new, knowledge = self._new_candidates(first), came_to.knowledge
        if not len(first) or not 0 < count <= len(new):
            return None
        if not bool(plan.check[first]):
            knowledge = knowledge.informed(plan.q[first])
        measured, tool = knowledge.measured(self._candidates), knowledge.tool(self._task)
        for _ in range(ROUNDS):
            if count > len(new):
                return None
            chosen = new[choose(measured[new], tool, count, plan.settings.criterion)]
            use = order_of_use(count, len(check))
            poses = torch.cat([self._candidates[chosen], plan.q[check]])[use]
            way = tour(self._motions, poses, plan.settings.pace, plan.q[first[0]], stages=(AHEAD,))
            left_out = use[way.left_out]
            shut_in = left_out[left_out < count]
            new = new[~torch.isin(new, chosen[shut_in])]
            if not len(shut_in):
                break
        number = torch.cat([self._number[chosen], plan.candidate[check]])[use]
        return replace(
            self._part(plan, first),
            q=torch.cat([plan.q[first], poses[way.order]]),
            check=torch.cat([plan.check[first], use[way.order] >= count]),
            candidate=torch.cat([plan.candidate[first], number[way.order]]),
            way_points=(plan.way_points[int(first)], *way.before),
        )

    def _new_candidates(self, first: Int64[Tensor, " first"]) -> Int64[Tensor, " new"]:
        """Candidates that are neither measured nor next."""
        with self._lock:
            assert self._rows is not None
            q = torch.cat([self._rows.q[self._counting], self.plan.q[first]])
        off = joint_differences(self.plan.arm.robot, self._candidates, q).abs().amax(-1)
        return (off > NEAR_POSE).all(1).nonzero()[:, 0]

    def _adopt(self, plan: StoredPlan, rows: int) -> None:
        """Go on with another plan."""
        self.plan, self.replanned = plan, True
        self._planned = torch.cat([self._planned, plan.q])
        self._planned_check = torch.cat([self._planned_check, plan.check])
        self._names += [
            f"pose {number} of the plan after {rows} rows" for number in range(1, len(plan.q) + 1)
        ]

    @staticmethod
    def _part(plan: StoredPlan, poses: Int64[Tensor, " poses"]) -> StoredPlan:
        """Some poses of a plan."""
        return replace(
            plan,
            q=plan.q[poses],
            check=plan.check[poses],
            candidate=plan.candidate[poses],
            way_points=tuple(plan.way_points[pose] for pose in poses.tolist()),
        )

    @property
    def _training_rows(self) -> int:
        """Number of rows to calibrate with."""
        return 0 if self._rows is None else int((self._counting & ~self._check).sum())

    @property
    def _counting(self) -> Bool[Tensor, " rows"]:
        """Rows that count."""
        counting = self._usable.clone()
        counting[self._usable] = self._judgement.counts
        return counting

    @property
    def _check(self) -> Bool[Tensor, " rows"]:
        """Rows that check the calibration: of the set "test"; without sets in the file, at such poses of the plan."""
        assert self._rows is not None
        if self._rows.split is not None:
            return torch.tensor([name == "test" for name in self._rows.split])
        near = joint_differences(self.plan.arm.robot, self._rows.q, self._planned).abs().amax(-1)
        nearest = near.min(1)
        return self._planned_check[nearest.indices] & (nearest.values <= NEAR_POSE)

    @property
    def _open(self) -> Int64[Tensor, " remaining"]:
        """Poses of the plan that no row that counts was measured at, from the last one on in their order.

        A pose that has to be measured again comes first as long as nothing else was measured; later it comes last.
        """
        if self._rows is None:
            return torch.arange(len(self.plan.q))
        off = joint_differences(self.plan.arm.robot, self._rows.q, self.plan.q).abs().amax(-1)
        is_open = ~(off[self._counting] <= NEAR_POSE).any(0)
        last = int(off[-1].argmin()) if float(off[-1].min()) <= NEAR_POSE else 0
        return torch.roll(torch.arange(len(self.plan.q)), -last)[torch.roll(is_open, -last)]

    def _so_far(self) -> RowsSoFar:
        """All rows with their errors."""
        rows, robot = self._rows, self.plan.arm.robot
        if rows is None:
            nothing = np.zeros((0, 3))
            return RowsSoFar((), np.zeros((0, robot.dof)), nothing, nothing, *np.zeros((2, 0), dtype=bool))
        position, error = torch.full((2, rows.rows, 3), torch.nan, dtype=torch.float64)
        model, errors = self._judgement.model, self._judgement.errors
        if model is not None and errors is not None:
            geometry, usable = model.geometry, self._usable
            at = replace(rows.select(usable), rotation=None)
            T = predicted_poses(geometry.robot, geometry.bases, geometry.tools, at)
            bases = torch.stack(
                [transform_from_xyzrpy(torch.from_numpy(geometry.bases[name])) for name in at.frame]
            )
            position[usable] = (invert(bases) @ T)[:, :3, 3]
            error[usable] = (bases[:, :3, :3].mT @ errors.position[..., None])[..., 0]
        return RowsSoFar(
            rows.line,
            rows.q.numpy(),
            position.numpy(),
            error.numpy(),
            self._check.numpy(),
            (~self._counting).numpy(),
        )

    def _advice(self, left: int) -> Advice:
        """Whether to go on: not while all rows are wrong; a pose to be measured again comes before anything else."""
        if self._setup:
            return Advice("correct", of_all_rows(self._setup).sentence)
        last = None if self._rows is None else self._rows.line[-1]
        again = next((one for one in (*self._fixed, *self._contradicted.values()) if one.line == last), None)
        if again is not None and again.repeat:
            return Advice("repeat", again.sentence)
        settings = self._settings
        return advice(settings.limit_mm, settings.least_gain_mm, self._reached, self._expected, left)
