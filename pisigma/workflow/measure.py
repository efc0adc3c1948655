"""Measurement with a plan, which accepts rows one by one and returns faults, the next pose and advice to stop."""

import contextlib
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import count as counting_from
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Int64
from torch import Tensor

from pisigma.deployment.export.programs.planned import planned_program
from pisigma.files.engines.processes import BackgroundProcess, compute_here
from pisigma.files.output_file import write_atomically
from pisigma.files.progress import Progress
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.fields import UnusableRow
from pisigma.planning.plan_file import StoredPlan, read_plan
from pisigma.planning.plan_inputs import allow_measured_poses, find_candidates
from pisigma.planning.session.row_alarms import NEAR_POSE, alarm_of_all_rows, joint_differences
from pisigma.planning.session.session_accuracy import (
    SessionAccuracy,
    expected_accuracy,
    session_accuracy,
    with_cross_validation,
)
from pisigma.planning.session.session_rows import FurtherPoses, SessionRows, setup_sentence, stopping_advice
from pisigma.planning.session.state import (
    AccuracyPoint,
    Advice,
    Alarm,
    NextPose,
    RowsSoFar,
    SessionState,
    coverage,
)
from pisigma.planning.subject import RobotOrModel
from pisigma.planning.task import task_joint_values
from pisigma.robot.se3 import transform_from_xyz_zyx
from pisigma.workflow.settings.measuring import MeasureSettings

_STEP = 5
"""Number of poses between two points of the accuracy curve."""


class OutdatedError(Exception):
    """Error that ends a running calculation because new rows have arrived that it does not use."""


