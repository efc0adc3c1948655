"""The geometric calibrator."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.geometric.identifiability.pairwise import find_pairwise_redundancy
from pisigma.calibration.geometric.identifiability.plausibility import refuse_implausible
from pisigma.calibration.geometric.identifiability.redundancy import (
    Findings,
    Redundancy,
    find_redundancies,
    rank_extension,
)
from pisigma.calibration.geometric.identifiability.sufficiency import (
    after_unknowns,
    candidates_at_start,
    floating_bases,
    free_parameters,
    refuse_too_few,
)
from pisigma.calibration.geometric.initial_guess.initial_guess import chosen_rows
from pisigma.calibration.geometric.problem.alike_setups import build_setups
from pisigma.calibration.geometric.problem.information import information
from pisigma.calibration.geometric.problem.least_squares import (
    SHORTEST_STEP,
    Linearisation,
    SearchEnd,
    Solution,
    levenberg_marquardt,
)
from pisigma.calibration.geometric.problem.noise import view_of
from pisigma.calibration.geometric.problem.parameters import ParameterSpace, Prior
from pisigma.calibration.geometric.problem.problem import CalibrationProblem
from pisigma.calibration.geometric.problem.robots import each_robot, of_robots
from pisigma.calibration.geometric.problem.setup import (
    CalibrationSetup,
    SetupOptions,
    identified_geometries,
)
from pisigma.calibration.geometric.problem.side_by_side import batches, pattern_of, side_by_side
from pisigma.calibration.geometric.result import CalibrationResult, SolvedCalibration
from pisigma.estimation.loss import AbstractLoss, HampelLoss
from pisigma.files.errors import IdentificationError
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.socket import PairOfSockets
from pisigma.robot.description import Robot
from pisigma.robot.robot_class import CLASSES
from pisigma.robot.row import FRAME_COLUMNS

Values = TypeVar("Values")
ROUGH_ROWS = 4_096
"""Rows that the initial guess and the first steps are worked out from."""
ROUGH_STEPS = 3
"""Steps without the prior, which show the noise before the prior is weighed against it."""


@dataclass(frozen=True)
class GeometricCalibrator:
    """Identifies DH + Hayati parameters, base and tool from measured poses or positions, by least squares.

    No initial guess is asked for: base and tool start in closed form, the arm at its nominal values.

    Attributes:
        robot: the nominal robot.
        free: "identifiable": all that the data can determine; "joint_offsets": theta of turning and d of sliding
            joints; or names of parameters, such as "a_2". Base and tool come on top, see below.
        base: "free", or "fixed" to the robot's own (then only parameters that `free` names are estimated).
        tool: the same for the tool; "position" frees x, y and z only.
        elimination: how redundant parameters are left out: "exact" (rank and pivoted QR), "pairwise" (the
            paper's Pearson correlation), or "none". The predicted poses do not depend on it.
        prior: standard deviations of the parameters' errors, or None. With it, what the data cannot determine
            stays at its nominal value.
        prior_sizes: "estimated": by the data, one factor on the prior for each of joint offsets, lengths, lengths
            drawn as 0, and angles between axes; "widened": one for lengths and one for angles, and only where
            the errors are larger than the prior says; "stated": as it is.
        frames: per frame of touches, about where the robot's base is in it: x, y, z [m], roll, pitch, yaw
            [rad], such as the planned placement of a jig. Needed only where the touches do not determine it.
        socket_distances: distances between two sockets [m], which determine the scale:
            `{("plate/0", "plate/1"): 0.05}`.
        socket_sigma: standard deviation of these distances [m].
        loss: `HampelLoss()` gives rows that are far off less weight or none; `SquaredLoss()` does not.
        maximum_iterations: steps tried at most.
        robot_class: "industrial", "cobot" or "hobby": how large errors can be; None: as the maker and the data say.
    """

    robot: Robot
    free: str | Sequence[str] = "identifiable"
    base: str = "free"
    tool: str = "free"
    elimination: str = "exact"
    prior: Prior | None = field(default_factory=Prior)
    loss: AbstractLoss = field(default_factory=HampelLoss)
    maximum_iterations: int = 100
    prior_sizes: str = "estimated"
    frames: Mapping[str, Sequence[float]] = field(default_factory=dict)
    socket_distances: Mapping[PairOfSockets, float] = field(default_factory=dict)
    socket_sigma: float = 1e-5
    robot_class: str | None = None

    def __post_init__(self) -> None:
        """Refuse options that do not exist."""
        for name, choices in (
            ("base", ("free", "fixed")),
            ("tool", ("free", "position", "fixed")),
            ("elimination", ("exact", "pairwise", "none")),
            ("prior_sizes", ("stated", "widened", "estimated")),
            ("robot_class", (None, *CLASSES)),
        ):
            if getattr(self, name) not in choices:
                raise IdentificationError(
                    f"{name}='{getattr(self, name)}' is no choice; valid: {', '.join(filter(None, choices))}."
                )
        if isinstance(self.free, str) and self.free not in ("identifiable", "joint_offsets"):
            valid = "identifiable, joint_offsets, or a list of parameter names"
            raise IdentificationError(f"free='{self.free}' is not valid; valid: {valid}.")
        if not isinstance(self.free, str) and "" in self.free:
            raise IdentificationError(
                f"free={tuple(self.free)}: a name is empty; give names of parameters such as a_2, with one "
                "comma between two."
            )
        for name, base in self.frames.items():
            if len(base) != 6 or not all(math.isfinite(value) for value in base):
                raise IdentificationError(
                    f"frames: six numbers were wanted for '{name}', x, y, z [m], roll, pitch, yaw [rad], got "
                    f"{tuple(base)}."
                )
        if not self.socket_sigma > 0:
            raise IdentificationError(f"expected socket_sigma > 0 [m], got {self.socket_sigma:g}.")

    @torch.inference_mode()
    def fit(self, measurements: Measurements) -> CalibrationResult:
        """Calibrate; see `solve` for what is raised."""
        return self.solve(measurements).result()

    @torch.inference_mode()
    def fit_many(self, data: Sequence[Measurements]) -> list[CalibrationResult]:
        """Calibrate several robots of one type: the same as `fit` of each in less time.

        Robots whose data are alike are calibrated side by side: equally many rows, with poses or positions in the same
        of them, in frames and of targets with the same names. Others are calibrated one by one. Predictions agree to
        rounding for positions, and for poses to some 1e-8 m, as rounding may decide whether a last step is taken.

        Args:
            data: the measurements of every robot.

        Raises:
            IdentificationError: see `solve`; the message names the measurements.
            PoseError: see `solve`.
        """
        return [solved.result() for solved in self.solve_many(data)]

    def solve(self, measurements: Measurements) -> SolvedCalibration:
        """Calibrate, and keep the problem and its solution for what is built upon them.

        Raises:
            IdentificationError: the measurements do not determine what is asked for, or are so far from the best
                fit that they cannot be of this robot; the message says what to measure or what to fix.
            PoseError: the joint values do not fit the robot.
        """
        return self.solve_many([measurements])[0]

    def solve_many(self, data: Sequence[Measurements]) -> list[SolvedCalibration]:
        """Calibrate several robots of one type, those whose data are alike side by side; see `fit_many` and `solve`."""
        robots = [_Robot(*pair) for pair in zip(data, self._build(data), strict=True)]
        patterns = [pattern_of(robot.setup.problem) if len(robots) > 1 else None for robot in robots]
        groups = _groups(patterns)
        for numbers in chain(*(batches(group, robots[group[0]].setup.problem.rows) for group in groups)):
            alike = [robots[number] for number in numbers]
            problem, start = _side_by_side(alike)
            self._choose(alike, problem, start)
            for some in _groups_of(alike, problem, start, [tuple(robot.active) for robot in alike]):
                self._solve(*some)
        return [robot.solved for robot in robots]

    def build(self, measurements: Measurements) -> CalibrationSetup:
        """The problem and its start, without solving it.

        Raises:
            IdentificationError: nothing usable was measured, or too little for base and tool.
            PoseError: the joint values do not fit the robot.
        """
        return self._build([measurements])[0]

    def _build(self, data: Sequence[Measurements]) -> list[CalibrationSetup]:
        """The problems of several robots of one type."""
        options = SetupOptions(
            free_base=self._finds("base"),
            free_tool=self._finds("tool"),
            turn_tool=self.tool == "free",
            frames={name: tuple(base) for name, base in self.frames.items()},
            socket_distances=self.socket_distances,
            socket_sigma=self.socket_sigma,
            prior_sizes=self.prior_sizes,  # type: ignore[arg-type]
        )
        return build_setups(self.robot, data, options, self.prior, self.loss)

    def _finds(self, group: str) -> bool:
        """Whether a start of bases or tools is wanted: they are free, or named (of a base all six)."""
        if getattr(self, group) != "fixed":
            return True
        if isinstance(self.free, str):
            return False
        columns = FRAME_COLUMNS if group == "base" else FRAME_COLUMNS[:3]
        return {f"{group}_{column}" for column in columns} <= set(self.free)

    def candidates(self, space: ParameterSpace) -> list[int]:
        """Indices of the parameters that may be estimated.

        Raises:
            IdentificationError: `free` names a parameter that does not exist.
        """
        chosen = {i for i, p in enumerate(space.parameters) if p.group == "base" and self.base == "free"}
        tools = list(space.of("tool")) if self.tool != "fixed" else []
        chosen |= {i for k, i in enumerate(tools) if self.tool == "free" or k % 6 < 3}
        if self.free == "identifiable":
            chosen |= set(range(space.arm_size))
        elif self.free == "joint_offsets":
            for row in self.robot.joint_rows:
                chosen.add(5 * row + (1 if self.robot.rows[row].type == "prismatic" else 0))
        else:
            chosen |= {index for name in self.free for index in space.indices(name)}
        return sorted(chosen)

    def _choose(self, robots: "list[_Robot]", problem: CalibrationProblem, start: Tensor) -> None:
        """Choose the parameters that robots with alike data start with.

        Raises:
            IdentificationError: the measurements of one do not determine them.
        """
        space, unknowns = problem.space, robots[0].setup.free_unknowns
        candidates, explicit, count = self.candidates(space), not isinstance(self.free, str), len(unknowns)
        at_start = []
        for robot, every in zip(robots, information(problem, start, unknowns + candidates), strict=True):
            robot.candidates, of_robot = candidates_at_start(robot.setup, candidates, every)
            at_start.append(of_robot)
        sizes = start.reshape(len(robots), -1).cpu().numpy()[:, robots[0].candidates]
        of_each = zip(robots, sizes, find_redundancies(at_start, sizes), strict=True)
        for robot, its_sizes, redundancy in of_each:
            refuse_too_few(robot.setup.problem, redundancy, explicit, count, robot.measurements.source)
            floating = set(floating_bases(robot.setup))
            chosen = self._chosen(space, its_sizes, redundancy)
            robot.active = [*(index for index in chosen if index not in floating), *unknowns]
            wanted = free_parameters(redundancy, explicit, count)
            robot.findings = Findings(its_sizes, redundancy, [], wanted)

    def _chosen(
        self,
        space: ParameterSpace,
        sizes: Float64[np.ndarray, " candidates"],
        redundancy: Redundancy,
    ) -> list[int]:
        """Indices of the parameters to start with."""
        if self.elimination == "exact":
            return [space.index(name) for name in redundancy.kept]
        names = redundancy.names
        if self.elimination == "pairwise":
            names = find_pairwise_redundancy(redundancy.information, sizes).kept
        return [space.index(name) for name in names]

    def _solve(self, robots: "list[_Robot]", problem: CalibrationProblem, start: Tensor) -> None:
        """Solve roughly without the prior, add what the data determine there, then solve with the prior.

        The rough steps show the noise that the prior is weighed against; a few thousand rows are enough for
        them. The robots have alike data, and start with the same free parameters.
        """
        problem = problem.with_active(robots[0].active)
        few = problem
        if problem.q.shape[0] > ROUGH_ROWS and not problem.robots:
            few = problem.select(chosen_rows(problem.q.shape[0], ROUGH_ROWS).to(problem.q.device))
        steps = min(ROUGH_STEPS, self.maximum_iterations)
        rough = levenberg_marquardt(few.without_prior(), start, steps, close_enough=1.0)
        here = rough.linearisation
        for robot, end in zip(robots, rough.ends, strict=True):
            robot.end = end
        self._extend(robots, few, here)
        extended = [tuple(robot.findings.extended) for robot in robots]
        for members, some, there in _groups_of(robots, problem, here, extended):
            if members[0].findings.extended:
                some = some.with_active(members[0].active)
            if members[0].findings.extended or few.q is not problem.q:
                there = some.linearise(there.point, there)
            else:
                there = some.combined(there.point, view_of(there))
            left = [self.maximum_iterations - robot.end.iterations for robot in members]
            fine = levenberg_marquardt(some, there, left, close_enough=SHORTEST_STEP)
            _finish(members, some, fine)

    def _extend(
        self, robots: "list[_Robot]", problem: CalibrationProblem, here: Linearisation[Tensor]
    ) -> None:
        """Add parameters that the data determine after the rough steps, though not at the nominal geometry."""
        unknowns = robots[0].setup.free_unknowns
        kept = sorted(set(robots[0].active) - set(unknowns))
        others = [i for i in robots[0].candidates if i not in set(kept)]
        if (
            self.elimination != "exact"
            or not others
            or len(kept) >= problem.space.most_independent(problem.turning)
        ):
            return
        of_each = information(problem, here.point, unknowns + kept + others, view_of(here))
        for robot, now in zip(robots, of_each, strict=True):
            free = after_unknowns(robot.setup, now)
            extended = [(kept + others)[i] for i in rank_extension(free, len(kept))]
            robot.active = [*robot.active, *extended]
            robot.findings = replace(robot.findings, extended=extended)


@dataclass(eq=False)
class _Robot:
    """One of the robots that are calibrated, with what is found out about it from step to step.

    Attributes:
        measurements: all of its rows.
        setup: its problem and start.
        candidates: indices of the parameters that may be estimated.
        active: those that are.
        findings: on them.
        end: how the rough search ended.
        solved: its calibration.
    """

    measurements: Measurements
    setup: CalibrationSetup
    candidates: list[int] = field(init=False)
    active: list[int] = field(init=False)
    findings: Findings = field(init=False)
    end: SearchEnd = field(init=False)
    solved: SolvedCalibration = field(init=False)


def _finish(robots: list[_Robot], problem: CalibrationProblem, fine: Solution[Tensor]) -> None:
    """Put the calibrations of robots with one problem together.

    Raises:
        IdentificationError: no calibration error explains one of them.
    """
    here, count = fine.linearisation, len(robots)
    refuse_implausible(problem, here, [robot.measurements.source for robot in robots])
    setups = [robot.setup for robot in robots]
    geometries = identified_geometries(setups, here.point.reshape(count, -1))
    of_each = zip(robots, each_robot(here, count) if problem.robots else [here], strict=True)
    for (robot, its), end, geometry in zip(of_each, fine.ends, geometries, strict=True):
        solution = Solution(its, (robot.end.before(end),))
        alone = replace(robot.setup.problem, active=problem.active)
        robot.solved = SolvedCalibration(
            robot.measurements, robot.setup, alone, solution, robot.findings, geometry
        )


def _side_by_side(robots: list[_Robot]) -> tuple[CalibrationProblem, Float64[Tensor, "*robots parameters"]]:
    """The problem of robots with alike data, and its start; of one robot without an axis of robots."""
    setups = [robot.setup for robot in robots]
    if len(setups) == 1:
        return setups[0].problem, setups[0].start
    problem = side_by_side([setup.problem for setup in setups])
    return problem, problem.nominal


def _groups_of(
    robots: list[_Robot], problem: CalibrationProblem, values: Values, patterns: Sequence[object]
) -> Iterator[tuple[list[_Robot], CalibrationProblem, Values]]:
    """Robots with equal patterns, with their problem and values; as they are where all patterns are equal."""
    groups = _groups(patterns)
    if len(groups) == 1:
        yield robots, problem, values
        return
    for group in groups:
        index = torch.tensor(group)
        yield [robots[number] for number in group], problem.of_robots(index), of_robots(values, index)


def _groups(patterns: Sequence[object]) -> list[list[int]]:
    """Numbers of equal patterns, in their order; one that is None is a group of its own."""
    groups: dict[object, list[int]] = {}
    for number, pattern in enumerate(patterns):
        groups.setdefault(number if pattern is None else pattern, []).append(number)
    return list(groups.values())
