"""Plan which poses to measure: typed settings in, a typed plan out that writes itself as a table, and as programs."""

import math
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.deployment.export.programs.languages import LANGUAGES, check_program
from pisigma.deployment.export.programs.planned import planned_program
from pisigma.files.conflicts import Input
from pisigma.files.errors import MeasurementError
from pisigma.files.output_file import check_output, write_whole
from pisigma.files.progress import Progress
from pisigma.measurement.joint_range import row_warnings
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.model_source import HoldsModel
from pisigma.model.training_rows import known_rows, training_row_warnings
from pisigma.planning.board_views import BoardViews
from pisigma.planning.candidates import Candidates, spread
from pisigma.planning.choice import choose
from pisigma.planning.expected_accuracy import (
    CameraProspects,
    ExpectedAccuracy,
    RemainingError,
    curve,
    remaining_errors,
)
from pisigma.planning.knowledge import Knowledge
from pisigma.planning.plan_file import StoredPlan, yaml_of
from pisigma.planning.plan_inputs import find_candidates, read_planned_rows, views_of, with_measured
from pisigma.planning.plan_settings import PlanSettings
from pisigma.planning.subject import Subject
from pisigma.planning.surroundings.arm_in_cell import ArmInCell
from pisigma.planning.surroundings.cell import Cell, read_cell
from pisigma.planning.surroundings.motion import Motions
from pisigma.planning.task import task_poses
from pisigma.planning.tour import Tour, order_of_use, stages_of, tour
from pisigma.robot.description import Robot
from pisigma.validation.checks.camera import view_warnings
from pisigma.validation.checks.rows.row_check import MOVES
from pisigma.validation.gate import check_rows

