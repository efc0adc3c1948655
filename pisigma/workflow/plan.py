"""Plan the poses to measure, and write the plan as a table and as robot programs."""

import math
import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.deployment.export.programs.languages import LANGUAGES, check_program
from pisigma.deployment.export.programs.planned import planned_program
from pisigma.files.conflicts import Input
from pisigma.files.output_file import check_output, write_atomically
from pisigma.files.progress import Progress
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.folder.model_folder import HasModel
from pisigma.planning.board_views import ViewConditions
from pisigma.planning.candidates import Candidates, select_spread_poses
from pisigma.planning.expected_accuracy import (
    CameraProspects,
    ExpectedAccuracy,
    RemainingError,
    accuracy_curve,
    remaining_errors,
)
from pisigma.planning.plan_file import StoredPlan, yaml_of
from pisigma.planning.plan_inputs import allow_measured_poses, check_measured, find_candidates, views_of
from pisigma.planning.plan_settings import PlanSettings
from pisigma.planning.pose_selection import complete_selection
from pisigma.planning.robot_posterior import RobotPosterior
from pisigma.planning.subject import RobotOrModel
from pisigma.planning.surroundings.arm_in_surroundings import ArmInSurroundings
from pisigma.planning.surroundings.motion import Motions
from pisigma.planning.surroundings.surroundings import Surroundings, read_surroundings
from pisigma.planning.task import task_joint_values
from pisigma.planning.tour import Tour, order_of_use, plan_tour, stage_ends
from pisigma.robot.description import Robot
from pisigma.validation.checks.camera import view_warnings

_STEP = 10
"""Number of poses between two points of the accuracy curve."""
_MIN_WEAK_SHARE = 0.1
"""Share of the remaining variance above which a warning names its cause."""
_MIN_RANGE_SHARE = 0.1
"""Share of a joint's range that the candidates must cover in order to represent the workspace."""
_MAX_ROUNDS = 6
"""Maximum number of times that poses are added in place of unreachable ones."""


@dataclass(frozen=True, eq=False)
class Plan:
    """Result of `plan`: poses to measure, and the accuracy expected after measuring them.

    Attributes:
        stored_plan: the poses in their order, and the settings of the plan.
        candidates: poses from which the planned poses were chosen.
        accuracy_curve: expected errors of the tool's position over the task, by number of poses, starting from 0 poses
            if there are earlier measurements.
        poses_needed: number of poses with which the limit is expected to be reached; None if there is no limit, or if
            it is not reached.
        error_sources: sources of the expected remaining error, largest first.
        duration: duration of the measurement [s].
        warnings: sentences with other remarks.
        camera: limits of a calibration with images; None if there is no camera.
        seconds: computing time [s].
    """

    stored_plan: StoredPlan
    candidates: Candidates
    accuracy_curve: tuple[ExpectedAccuracy, ...]
    poses_needed: int | None
    error_sources: tuple[RemainingError, ...]
    duration: float
    warnings: tuple[str, ...]
    camera: CameraProspects | None
    seconds: float

    @property
    def calibration_pose_count(self) -> int:
        """Number of poses to calibrate with."""
        return int((~self.stored_plan.is_test_pose).sum())

    @property
    def test_pose_count(self) -> int:
        """Number of poses to test the calibration with."""
        return int(self.stored_plan.is_test_pose.sum())

    @property
    def main_error_sources(self) -> tuple[str, ...]:
        """Groups of unknowns that will remain uncertain, and the contribution of each to the expected error."""
        return tuple(
            f"{error.name}: {error.rms * 1e3:.3f} mm, {100 * error.variance_share:.0f} % of the variance"
            for error in self.error_sources
            if error.variance_share >= _MIN_WEAK_SHARE
        )

    def to_json(self) -> dict[str, object]:
        """Return the figures as plain values: the result of `pisigma plan --json`."""
        last, settings = self.accuracy_curve[-1], self.stored_plan.settings
        return {
            "poses": self.calibration_pose_count,
            "check_poses": self.test_pose_count,
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
                for point in self.accuracy_curve
            ],
            "limit_mm": settings.limit_mm,
            "poses_needed": self.poses_needed,
            "minutes": self.duration / 60,
            "way_points": sum(map(len, self.stored_plan.waypoints)),
            "main_error_sources": list(self.main_error_sources),
            "warnings": list(self.warnings),
            **({} if self.camera is None else {"camera": self.camera.to_json()}),
            "seconds": self.seconds,
        }

    def save(self, path: str | os.PathLike[str], programs: Sequence[str | os.PathLike[str]] = ()) -> None:
        """Write the poses as a CSV file, the settings as a YAML file next to it, and robot programs of the poses.

        Args:
            path: the CSV file.
            programs: files of robot programs, whose suffixes choose the languages.

        Raises:
            OutputError: a file cannot be written, or a language does not support the robot.
        """
        files = [Path(program) for program in programs]
        texts = [planned_program(self.stored_plan, file) for file in files]
        self.stored_plan.write(Path(path))
        for file, text in zip(files, texts, strict=True):
            write_atomically(file, text)


