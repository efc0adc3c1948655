"""Rows of a measuring session: selection of rows to use, alarms about others, replanning of remaining poses."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.calibration.geometric.prediction import predicted_poses
from pisigma.measurement.camera.corner_file import with_common_noise
from pisigma.measurement.dataset import Measurements, join
from pisigma.measurement.fields import UnusableRow
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.planning.candidates import Candidates
from pisigma.planning.plan_file import StoredPlan
from pisigma.planning.pose_selection import select_poses
from pisigma.planning.session.row_alarms import (
    NEAR_POSE,
    contradiction_alarm,
    is_wrong,
    joint_differences,
    stale_reading_alarms,
    unplanned_joint_alarms,
    unreadable_alarm,
    withdrawn_alarm,
)
from pisigma.planning.session.row_judgement import FEW_ROWS, RowJudgement, judge_rows
from pisigma.planning.session.session_accuracy import SessionAccuracy
from pisigma.planning.session.state import AccuracyPoint, Advice, Alarm
from pisigma.planning.surroundings.motion import Motions
from pisigma.planning.tour import order_of_use, plan_tour
from pisigma.robot.description import Robot
from pisigma.robot.se3 import invert, transform_from_xyz_zyx
from pisigma.validation.checks.check import MOVES
from pisigma.validation.checks.mixed_rows import MIN_WRONG_SHARE
from pisigma.validation.gate import check_rows

_MAX_CANDIDATES = 1_000
"""Largest number of candidates of the plan that are considered."""
_MAX_REPLACEMENTS = 3
"""Largest number of attempts to replace poses that no free motion reaches."""


class SessionRows:
    """Rows of a session, each checked against all others as they arrive.

    Attributes:
        rows: all readable rows in the order of the file; None if there are none.
        usable: rows that are not copies of other rows.
        judgement: result of `judge_rows` for the usable rows.
        alarms: alarms on single rows.
    """

    def __init__(self, robot: Robot, sigma: float) -> None:
        """Start without rows.

        Args:
            robot: nominal robot.
            sigma: standard deviation of measured lengths if rows state none [m].
        """
        self._robot, self._sigma = robot, sigma
        self.rows: Measurements | None = None
        self.usable = torch.zeros(0, dtype=torch.bool)
        self.judgement = RowJudgement(self.usable)
        self._fixed: list[Alarm] = []
        self._contradicted: dict[int, Alarm] = {}

    @property
    def alarms(self) -> tuple[Alarm, ...]:
        """Alarms about single rows."""
        return (*self._fixed, *self._contradicted.values())

    @property
    def used_rows(self) -> Bool[Tensor, " rows"]:
        """Rows that are usable and not contradicted by others."""
        counting = self.usable.clone()
        counting[self.usable] = self.judgement.used_rows
        return counting

    def add(
        self,
        new: Measurements | None,
        left_out: Sequence[UnusableRow],
        planned: Float64[Tensor, "poses dof"],
        names: Sequence[str],
    ) -> list[Alarm]:
        """Add new rows, and check all rows together.

        Args:
            new: new rows in their order; None if there are none.
            left_out: rows that cannot be read.
            planned: joint values of all planned poses [rad or m].
            names: names of these poses.

        Returns:
            New alarms about these rows or earlier ones.
        """
        alarms = [unreadable_alarm(row) for row in left_out]
        changed: list[Alarm] = []
        if new is not None and new.rows:
            start = 0 if self.rows is None else self.rows.rows
            self.rows = rows = new if self.rows is None else with_common_noise(join([self.rows, new]))
            stale = list(stale_reading_alarms(rows, start))
            copies = {alarm.line for alarm in stale}
            usable = torch.tensor([line not in copies for line in rows.line[start:]])
            remarks = unplanned_joint_alarms(self._robot, rows, start, planned, names)
            alarms += [*stale, *(alarm for alarm in remarks if alarm.line not in copies)]
            self.usable = torch.cat([self.usable, usable])
            changed = self._judge(rows, planned, names)
        self._fixed += [*alarms, *(alarm for alarm in changed if alarm.kind == "cleared")]
        return [*alarms, *changed]

    def _judge(
        self, rows: Measurements, planned: Float64[Tensor, "poses dof"], names: Sequence[str]
    ) -> list[Alarm]:
        """Check all usable rows, and return the new alarms."""
        numbers = self.usable.nonzero()[:, 0]
        usable, judgement = rows.select(numbers), self.judgement
        for upto in _steps(len(judgement.used_rows), len(numbers)):
            trusted = torch.zeros(upto, dtype=torch.bool)
            trusted[: len(judgement.used_rows)] = judgement.used_rows
            some = usable.select(torch.arange(upto))
            judgement = judge_rows(self._robot, some, self._sigma, trusted)
        self.judgement = judgement
        wrong = {
            int(numbers[row]): contradiction_alarm(usable, judgement, row, planned, names)
            for row in is_wrong(judgement).nonzero()[:, 0].tolist()
        }
        agreed = [withdrawn_alarm(rows.line[row]) for row in self._contradicted if row not in wrong]
        new = [alarm for row, alarm in wrong.items() if row not in self._contradicted]
        self._contradicted = {row: self._contradicted.get(row, alarm) for row, alarm in wrong.items()}
        return [*new, *agreed]

    def errors(self) -> tuple[Float64[np.ndarray, "rows 3"], Float64[np.ndarray, "rows 3"]]:
        """Return the predicted position of the target, and measured minus predicted, in the robot's base frame [m].

        NaN where they are unknown.
        """
        rows, model, errors = self.rows, self.judgement.model, self.judgement.errors
        position, error = torch.full((2, len(self.usable), 3), torch.nan, dtype=torch.float64)
        if rows is not None and model is not None and errors is not None:
            geometry, usable = model.geometry, self.usable
            at = replace(rows.select(usable), rotation=None)
            T = predicted_poses(geometry.robot, geometry.bases, geometry.tools, at)
            those = [torch.from_numpy(geometry.bases[name]) for name in at.frame]
            bases = transform_from_xyz_zyx(torch.stack(those))
            position[usable] = (invert(bases) @ T)[:, :3, 3]
            error[usable] = (bases[:, :3, :3].mT @ errors.position_error[..., None])[..., 0]
        return position.numpy(), error.numpy()


def _steps(known: int, count: int) -> Iterator[int]:
    """Yield the numbers of rows after which rows are checked, if `known` rows have already been checked.

    Rows are checked against the rows accepted before, so the number of rows at most doubles. Rows that are added
    together are then also checked against each other.
    """
    upto = known
    while upto < count:
        upto = min(count, max(FEW_ROWS, 2 * upto))
        yield upto
    if count > max(known + 1, FEW_ROWS):
        yield count


def setup_sentence(
    rows: Measurements, used_rows: Bool[Tensor, " rows"], reference: Robot | CalibratedModel
) -> str:
    """Return a sentence about a fault that all rows have in common; "" if there is none.

    If a quarter of the rows or more contradict the others, all rows are checked, including these.

    Args:
        rows: all usable rows.
        used_rows: rows that are not contradicted by others.
        reference: the nominal robot, or the planned model.
    """
    some = rows.select(used_rows) if used_rows.double().mean() > 1 - MIN_WRONG_SHARE else rows
    found = check_rows(some, reference, allowed_moves=MOVES).implausible_findings
    return found[0].sentence if found else ""


@dataclass(frozen=True, eq=False)
class FurtherPoses:
    """Candidates for replanning the remaining poses.

    Attributes:
        q: joint values [rad or m].
        number: number of each pose among the candidates of the plan.
        motions: motions between poses.
        task: joint values at which the robot must be accurate [rad or m].
    """

    q: Float64[Tensor, "candidates dof"]
    number: Int64[Tensor, " candidates"]
    motions: Motions
    task: Float64[Tensor, "tasks dof"]

    @staticmethod
    def from_plan(
        plan: StoredPlan, candidates: Candidates, task: Float64[Tensor, "tasks dof"]
    ) -> "FurtherPoses":
        """Return evenly selected candidates of a plan."""
        count = len(candidates.q)
        some = torch.linspace(0, count - 1, min(count, _MAX_CANDIDATES)).round().long()
        motions = Motions(plan.arm, candidates.workspace_q[:_MAX_CANDIDATES])
        return FurtherPoses(candidates.q[some], candidates.number[some], motions, task)

    def replan(
        self,
        plan: StoredPlan,
        pose_count: int,
        accuracy_so_far: SessionAccuracy,
        measured: Float64[Tensor, "rows dof"],
        remaining: Int64[Tensor, " remaining"],
    ) -> StoredPlan | None:
        """Select the remaining poses again, given the rows so far; the next pose and the test poses are kept.

        Args:
            plan: the current plan.
            pose_count: total number of poses to calibrate with.
            accuracy_so_far: posterior and accuracy given the rows so far.
            measured: joint values of the rows in use [rad or m].
            remaining: indices of the remaining poses, beginning with the next.

        Returns:
            The new plan; None if nothing can be selected.
        """
        first = remaining[:1]
        check = remaining[1:][plan.is_test_pose[remaining[1:]]]
        count = pose_count - accuracy_so_far.point.poses - int((~plan.is_test_pose[first]).sum())
        new = self._new(plan, torch.cat([measured, plan.q[first]]))
        posterior = accuracy_so_far.posterior
        if not len(first) or not 0 < count <= len(new):
            return None
        # The robot is already on its way to the next pose, which counts as measured unless it only tests the model.
        if not bool(plan.is_test_pose[first]):
            posterior = posterior.after_measuring(plan.q[first])
        seen, tool = posterior.sensitivities(self.q), posterior.tool_derivatives(self.task)
        for _ in range(_MAX_REPLACEMENTS):
            if count > len(new):
                return None
            chosen = new[select_poses(seen[new], tool, count, plan.settings.criterion)]
            # Poses that test the model are spread among the others, so that a session that ends early contains both
            # kinds.
            use = order_of_use(count, len(check))
            q = torch.cat([self.q[chosen], plan.q[check]])[use]
            way = plan_tour(self.motions, q, plan.settings.pace, plan.q[first[0]], stages=(_AHEAD,))
            left_out = use[way.left_out]
            # Poses without a collision-free motion to them are replaced by the next best ones.
            shut_in = left_out[left_out < count]
            new = new[~torch.isin(new, chosen[shut_in])]
            if not len(shut_in):
                break
        number = torch.cat([self.number[chosen], plan.candidate_number[check]])[use]
        return replace(
            plan.select_poses(first),
            q=torch.cat([plan.q[first], q[way.order]]),
            is_test_pose=torch.cat([plan.is_test_pose[first], use[way.order] >= count]),
            candidate_number=torch.cat([plan.candidate_number[first], number[way.order]]),
            waypoints=(plan.waypoints[int(first)], *way.waypoints_before),
            number=(),
        )

    def _new(self, plan: StoredPlan, known: Float64[Tensor, "known dof"]) -> Int64[Tensor, " new"]:
        """Return the indices of candidates that are neither measured nor the next pose."""
        off = joint_differences(plan.arm.robot, self.q, known).abs().amax(-1)
        return (off > NEAR_POSE).all(1).nonzero()[:, 0]


_AHEAD = 10
"""Number of upcoming poses whose expected benefit decides whether to stop."""


def stopping_advice(
    limit_mm: float | None,
    least_gain_mm: float,
    reached_accuracy: Sequence[AccuracyPoint],
    expected_accuracy: Sequence[AccuracyPoint],
    remaining: int,
) -> Advice:
    """Return advice on whether to continue measuring or to stop, with the reason.

    Args:
        limit_mm: limit on the 95 % quantile of the errors [mm]; None for no limit.
        least_gain_mm: decrease of this quantile due to the next `_AHEAD` poses, below which to stop [mm].
        reached_accuracy: accuracy so far. The limit is reached when the last two points are below it, because estimates
            from few rows scatter and the first point below the limit is often there by chance.
        expected_accuracy: expected accuracy after the remaining poses.
        remaining: number of remaining poses.
    """
    limit = "" if limit_mm is None else f"; the limit is {limit_mm:g} mm"
    if reached_accuracy:
        point = reached_accuracy[-1]
        now = f"95 % of the errors are expected to be below {point.predicted_p95 * 1e3:.3f} mm"
        below = [
            limit_mm is not None and one.predicted_p95 * 1e3 <= limit_mm for one in reached_accuracy[-2:]
        ]
        if len(below) > 1 and all(below):
            return Advice("stop", f"Stop: with {point.poses} poses, {now}{limit}.")
        confirm = ", which the next poses must confirm" if below[-1] else ""
        ahead = next((one for one in expected_accuracy if one.poses >= point.poses + _AHEAD), None) or next(
            reversed(expected_accuracy), None
        )
        gain = 0.0 if ahead is None else (point.predicted_p95 - ahead.predicted_p95) * 1e3
        if ahead is not None and gain < least_gain_mm:
            more = f"{ahead.poses - point.poses} more poses would lower this by only {max(gain, 0.0):.4f} mm"
            return Advice("stop", f"Stop: {now}{limit}; {more}.")
    if not remaining:
        return Advice("stop", f"Stop: all poses of the plan have been measured{limit}.")
    if not reached_accuracy:
        return Advice(
            "measure", f"{remaining} poses remain; there are too few rows to estimate the accuracy."
        )
    return Advice("measure", f"{remaining} poses remain; {now}{limit}{confirm}.")