STEP = 10
"""Poses between two points of the curve."""
WEAK = 0.1
"""Share of the variance that remains from which on what causes it is named."""
LITTLE = 0.1
"""Share of its range by which candidates move a joint at least, so that they stand for the workspace."""
ROUNDS = 4
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
        camera: what limits a calibration with images; None without a camera.
        seconds: time that planning took [s].
    """

    stored: StoredPlan
    candidates: Candidates
    curve: tuple[ExpectedAccuracy, ...]
    needed: int | None
    remaining: tuple[RemainingError, ...]
    travel: float
    warnings: tuple[str, ...]
    camera: CameraProspects | None
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
            "criterion": settings.criterion,
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
            **({} if self.camera is None else {"camera": self.camera.to_json()}),
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
    camera = () if settings.camera is None else (settings.camera.camera, settings.camera.board)
    read = (*inputs, settings.candidates_from, settings.task, settings.measured, *camera)
    check_output(path, (".csv",), "a plan", read)
    check_output(yaml_of(path), inputs=read)
    for program in programs:
        check_output(program, tuple(LANGUAGES), "a program", (*read, path))
        check_program(program, robot, False, None)


def plan(
    subject: Robot | CalibratedModel | HoldsModel | Subject | str | os.PathLike[str],
    settings: PlanSettings | None = None,
    cell: Cell | str | os.PathLike[str] | None = None,
    progress: Progress = lambda what: None,
) -> Plan:
    """Plan which poses to measure, in which order, and say what accuracy they are expected to give.

    Args:
        subject: the robot as drawn, or a model of it: a robot, a name of the catalogue, a robot file (YAML or URDF),
            a model, what holds it (a `CorrectedIK`, a `Calibration`), or its folder.
        settings: how. None: `PlanSettings()`.
        cell: what stands around the robot, or its YAML file; None for nothing.
        progress: called with what is being done.

    Raises:
        RobotError: there is no such robot.
        ModelError: there is no such model.
        MeasurementError: a file of joint values or of measurements cannot be used, or a mistake explains what was
            measured.
        IdentificationError: no calibration error explains what was measured.
        PlanningError: the cell cannot be used, or allows too few poses.
    """
    started, settings = time.perf_counter(), settings or PlanSettings()
    subject = subject if isinstance(subject, Subject) else Subject.of(subject)
    if cell is not None and not isinstance(cell, Cell):
        cell = read_cell(cell, subject.robot)
    arm = with_measured(settings, subject.arm(cell))
    progress("candidates")
    candidates = find_candidates(settings, arm)
    candidates.check_count(settings.count + settings.check)
    progress("what is known")
    repeated = _check_measured(subject.model, settings, arm.robot)
    knowledge = subject.knowledge(arm, settings)
    task = task_poses(arm, settings, candidates.workspace, subject.model)
    problem = _Problem(subject, settings, arm, candidates, knowledge, task)
    chosen, stored, way = problem.choose(progress)
    progress("expected accuracy")
    points = problem.curve(chosen)
    return Plan(
        stored,
        candidates,
        points,
        problem.needed(chosen, points),
        remaining_errors(knowledge.informed(candidates.q[chosen]), task),
        way.seconds,
        (*repeated, *_warnings(way), *arm.too_thick, *problem.still_joints, *problem.view_warnings(chosen)),
        problem.prospects(chosen),
        time.perf_counter() - started,
    )


@dataclass(frozen=True, eq=False)
class _Problem:
    """What is planned for, where, and what is known.

    Attributes:
        subject: the robot or the model.
        settings: how.
        arm: the robot in its cell.
        candidates: poses to choose from.
        knowledge: before the first of them is measured.
        task: joint values [rad or m] where the robot shall be accurate.
    """

    subject: Subject
    settings: PlanSettings
    arm: ArmInCell
    candidates: Candidates
    knowledge: Knowledge
    task: Float64[Tensor, "tasks dof"]

    @cached_property
    def views(self) -> BoardViews | None:
        """From where the camera has to see its board; None without a camera."""
        return views_of(self.settings, self.arm)

    @cached_property
    def measured(self) -> Float64[Tensor, "candidates values directions"]:
        """What measuring the candidates says; see `Knowledge.measured`."""
        return self.knowledge.measured(self.candidates.q)

    @cached_property
    def tool(self) -> Float64[Tensor, "tasks 3 directions"]:
        """How uncertain the tool is over the task; see `Knowledge.tool`."""
        return self.knowledge.tool(self.task)

    @property
    def anything_known(self) -> bool:
        """Whether something was measured already."""
        return self.subject.model is not None or self.settings.measured is not None

    def choose(self, progress: Progress) -> tuple[Int64[Tensor, " chosen"], StoredPlan, Tour]:
        """Choose poses to calibrate with and poses to check with, and order them.

        Poses that no free motion leads to are replaced by others. The most useful ones come first, in stages, so that
        measuring may end early.
        """
        q, count = self.candidates.q, self.settings.count
        free, motions = torch.arange(len(q)), Motions(self.arm, self.candidates.workspace)
        for _ in range(ROUNDS):
            progress(f"{count} of {len(free):,} candidates")
            chosen = free[choose(self.measured[free], self.tool, count, self.settings.criterion)]
            others = free[~torch.isin(free, chosen)]
            check = others[spread(self.arm, q[others], self.settings.check, q[chosen])]
            use = order_of_use(count, len(check))
            poses = torch.cat([chosen, check])[use]
            progress("order of the poses")
            stages = stages_of(len(poses))
            way = tour(motions, q[poses], self.settings.pace, stages=stages)
            free = free[~torch.isin(free, poses[way.left_out])]
            if not len(way.left_out) or len(free) < len(poses):
                break
        chosen = chosen[~torch.isin(chosen, poses[way.left_out])]
        ordered = poses[way.order]
        is_check, number = use[way.order] >= count, self.candidates.number[ordered]
        folder = self.subject.folder
        return (
            chosen,
            StoredPlan(self.arm, self.settings, folder, q[ordered], is_check, number, way.before),
            way,
        )

    def curve(self, chosen: Int64[Tensor, " chosen"]) -> tuple[ExpectedAccuracy, ...]:
        """Expected accuracy against the number of poses, 0 poses where something is known already."""
        first, count = 0 if self.anything_known else STEP, len(chosen)
        return self._curve(chosen, [*range(first, count, STEP), count])

    def needed(self, chosen: Int64[Tensor, " chosen"], points: Sequence[ExpectedAccuracy]) -> int | None:
        """The least number of the chosen poses with which the limit is expected to be reached."""
        limit = (self.settings.limit_mm or 0.0) / 1e3  # without a limit one that nothing reaches
        reached = next((index for index, point in enumerate(points) if point.p95 <= limit), None)
        if reached is None:
            return None
        high = points[reached].poses
        low = points[reached - 1].poses if reached else 0
        while high - low > 1:
            middle = (low + high) // 2
            (point,) = self._curve(chosen, [middle])
            low, high = (low, middle) if point.p95 <= limit else (middle, high)
        return high

    def prospects(self, chosen: Int64[Tensor, " chosen"]) -> CameraProspects | None:
        """What limits a calibration with the chosen images; None without a camera."""
        if self.views is None:
            return None
        return CameraProspects.of(self.knowledge, self.candidates, chosen, self.task, self.views, self.arm)

    @property
    def still_joints(self) -> tuple[str, ...]:
        """Which joints hardly move among the candidates of a file, a sentence; mostly none."""
        arm, q = self.arm, self.candidates.q
        if self.settings.candidates_from is None:
            return ()
        values, still = arm.robot.to_controller(q), []
        for axis, moved, (lower, upper) in zip(
            arm.robot.axes, (values.amax(0) - values.amin(0)).tolist(), arm.limits.tolist(), strict=True
        ):
            room = min(upper - lower, 2 * math.pi) if axis.type == "revolute" else upper - lower
            if math.isfinite(room) and moved < LITTLE * room:
                unit = axis.file_unit
                still.append(
                    f"{axis.name} by {axis.in_file_unit(moved):.3g} of {axis.in_file_unit(room):.4g} {unit}"
                )
        if not still:
            return ()
        return (
            f"The candidates move joint {', '.join(still)} only, and the expected errors are of poses like them unless "
            "--task names others; check the units of their columns.",
        )

    def view_warnings(self, chosen: Int64[Tensor, " chosen"]) -> tuple[str, ...]:
        """Where the chosen images are too frontal or of one branch of the arm, a sentence each."""
        if self.views is None:
            return ()
        q = self.candidates.q[chosen]
        return tuple(view_warnings(self.views.obliqueness(self.arm, q), q, self.arm.robot))

    def _curve(self, chosen: Int64[Tensor, " chosen"], counts: list[int]) -> tuple[ExpectedAccuracy, ...]:
        return curve(self.measured, self.tool, chosen, counts, self.settings.seed)


def _check_measured(model: CalibratedModel | None, settings: PlanSettings, robot: Robot) -> tuple[str, ...]:
    """Refuse rows that a mistake in the setup or in the file explains, and those that a model was made of already.

    Returns:
        A warning where the model may have been made of some of them.

    Raises:
        MeasurementError: they cannot be used; the message names the mistake.
    """
    if settings.measured is None:
        return ()
    rows = read_planned_rows(settings, settings.measured, robot).split_sets()[0]
    against = robot if model is None else model
    if implausible := check_rows(rows, against, may_move=MOVES).implausible:
        raise MeasurementError(f"{settings.measured}: {implausible[0].sentence}")
    if model is not None and bool(known_rows(model, rows).all()):
        raise MeasurementError(
            f"{settings.measured}: rows that model '{model.name}' does not know yet were wanted; it was made of these, "
            "and they would count twice. Plan with the model alone."
        )
    twice = "they count twice, and the expected errors are too small"
    known = () if model is None else training_row_warnings(model, rows, consequence=twice)
    return (*row_warnings(robot, rows), *known)


def _warnings(way: Tour) -> tuple[str, ...]:
    """What else should be known of a plan."""
    if not len(way.left_out):
        return ()
    left_out = f"{len(way.left_out)} poses were left out, as no motion that touches nothing leads to them"
    return (f"{left_out}; give more candidates.",)