def check_plan_outputs(
    path: Path, programs: Sequence[Path], settings: PlanSettings, robot: Robot, inputs: Sequence[Input]
) -> None:
    """Check that a plan can be written, before it is computed.

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
    subject: Robot | CalibratedModel | HasModel | RobotOrModel | str | os.PathLike[str],
    settings: PlanSettings | None = None,
    surroundings: Surroundings | str | os.PathLike[str] | None = None,
    progress: Progress = lambda what: None,
) -> Plan:
    """Plan the poses to measure and their order, and predict the accuracy of a calibration with these poses.

    Args:
        subject: the nominal robot (a robot, a catalogue name, a robot file in YAML or URDF), or a model of it (a model,
            an object that contains a model, such as a `CorrectedIK` or a `Calibration`, or a folder).
        settings: see `PlanSettings`; None for the defaults.
        surroundings: surroundings of the robot, or their YAML file; None for no obstacles.
        progress: called with the current step.

    Raises:
        RobotError: the robot is unknown.
        ModelError: the model is unknown.
        MeasurementError: a file of joint values or of measurements cannot be used, or a fault of the setup explains
            the measurements.
        IdentificationError: no geometric errors of the robot explain the measurements.
        PlanningError: the surroundings cannot be used, or too few poses are possible in them.
    """
    started, settings = time.perf_counter(), settings or PlanSettings()
    subject = subject if isinstance(subject, RobotOrModel) else RobotOrModel.load(subject)
    if surroundings is not None and not isinstance(surroundings, Surroundings):
        surroundings = read_surroundings(surroundings, subject.robot)
    arm = allow_measured_poses(settings, subject.arm(surroundings))
    progress("candidates")
    candidates = find_candidates(settings, arm)
    candidates.check_count(settings.count + settings.check)
    progress("prior knowledge")
    repeated = check_measured(subject.model, settings, arm.robot)
    posterior = subject.posterior(arm, settings)
    task = task_joint_values(arm, settings, candidates.workspace_q, subject.model)
    problem = _Problem(subject, settings, arm, candidates, posterior, task)
    chosen, stored, way, usable = problem.choose(progress)
    progress("expected accuracy")
    points = problem.curve(chosen, usable)
    return Plan(
        stored,
        candidates,
        points,
        problem.poses_needed(chosen, points),
        remaining_errors(posterior.after_measuring(candidates.q[chosen]), task),
        way.seconds,
        (
            *repeated,
            *_warnings(way, len(candidates.q) - len(usable), candidates),
            *arm.unchecked_link_sentences,
            *problem.unexcited_joints,
            *problem.view_warnings(chosen),
        ),
        problem.expected_camera_accuracy(chosen),
        time.perf_counter() - started,
    )


@dataclass(frozen=True, eq=False)
class _Problem:
    """The planning problem: robot, surroundings, candidates, task, and distribution of the unknowns.

    Attributes:
        subject: the robot or the model.
        settings: settings of the plan.
        arm: the robot in its surroundings.
        candidates: poses to choose from.
        posterior: distribution of the unknowns before the first pose is measured.
        task: joint values at which the robot must be accurate [rad or m].
    """

    subject: RobotOrModel
    settings: PlanSettings
    arm: ArmInSurroundings
    candidates: Candidates
    posterior: RobotPosterior
    task: Float64[Tensor, "tasks dof"]

    @cached_property
    def views(self) -> ViewConditions | None:
        """Constraints on the views of the board; None without a camera."""
        return views_of(self.settings, self.arm)

    @cached_property
    def measured(self) -> Float64[Tensor, "candidates values directions"]:
        """Sensitivities of the candidates' measurements; see `RobotPosterior.sensitivities`."""
        return self.posterior.sensitivities(self.candidates.q)

    @cached_property
    def tool(self) -> Float64[Tensor, "tasks 3 directions"]:
        """Return the uncertainty of the position of the tool over the task; see `RobotPosterior.tool_derivatives`."""
        return self.posterior.tool_derivatives(self.task)

    @property
    def has_measurements(self) -> bool:
        """Whether there are earlier measurements."""
        return self.subject.model is not None or self.settings.measured is not None

    def choose(
        self, progress: Progress
    ) -> tuple[Int64[Tensor, " chosen"], StoredPlan, Tour, Int64[Tensor, " usable"]]:
        """Choose poses to calibrate with and poses to test with, order them, and return the usable candidates.

        Poses without a collision-free path are replaced, by candidates from which most of the task can be reached. The
        most informative poses come first, in stages, so that the measurement may end early.
        """
        q, count = self.candidates.q, self.settings.count
        free, motions = torch.arange(len(q)), Motions(self.arm, self.candidates.workspace_q)
        kept, kept_check = free[:0], free[:0]
        for earlier_rounds in range(_MAX_ROUNDS):
            progress(f"{count} of {len(free):,} candidates")
            others = _without(free, torch.cat([kept, kept_check]))
            chosen = complete_selection(
                self.measured, self.tool, kept, others, count, self.settings.criterion
            )
            others, taken = _without(others, chosen), q[torch.cat([chosen, kept_check])]
            missing = self.settings.check - len(kept_check)
            check = torch.cat([kept_check, others[select_spread_poses(self.arm, q[others], missing, taken)]])
            use = order_of_use(count, len(check))
            poses = torch.cat([chosen, check])[use]
            progress("order of the poses")
            way = plan_tour(motions, q[poses], self.settings.pace, stages=stage_ends(len(poses)))
            free = _without(free, poses[way.left_out])
            if len(way.left_out) and not earlier_rounds:
                most = free[motions.reach_most_of_task(q[free], self.task)]
                free = most if len(most) >= len(poses) else free
            kept, kept_check = (some[torch.isin(some, free)] for some in (chosen, check))
            if not len(way.left_out) or len(free) < len(poses):
                break
        ordered = poses[way.order]
        is_check, number = use[way.order] >= count, self.candidates.number[ordered]
        folder = self.subject.folder
        return (
            kept,
            StoredPlan(self.arm, self.settings, folder, q[ordered], is_check, number, way.waypoints_before),
            way,
            free,
        )

    def curve(
        self, chosen: Int64[Tensor, " chosen"], usable: Int64[Tensor, " usable"]
    ) -> tuple[ExpectedAccuracy, ...]:
        """Return the expected accuracy by the number of poses, from 0 poses if there are earlier measurements."""
        first, count = 0 if self.has_measurements else _STEP, len(chosen)
        return self._curve(chosen, [*range(first, count, _STEP), count], usable)

    def poses_needed(
        self, chosen: Int64[Tensor, " chosen"], points: Sequence[ExpectedAccuracy]
    ) -> int | None:
        """Return the smallest number of the chosen poses with which the limit is expected to be reached."""
        limit = (self.settings.limit_mm or 0.0) / 1e3  # without a limit, 0 m is used, which is never reached
        reached = next((index for index, point in enumerate(points) if point.p95 <= limit), None)
        if reached is None:
            return None
        high = points[reached].poses
        low = points[reached - 1].poses if reached else 0
        while high - low > 1:  # bisection, because the expected error decreases with the number of poses
            middle = (low + high) // 2
            (point,) = self._curve(chosen, [middle])
            low, high = (low, middle) if point.p95 <= limit else (middle, high)
        return high

    def expected_camera_accuracy(self, chosen: Int64[Tensor, " chosen"]) -> CameraProspects | None:
        """Return the limits of a calibration with the chosen images; None if there is no camera."""
        if self.views is None:
            return None
        return CameraProspects.from_candidates(
            self.posterior, self.candidates, chosen, self.task, self.views, self.arm
        )

    @property
    def unexcited_joints(self) -> tuple[str, ...]:
        """Warning about joints that the candidates of a file hardly move; empty if there are none."""
        arm, q = self.arm, self.candidates.q
        if self.settings.candidates_from is None:
            return ()
        values, still = arm.robot.to_controller(q), []
        for axis, moved, (lower, upper) in zip(
            arm.robot.axes, (values.amax(0) - values.amin(0)).tolist(), arm.limits.tolist(), strict=True
        ):
            room = min(upper - lower, 2 * math.pi) if axis.type == "revolute" else upper - lower
            if math.isfinite(room) and moved < _MIN_RANGE_SHARE * room:
                unit = axis.file_unit
                still.append(
                    f"{axis.name} by {axis.in_file_unit(moved):.3g} of {axis.in_file_unit(room):.4g} {unit}"
                )
        if not still:
            return ()
        return (
            f"The candidates move joint {', '.join(still)} only, and without --task the expected errors are those of "
            "such poses; check the units of their columns.",
        )

    def view_warnings(self, chosen: Int64[Tensor, " chosen"]) -> tuple[str, ...]:
        """Return warnings about images that are too frontal, or show only one configuration of the arm."""
        if self.views is None:
            return ()
        q = self.candidates.q[chosen]
        found = view_warnings(self.views.incidence_angles(self.arm, q), q, self.arm.robot)
        return tuple(one.sentence for one in found)

    def _curve(
        self,
        chosen: Int64[Tensor, " chosen"],
        counts: list[int],
        usable: Int64[Tensor, " usable"] | None = None,
    ) -> tuple[ExpectedAccuracy, ...]:
        return accuracy_curve(self.measured, self.tool, chosen, counts, self.settings.seed, usable)


def _without(indices: Int64[Tensor, " all"], removed: Int64[Tensor, " removed"]) -> Int64[Tensor, " rest"]:
    return indices[~torch.isin(indices, removed)]


def _warnings(way: Tour, unused: int, candidates: Candidates) -> Iterator[str]:
    """Return warnings about poses and candidates without a collision-free path."""
    if unused:
        yield (
            f"{unused:,} of {len(candidates.q):,} candidates were not used, because no collision-free path between "
            "them and the planned poses was found; the motion to the first pose must not start there."
        )
    if len(way.left_out):
        yield (
            f"{len(way.left_out)} poses were left out, because there is no collision-free path to them; give more "
            "candidates."
        )
