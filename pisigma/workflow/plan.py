"""Plan which poses to measure: typed settings in, a typed plan out that writes itself as a table, and as programs."""

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.errors import PlanningError
from pisigma.export.programs.languages import LANGUAGES, check_program
from pisigma.export.programs.planned import planned_program
from pisigma.files.conflicts import Input
from pisigma.files.output_file import check_output, write_whole
from pisigma.judging.progress import Progress
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.folder.model_folder import load_model
from pisigma.planning.candidates import Candidates, spread
from pisigma.planning.cell.arm_in_cell import ArmInCell
from pisigma.planning.cell.cell import Cell, read_cell
from pisigma.planning.choice import choose
from pisigma.planning.expected_accuracy import ExpectedAccuracy, RemainingError, curve, remaining_errors
from pisigma.planning.knowledge import Knowledge
from pisigma.planning.plan_file import StoredPlan, yaml_of
from pisigma.planning.plan_settings import PlanSettings
from pisigma.planning.task import drawn_model, read_task
from pisigma.planning.tour import Tour, tour
from pisigma.robot.description import Robot
from pisigma.se3 import invert, transform_from_xyzrpy

STEP = 10
"""Poses between two points of the curve."""
TASK_POSES = 300
"""Joint values that stand for the task, where more are stated or none."""
STARTS = 200
"""Joint values that the inverse kinematics of a drawn robot without a closed form starts from."""
WEAK = 0.1
"""Share of the variance that remains from which on what causes it is named."""
ROUNDS = 3
"""So often poses that cannot be reached are replaced."""


@dataclass(frozen=True, eq=False)
class Plan:
    """Poses to measure, and what is expected of them.

    Attributes:
        stored: the poses in their order, and what was planned.
        candidates: what they were chosen from.
        curve: errors of the tool's position over the task that are expected against the number of poses; 0 poses
            where something is known already.
        needed: number of poses with which the limit is expected to be reached; None where there is no limit, or it
            is not reached.
        remaining: what the error that remains is expected to come from, the largest first.
        travel: time that all of it takes [s].
        warnings: what else should be known, a sentence each.
        seconds: time that planning took [s].
    """

    stored: StoredPlan
    candidates: Candidates
    curve: tuple[ExpectedAccuracy, ...]
    needed: int | None
    remaining: tuple[RemainingError, ...]
    travel: float
    warnings: tuple[str, ...]
    seconds: float

    @property
    def poses(self) -> int:
        """Number of poses to calibrate with."""
        return int((~self.stored.check).sum())

    @property
    def checks(self) -> int:
        """Number of poses that are measured besides."""
        return int(self.stored.check.sum())

    @property
    def weak(self) -> tuple[str, ...]:
        """What will still be uncertain: groups of unknowns, and what each does to the expected error."""
        return tuple(
            f"{error.name}: {error.rms * 1e3:.3f} mm, {100 * error.share:.0f} % of the variance"
            for error in self.remaining
            if error.share >= WEAK
        )

    def to_json(self) -> dict[str, object]:
        """Return the figures as plain values: the result of `pisigma plan --json`."""
        last, settings = self.curve[-1], self.stored.settings
        return {
            "poses": self.poses,
            "check_poses": self.checks,
            "candidates": len(self.candidates.q),
            "refused": dict(self.candidates.refused.most_common()),
            "predicted_rms_mm": last.rms * 1e3,
            "predicted_p95_mm": last.p95 * 1e3,
            "curve": [
                {
                    "poses": point.poses,
                    "rms_mm": point.rms * 1e3,
                    "p95_mm": point.p95 * 1e3,
                    "random_rms_mm": point.random_rms * 1e3,
                }
                for point in self.curve
            ],
            "limit_mm": settings.limit_mm,
            "poses_needed": self.needed,
            "minutes": self.travel / 60,
            "way_points": sum(map(len, self.stored.way_points)),
            "weak": list(self.weak),
            "warnings": list(self.warnings),
            "seconds": self.seconds,
        }

    def save(self, path: str | os.PathLike[str], programs: Sequence[str | os.PathLike[str]] = ()) -> None:
        """Write the poses as a CSV, the plan's YAML beside it, and programs that go to the poses.

        Args:
            path: the CSV file.
            programs: files of controllers, by their suffixes.

        Raises:
            OutputError: a file cannot be written, or a controller's language does not go with the robot.
        """
        files = [Path(program) for program in programs]
        texts = [planned_program(self.stored, file) for file in files]
        self.stored.write(Path(path))
        for file, text in zip(files, texts, strict=True):
            write_whole(file, text)