class MeasuringSession:
    """A robot that is being measured with a plan.

    `add` checks new rows at once. `update` looks for faults of the setup that all rows share, calibrates with the rows
    so far and replans the remaining poses, which takes a few seconds. `next_step` and `idle_step` return the same work
    in short steps, the most urgent one first. They may run in another thread than `add`, and within `in_background` in
    another process; their results are in the next `state`.

    Attributes:
        plan: the current plan.
        replanned: whether the plan differs from that with which the session started.
    """

    def __init__(self, plan: StoredPlan, settings: MeasureSettings = MeasureSettings()) -> None:
        """Start a session.

        Args:
            plan: the poses, and the settings with which they were planned.
            settings: see `MeasureSettings`.
        """
        plan = replace(plan, arm=allow_measured_poses(plan.settings, plan.arm))
        self.plan, self.replanned = plan, False
        self._lock, self._compute = threading.RLock(), compute_here
        self._settings = settings
        candidates = find_candidates(plan.settings, plan.arm)
        subject = RobotOrModel(plan.arm.nominal) if plan.model is None else RobotOrModel.load(plan.model)
        self._against = subject.model or plan.arm.robot
        self._task = task_joint_values(plan.arm, plan.settings, candidates.workspace_q, subject.model)
        self._further = FurtherPoses.from_plan(plan, candidates, self._task)
        self._before = subject.posterior(plan.arm, replace(plan.settings, measured=None))
        self._planned, self._planned_check = plan.q, plan.is_test_pose
        self._numbers = list(plan.numbers)
        self._judged = SessionRows(plan.arm.robot, self._before.instrument.sigma)
        self._setup, self._setup_alarms, self._looked_at = "", list[Alarm](), 0
        self._reached: list[AccuracyPoint] = []
        self._expected: tuple[AccuracyPoint, ...] = ()
        self._worked_out = 0
        self._so_far: SessionAccuracy | None = None
        self._ahead_of: SessionAccuracy | None = None
        self._validated: SessionAccuracy | None = None
        self._poses = int((~plan.is_test_pose).sum())

    @staticmethod
    def read(
        path: str | os.PathLike[str], settings: MeasureSettings = MeasureSettings()
    ) -> "MeasuringSession":
        """Start a session with the plan in a file.

        Raises:
            PlanningError: the file is not a plan.
            MeasurementError: the poses of the plan cannot be used.
        """
        return MeasuringSession(read_plan(path), settings)

    def add(self, rows: Measurements | None, left_out: Sequence[UnusableRow] = ()) -> tuple[Alarm, ...]:
        """Add new rows, and check every row against all other rows.

        Args:
            rows: the new rows in order; None if there are none.
            left_out: new rows that cannot be read.

        Returns:
            Faults of the new rows, and faults of earlier rows that the new rows reveal, in the order of the file.
        """
        with self._lock:
            alarms = self._judged.add(rows, left_out, self._planned, self._names)
        return tuple(sorted(alarms, key=lambda alarm: alarm.line))

    @contextlib.contextmanager
    def in_background(self) -> Iterator[None]:
        """Compute in another process, for which `add` and `state` do not wait, and which ends with the block."""
        process = BackgroundProcess()
        self._compute = process.compute
        try:
            yield
        finally:
            process.close()
            self._compute = compute_here

    @property
    def is_update_due(self) -> bool:
        """Whether there are enough new rows to update the accuracy; one before the first update or after the plan."""
        with self._lock:
            new = self._training_rows - self._worked_out
            soon = self._so_far is None or not len(self._open)
            return new >= (1 if soon else self._settings.every)

    def update(self, progress: Progress = lambda what: None) -> tuple[Alarm, ...]:
        """Check the setup, calibrate with the rows so far, cross-validate, and replan the remaining poses.

        Args:
            progress: called with the current step. An exception that it raises ends the work.

        Returns:
            New faults that all rows share.
        """
        alarms = self._calibrate(progress)
        if self._so_far is not self._ahead_of:
            self._look_ahead(progress)
        if self._so_far is not self._validated:
            self._cross_validate(progress)
        return alarms

    def next_step(self) -> Callable[[], tuple[Alarm, ...]] | None:
        """Return the most urgent step of `update`, except the cross-validation; None if all are done."""
        if self.is_update_due:
            return self._calibrate
        if self._so_far is not self._ahead_of:
            return self._look_ahead
        if self._rows is not None and self._looked_at < self._rows.rows:
            return self.check_setup
        return None

    def idle_step(self) -> Callable[[], tuple[Alarm, ...]] | None:
        """Return the cross-validation, which ends when new rows arrive; None if it is done."""
        return None if self._so_far is self._validated else self._cross_validate_idle

    def _calibrate(self, progress: Progress = lambda what: None) -> tuple[Alarm, ...]:
        """Check the setup, and compute the accuracy of a calibration with the rows so far."""
        alarms = self.check_setup()
        with self._lock:
            worked_out, self._worked_out = self._worked_out, self._training_rows
            if self._rows is None or self._setup or worked_out == self._worked_out:
                return alarms
            counting, check, rows = self._counting, self._check, self._rows
        training = rows.select(counting & ~check)
        kept_apart = rows.select(counting & check) if bool((counting & check).any()) else None
        # a session that starts with rows also gets the point before its first row, as an uninterrupted session does
        counts = [training.rows] if self._reached else [training.rows - self._settings.every, training.rows]
        parts = [training.select(torch.arange(max(count, 0))) for count in counts]
        found = [
            self._compute(
                partial(session_accuracy, self.plan, self._before, some, kept_apart, self._task), progress
            )
            for some in parts
        ]
        with self._lock:
            if found[-1] is not None:
                self._so_far = found[-1]
                self._reached += [one.point for one in found if one is not None]
        return alarms

    def check_setup(self) -> tuple[Alarm, ...]:
        """Look for a fault of the setup that affects all rows, and return the fault if it is new."""
        with self._lock:
            rows, usable, before = self._rows, self._judged.usable, self._setup
            counts = self._judged.judgement.used_rows
        if rows is None or self._looked_at == rows.rows:
            return ()
        found = self._compute(partial(setup_sentence, rows.select(usable), counts, self._against))
        with self._lock:
            self._setup, self._looked_at = found, rows.rows
            new = [alarm_of_all_rows(found)] if found and not before else []
            self._setup_alarms += new
        return tuple(new)

    def _look_ahead(self, progress: Progress = lambda what: None) -> tuple[Alarm, ...]:
        """Replan the remaining poses, and compute the accuracy expected after them."""
        with self._lock:
            so_far, remaining, measured = self._so_far, self._open, self.rows
        assert so_far is not None
        assert measured is not None
        progress("planning the remaining poses")
        again = None
        if self._settings.replan:
            arguments = self.plan, self._poses, so_far, measured.q, remaining
            again = self._compute(partial(self._further.replan, *arguments))
        with self._lock:
            if again is not None:
                self._adopt(again)
            remaining = self._open
            poses = self.plan.q[remaining[~self.plan.is_test_pose[remaining]]]
        ahead = self._compute(
            partial(
                expected_accuracy,
                so_far.posterior,
                so_far.point.poses,
                poses,
                self._further.q,
                self._task,
                _STEP,
            )
        )
        with self._lock:
            self._expected, self._ahead_of = ahead, so_far
        return ()

    def _cross_validate(self, progress: Progress = lambda what: None) -> tuple[Alarm, ...]:
        """Cross-validate the calibration so far."""
        so_far = self._so_far
        assert so_far is not None
        point = self._compute(partial(with_cross_validation, self.plan.arm.robot, so_far), progress)
        with self._lock:
            self._reached[-1], self._validated = point, so_far
        return ()

    def _cross_validate_idle(self) -> tuple[Alarm, ...]:
        """Cross-validate, and end without a result when new rows arrive."""
        judged = len(self._judged.usable)

        def unless_outdated(what: str) -> None:
            if len(self._judged.usable) != judged:
                raise OutdatedError

        with contextlib.suppress(OutdatedError):
            self._cross_validate(unless_outdated)
        return ()

    @property
    def rows(self) -> Measurements | None:
        """The rows that are used; None if there are none."""
        return None if self._rows is None else self._rows.select(self._counting)

    @property
    def state(self) -> SessionState:
        """Current state of the session."""
        with self._lock:
            return self._state()

    def _state(self) -> SessionState:
        rows, open_poses, model, counting = (
            self._all_rows(),
            self._open,
            self._judged.judgement.model,
            self.rows,
        )
        following = self._next_pose(int(open_poses[0])) if len(open_poses) else None
        base = None
        if model is not None:
            base = transform_from_xyz_zyx(torch.from_numpy(next(iter(model.geometry.bases.values())))).numpy()
        return SessionState(
            rows=rows,
            alarms=tuple(sorted(self._alarms, key=lambda alarm: alarm.line)),
            next_pose=following,
            remaining=self.plan.q[open_poses].numpy(),
            coverage=() if counting is None else coverage(self.plan.arm.robot, counting.q, self._planned),
            reached_accuracy=tuple(self._reached),
            expected_accuracy=self._expected,
            advice=self._advice(len(open_poses)),
            revolute=tuple(axis.type == "revolute" for axis in self.plan.arm.robot.axes),
            base=base,
        )

    def _next_pose(self, first: int) -> NextPose:
        q, check = self.plan.q[first].numpy(), bool(self.plan.is_test_pose[first])
        number = self.plan.numbers[first]
        return NextPose(number, max(self._numbers), q, check, self.plan.arm.robot.to_controller(q))

    @property
    def _names(self) -> list[str]:
        """Names, for sentences, of the poses that are or were planned."""
        return [f"pose {number} of the plan" for number in self._numbers]

    def write_remaining(self, path: Path, programs: Sequence[Path] = ()) -> None:
        """Write the remaining poses as a plan, and as robot programs.

        Args:
            path: CSV file of the plan.
            programs: files of robot programs, which are not written if no poses remain.

        Raises:
            OutputError: a file cannot be written.
        """
        with self._lock:
            remaining = self.plan.select_poses(self._open)
        remaining.write(path)
        for program in programs if len(remaining.q) else ():
            write_atomically(program, planned_program(remaining, program))

    def _adopt(self, plan: StoredPlan) -> None:
        """Continue with another plan; known poses keep their numbers, and new poses get the next numbers."""
        is_known = (plan.q[:, None] - self._planned).abs().amax(-1) <= 1e-9
        numbers = [self._numbers[int(row.int().argmax())] if bool(row.any()) else 0 for row in is_known]
        further = counting_from(1 + max(self._numbers))
        numbers = [number or next(further) for number in numbers]
        self.plan, self.replanned = replace(plan, number=tuple(numbers)), True
        self._planned = torch.cat([self._planned, plan.q])
        self._planned_check = torch.cat([self._planned_check, plan.is_test_pose])
        self._numbers += numbers

    @property
    def _training_rows(self) -> int:
        """Number of rows to calibrate with."""
        return 0 if self._rows is None else int((self._counting & ~self._check).sum())

    @property
    def _rows(self) -> Measurements | None:
        """All readable rows."""
        return self._judged.rows

    @property
    def _alarms(self) -> tuple[Alarm, ...]:
        """Faults of the setup, and of single rows."""
        return (*self._setup_alarms, *self._judged.alarms)

    @property
    def _counting(self) -> Bool[Tensor, " rows"]:
        """Mask of the rows that are used."""
        return self._judged.used_rows

    @property
    def _check(self) -> Bool[Tensor, " rows"]:
        """Return the mask of rows that test the calibration: the set "test" or, without sets, rows at test poses."""
        assert self._rows is not None
        if self._rows.split is not None:
            return torch.tensor([name == "test" for name in self._rows.split])
        near = joint_differences(self.plan.arm.robot, self._rows.q, self._planned).abs().amax(-1)
        nearest = near.min(1)
        return self._planned_check[nearest.indices] & (nearest.values <= NEAR_POSE)

    @property
    def _open(self) -> Int64[Tensor, " remaining"]:
        """Remaining poses of the plan, in order and starting from the pose that was measured last.

        A pose that must be measured again comes first until another pose is measured, and last afterwards.
        """
        if self._rows is None:
            return torch.arange(len(self.plan.q))
        off = joint_differences(self.plan.arm.robot, self._rows.q, self.plan.q).abs().amax(-1)
        is_open = ~(off[self._counting] <= NEAR_POSE).any(0)
        last = int(off[-1].argmin()) if float(off[-1].min()) <= NEAR_POSE else 0
        return torch.roll(torch.arange(len(self.plan.q)), -last)[torch.roll(is_open, -last)]

    def _all_rows(self) -> RowsSoFar:
        """Return all rows with their errors."""
        rows = self._rows
        if rows is None:
            return RowsSoFar.unjudged((), np.zeros((0, self.plan.arm.robot.dof)))
        flags = self._check.numpy(), (~self._counting).numpy()
        return RowsSoFar(rows.line, rows.q.numpy(), *self._judged.errors(), *flags)

    def _advice(self, left: int) -> Advice:
        """Return the advice: correct a fault of the setup, repeat a wrong row, continue, or stop, in this order."""
        if self._setup:
            return Advice("correct", alarm_of_all_rows(self._setup).sentence)
        last = None if self._rows is None else self._rows.line[-1]
        again = next((one for one in self._alarms if one.line == last), None)
        if again is not None and again.repeat:
            return Advice("repeat", again.sentence)
        settings = self._settings
        return stopping_advice(settings.limit_mm, settings.least_gain_mm, self._reached, self._expected, left)