def check_files(
    path: Path, programs: Sequence[Path], settings: PlanSettings, robot: Robot, inputs: Sequence[Input]
) -> None:
    """Make sure that a plan can be written where it is asked for: before the work.

    Raises:
        OutputError: see `Plan.save`.
    """
    read = (*inputs, settings.candidates_from, settings.task, settings.measured)
    check_output(path, (".csv",), "a plan", read)
    check_output(yaml_of(path), inputs=read)
    for program in programs:
        check_output(program, tuple(LANGUAGES), "a program", (*read, path))
        check_program(program, robot, False, None)


@dataclass(frozen=True, eq=False)
class Subject:
    """What is planned for.

    Attributes:
        robot: as drawn.
        model: None for a robot that was not calibrated yet.
        folder: of the model; None where it is in memory only, or there is none.
    """

    robot: Robot
    model: CalibratedModel | None = None
    folder: Path | None = None

    @staticmethod
    def of(
        subject: Robot | CalibratedModel | str | os.PathLike[str],
        base: str | None = None,
        tip: str | None = None,
    ) -> "Subject":
        """Load what is planned for.

        Args:
            subject: a robot, a name of the catalogue, a robot file (YAML or URDF), a model or its folder.
            base: of a URDF file the link that poses are given in.
            tip: of a URDF file the link that is the tool.

        Raises:
            RobotError: there is no such robot.
            ModelError: the folder cannot be used.
        """
        if isinstance(subject, Robot):
            return Subject(subject)
        if not isinstance(subject, CalibratedModel):
            if not Path(subject).is_dir():
                return Subject(Robot.load(subject, base, tip))
            return replace(Subject.of(load_model(Path(subject))), folder=Path(subject))
        if subject.drawn is None:
            raise PlanningError(
                f"model '{subject.name}' does not say how the robot is drawn; plan for its robot instead."
            )
        return Subject(subject.drawn, subject)

    def arm(self, cell: Cell | None) -> ArmInCell:
        """The robot in its cell, with the reflector where the cell says, or else where the model has its tool."""
        if self.model is None or (cell is not None and cell.tool is not None):
            return ArmInCell.of(self.robot, cell)
        return ArmInCell.of(self.robot.with_geometry(tool=self.model.identified.tool), cell)

    def knowledge(self, arm: ArmInCell, settings: PlanSettings) -> Knowledge:
        """What is known before the first pose of the plan is measured.

        Raises:
            IdentificationError: the model does not say how uncertain it is.
            MeasurementError: the rows that were measured cannot be used.
            PlanningError: the settings do not go together.
        """
        tracker = arm.cell.tracker
        anchor = None if tracker is None else tracker.position
        if self.model is not None:
            instrument = settings.instrument(None if anchor is None else self._in_frame(anchor))
            knowledge = Knowledge.of_model(self.model, instrument)
        else:
            knowledge = Knowledge.of_robot(arm.robot, settings.instrument(anchor))
        if settings.measured is None:
            return knowledge
        rows = Measurements.read_csv(settings.measured, arm.robot).split_sets()[0]
        return knowledge.after(rows) if self.model is None else knowledge.informed(rows.q)

    def _in_frame(self, point: Float64[Tensor, " 3"]) -> Float64[Tensor, " 3"]:
        """A point of the drawn robot's base frame in the frame that the model's positions are in [m]."""
        assert self.model is not None
        drawn, fitted = (
            transform_from_xyzrpy(torch.tensor(robot.base)) for robot in (self.robot, self.model.identified)
        )
        T = fitted @ invert(drawn)
        return T[:3, :3] @ point + T[:3, 3]


def plan(
    subject: Robot | CalibratedModel | Subject | str | os.PathLike[str],
    settings: PlanSettings | None = None,
    cell: Cell | str | os.PathLike[str] | None = None,
    progress: Progress = lambda what: None,
) -> Plan:
    """Plan which poses to measure, in which order, and say what accuracy they are expected to give.

    Args:
        subject: the robot as drawn, or a model of it: a robot, a name of the catalogue, a robot file (YAML or URDF),
            a model or its folder.
        settings: how. None: `PlanSettings()`.
        cell: what stands around the robot, or its YAML file; None for nothing.
        progress: called with what is being done.

    Raises:
        RobotError: there is no such robot.
        ModelError: there is no such model.
        MeasurementError: a file of joint values or of measurements cannot be used.
        PlanningError: the cell cannot be used, or allows too few poses.
    """
    started, settings = time.perf_counter(), settings or PlanSettings()
    subject = subject if isinstance(subject, Subject) else Subject.of(subject)
    if cell is not None and not isinstance(cell, Cell):
        cell = read_cell(cell, subject.robot)
    arm = subject.arm(cell)
    progress("candidates")
    candidates = settings.find_candidates(arm)
    candidates.check_count(settings.count + settings.check)
    progress("what is known")
    knowledge = subject.knowledge(arm, settings)
    task = _task(subject, settings, arm, candidates)
    criterion = settings.criterion or ("D" if subject.model is None and settings.measured is None else "I")
    allowed = torch.ones(len(candidates.q), dtype=torch.bool)
    for _ in range(ROUNDS):
        free = allowed.nonzero()[:, 0]
        progress(f"{settings.count} of {len(free):,} candidates")
        chosen = free[choose(knowledge, candidates.q[free], settings.count, task, criterion)]
        check = _check_poses(arm, candidates, free, chosen, settings.check)
        poses = torch.cat([chosen, check])
        progress("order of the poses")
        way = tour(arm, candidates.q[poses], settings.pace, candidates.q)
        allowed[poses[way.left_out]] = False
        if not len(way.left_out):
            break
    progress("expected accuracy")
    nothing = subject.model is None and settings.measured is None
    counts = [*range(STEP if nothing else 0, settings.count, STEP), settings.count]
    points = curve(knowledge, candidates.q, chosen, task, counts, settings.seed)
    stored = _stored(subject, settings, arm, candidates, poses, way)
    return Plan(
        stored,
        candidates,
        points,
        _needed(knowledge, candidates, chosen, task, settings, points),
        remaining_errors(knowledge.informed(candidates.q[chosen]), task),
        way.seconds,
        _warnings(way, task, settings),
        time.perf_counter() - started,
    )


def _task(
    subject: Subject, settings: PlanSettings, arm: ArmInCell, candidates: Candidates
) -> Float64[Tensor, "tasks dof"]:
    """Joint values [rad or m] where the robot shall be accurate: of the task's file, or where it can be measured."""
    q = candidates.q
    if settings.task is not None:
        q = read_task(settings.task, subject.model or drawn_model(arm.drawn, q[:STARTS]))
    some = torch.linspace(0, len(q) - 1, min(len(q), TASK_POSES)).round().long()
    return q[some]


def _check_poses(
    arm: ArmInCell,
    candidates: Candidates,
    free: Int64[Tensor, " free"],
    chosen: Int64[Tensor, " chosen"],
    count: int,
) -> Int64[Tensor, " checks"]:
    """Candidates that are measured besides, spread over what is left."""
    others = free[~torch.isin(free, chosen)]
    return others[spread(arm, candidates.q[others], count, candidates.q[chosen])]


def _stored(
    subject: Subject,
    settings: PlanSettings,
    arm: ArmInCell,
    candidates: Candidates,
    poses: Int64[Tensor, " poses"],
    way: Tour,
) -> StoredPlan:
    """The poses in their order."""
    ordered = poses[way.order]
    return StoredPlan(
        arm,
        settings,
        subject.folder,
        candidates.q[ordered],
        way.order >= settings.count,
        candidates.number[ordered],
        way.before,
    )


def _needed(
    knowledge: Knowledge,
    candidates: Candidates,
    chosen: Int64[Tensor, " chosen"],
    task: Float64[Tensor, "tasks dof"],
    settings: PlanSettings,
    points: Sequence[ExpectedAccuracy],
) -> int | None:
    """The least number of the chosen poses with which the limit is expected to be reached."""
    if settings.limit_mm is None:
        return None
    limit = settings.limit_mm / 1e3
    reached = next((index for index, point in enumerate(points) if point.rms <= limit), None)
    if reached is None:
        return None
    low, high = points[reached - 1].poses if reached else 0, points[reached].poses
    while high - low > 1:
        middle = (low + high) // 2
        (point,) = curve(knowledge, candidates.q, chosen, task, [middle], settings.seed)
        low, high = (low, middle) if point.rms <= limit else (middle, high)
    return high


def _warnings(way: Tour, task: Float64[Tensor, "tasks dof"], settings: PlanSettings) -> tuple[str, ...]:
    """What else should be known of a plan."""
    warnings = []
    if len(way.left_out):
        warnings.append(
            f"{len(way.left_out)} poses were left out, as no motion leads to them that touches nothing; give more "
            "candidates."
        )
    return tuple(warnings)
