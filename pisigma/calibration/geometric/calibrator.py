"""Geometric calibration by least squares."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.geometric.identifiability.pairwise import find_pairwise_redundancy
from pisigma.calibration.geometric.identifiability.plausibility import refuse_implausible
from pisigma.calibration.geometric.identifiability.redundancy import (
    RankFindings,
    Redundancy,
    additional_columns,
    find_redundancy,
)
from pisigma.calibration.geometric.identifiability.sufficiency import (
    candidates_with_fixed_scale,
    count_estimated_unknowns,
    floating_bases,
    refuse_too_few,
    without_sensor_unknowns,
)
from pisigma.calibration.geometric.initial_guess.initial_guess import randomly_chosen_rows
from pisigma.calibration.geometric.problem.information import information
from pisigma.calibration.geometric.problem.joint_repeatability import joint_scatter_factor
from pisigma.calibration.geometric.problem.least_squares import SHORTEST_STEP, Solution, levenberg_marquardt
from pisigma.calibration.geometric.problem.noise import contributions_and_noise_of
from pisigma.calibration.geometric.problem.parameters import ParameterSpace, Prior
from pisigma.calibration.geometric.problem.problem import CalibrationProblem
from pisigma.calibration.geometric.problem.setup import (
    CalibrationSetup,
    SetupOptions,
    build_setup,
    identified_geometry,
)
from pisigma.calibration.geometric.result import CalibrationResult, SolvedCalibration
from pisigma.estimation.loss import AbstractLoss, HampelLoss
from pisigma.files.errors import IdentificationError, check_choice
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.socket import PairOfSockets
from pisigma.robot.description import Robot
from pisigma.robot.robot_class import CLASSES, RobotClass
from pisigma.robot.row import FRAME_COLUMNS

_ROUGH_ROWS = 4_096
"""Largest number of rows used for the first steps."""
_WEIGHTINGS = 3
"""Number of times that images are weighted again by the scatter of the joints."""
_ROUGH_STEPS = 3
"""Number of steps without the prior; they determine the noise relative to which the prior is weighted."""


@dataclass(frozen=True)
class GeometricCalibrator:
    """Calibrator that identifies DH and Hayati parameters, base and tool from measurements by least squares.

    No initial guess is needed: base and tool start from a closed-form solution, the parameters of the arm at their
    nominal values.

    Attributes:
        robot: the nominal robot.
        free: "identifiable" (all that the data determine), "joint_offsets" (theta of revolute and d of prismatic
            joints), or names of parameters, such as "a_2". Base and tool are added; see below.
        base: "free", or "fixed" to the base of the robot (only parameters of the base that are named in `free` are
            then estimated).
        tool: "free" or "fixed", as for the base; "position" frees x, y and z of the tool only.
        elimination: how redundant parameters are removed: "exact" (rank and pivoted QR), "pairwise" (Pearson
            correlation, as in Park et al. 2022), or "none". The predicted poses do not depend on it.
        prior: standard deviations of the errors of the parameters, or None. With a prior, parameters that the data
            do not determine keep their nominal values.
        prior_scaling: "estimated" (one factor on the prior is estimated for each of joint offsets, lengths, lengths
            that are nominally 0, and angles between axes), "widened" (one factor >= 1 for lengths and one for
            angles), or "stated" (the prior is used unchanged).
        base_guesses: approximate base in frames with touches: x, y, z [m], roll, pitch, yaw [rad], such as the planned
            placement of a jig. It is needed only if the touches do not determine the base.
        socket_distances: distances between two sockets [m], which determine the scale:
            `{("plate/0", "plate/1"): 0.05}`.
        socket_sigma: standard deviation of the distances between sockets [m].
        loss: `HampelLoss()` reduces the weight of outliers, down to 0; `SquaredLoss()` does not.
        maximum_iterations: maximum number of steps.
        robot_class: "industrial", "cobot", "hobby" or "servo", which limits the errors; None to derive it from the
            manufacturer and the data.
    """

    robot: Robot
    free: str | Sequence[str] = "identifiable"
    base: str = "free"
    tool: str = "free"
    elimination: str = "exact"
    prior: Prior | None = field(default_factory=Prior)
    loss: AbstractLoss = field(default_factory=HampelLoss)
    maximum_iterations: int = 100
    prior_scaling: str = "estimated"
    base_guesses: Mapping[str, Sequence[float]] = field(default_factory=dict)
    socket_distances: Mapping[PairOfSockets, float] = field(default_factory=dict)
    socket_sigma: float = 1e-5
    robot_class: str | None = None

    def __post_init__(self) -> None:
        """Refuse invalid options."""
        for name, choices in (
            ("base", ("free", "fixed")),
            ("tool", ("free", "position", "fixed")),
            ("elimination", ("exact", "pairwise", "none")),
            ("prior_scaling", ("stated", "widened", "estimated")),
            ("robot_class", (None, *CLASSES)),
        ):
            if getattr(self, name) not in choices:
                check_choice(IdentificationError, name, getattr(self, name), [one for one in choices if one])
        if isinstance(self.free, str) and self.free not in ("identifiable", "joint_offsets"):
            raise IdentificationError(
                option="free",
                expected="'identifiable', 'joint_offsets' or a list of parameter names",
                value=self.free,
            )
        if not isinstance(self.free, str) and "" in self.free:
            raise IdentificationError(
                option="free",
                expected="names of parameters such as a_2, separated by single commas",
                value=tuple(self.free),
            )
        for name, base in self.base_guesses.items():
            if len(base) != 6 or not all(math.isfinite(value) for value in base):
                raise IdentificationError(
                    option="base_guesses",
                    expected=f"six finite numbers for '{name}': x, y, z [m], roll, pitch, yaw [rad]",
                    value=tuple(base),
                )
        if not 0 < self.socket_sigma < math.inf:
            raise IdentificationError(
                option="socket_sigma", expected="a standard deviation > 0 m", value=self.socket_sigma
            )

    @torch.inference_mode()
    def fit(self, measurements: Measurements) -> CalibrationResult:
        """Calibrate and return the result; see `solve` for exceptions."""
        return self.solve(measurements).result()

    def solve(self, measurements: Measurements) -> SolvedCalibration:
        """Calibrate, and return the problem with its solution.

        Raises:
            IdentificationError: the measurements do not determine the parameters, or are so far from the best fit that
                they cannot belong to this robot; the message says what to measure or to correct.
            PoseError: the joint values do not fit the robot.
        """
        setup = self.build(measurements)
        findings, candidates, active = self._choose(setup, measurements.source)
        rough, findings, active = self._solve_roughly(setup, findings, candidates, active)
        problem = setup.problem.with_active(active)
        start = rough.linearisation
        if (
            findings.added_parameters
            or len(contributions_and_noise_of(start).contributions[0].residual_length) < problem.rows
        ):
            start = problem.linearise(start.point, start)
        else:
            start = problem.combine_contributions(start.point, contributions_and_noise_of(start))
        left = self.maximum_iterations - rough.iterations
        fine = levenberg_marquardt(problem, start, left, step_tolerance=SHORTEST_STEP)
        if setup.joint_repeatability:
            setup, problem, fine = self._weight_images(setup, problem, fine)
        refuse_implausible(problem, fine.linearisation, measurements.source)
        geometry = identified_geometry(setup, fine.linearisation.point)
        return SolvedCalibration(measurements, setup, problem, rough.continued_by(fine), findings, geometry)

    def _weight_images(
        self, setup: CalibrationSetup, problem: CalibrationProblem, found: Solution[Tensor]
    ) -> tuple[CalibrationSetup, CalibrationProblem, Solution[Tensor]]:
        """Continue a search with images weighted by the joints of the arm that it found, and by their scatter."""
        corners = setup.corner_sensor(setup.measurements)
        if corners is None:
            return setup, problem, found
        for number in range(_WEIGHTINGS):
            factor = 1.0
            if number:  # the first weights were those of the nominal arm, whose axes are elsewhere
                refined = problem.with_refined_noise(found.linearisation)
                factor = joint_scatter_factor(problem, refined, corners)
            point = found.linearisation.point
            setup = replace(setup, joint_repeatability=factor * setup.joint_repeatability).weighted_at(point)
            problem = setup.problem.with_active(problem.active.tolist())
            left = max(self.maximum_iterations - found.iterations, 1)
            again = levenberg_marquardt(problem, point, left, step_tolerance=SHORTEST_STEP)
            found = found.continued_by(again)
        return setup, problem, found

    def build(self, measurements: Measurements) -> CalibrationSetup:
        """Build the problem and its start values, without solving the problem.

        Raises:
            IdentificationError: there are no usable measurements, or too few for base and tool.
            PoseError: the joint values do not fit the robot.
        """
        options = SetupOptions(
            free_base=self._finds("base"),
            free_tool=self._finds("tool"),
            free_rotation=self.tool == "free",
            base_guesses={name: tuple(base) for name, base in self.base_guesses.items()},
            socket_distances=self.socket_distances,
            socket_sigma=self.socket_sigma,
            prior_scaling=self.prior_scaling,  # type: ignore[arg-type]
            joint_repeatability=self.class_of_robot.joint_repeatability,
        )
        return build_setup(self.robot, measurements, options, self.prior, self.loss)

    @property
    def class_of_robot(self) -> RobotClass:
        """The stated class of the robot, or else its manufacturer's class."""
        return RobotClass.from_robot(self.robot) if self.robot_class is None else CLASSES[self.robot_class]

    def _finds(self, group: str) -> bool:
        """Return whether bases or tools need start values, because they are free or named (all six of a base)."""
        if getattr(self, group) != "fixed":
            return True
        if isinstance(self.free, str):
            return False
        columns = FRAME_COLUMNS if group == "base" else FRAME_COLUMNS[:3]
        return {f"{group}_{column}" for column in columns} <= set(self.free)

    def candidates(self, space: ParameterSpace) -> list[int]:
        """Return the indices of the parameters that may be estimated.

        Raises:
            IdentificationError: `free` names a parameter that does not exist.
        """
        chosen = {i for i, p in enumerate(space.parameters) if p.group == "base" and self.base == "free"}
        tools = list(space.indices_of("tool")) if self.tool != "fixed" else []
        chosen |= {i for k, i in enumerate(tools) if self.tool == "free" or k % 6 < 3}
        if self.free == "identifiable":
            chosen |= set(range(space.arm_parameter_count))
        elif self.free == "joint_offsets":
            for row in self.robot.joint_rows:
                chosen.add(5 * row + (1 if self.robot.rows[row].type == "prismatic" else 0))
        else:
            chosen |= {index for name in self.free for index in space.indices(name)}
        return sorted(chosen)

    def _choose(self, setup: CalibrationSetup, source: str) -> tuple[RankFindings, list[int], list[int]]:
        """Analyse the rank, and choose the parameters that are estimated first.

        Returns:
            Result of the rank analysis, indices of the parameters that may be estimated, and indices of the chosen
            parameters.

        Raises:
            IdentificationError: the measurements do not determine the parameters.
        """
        problem, unknowns = setup.problem, setup.free_unknowns
        candidates, explicit = self.candidates(problem.space), not isinstance(self.free, str)
        every = information(problem, setup.start, unknowns + candidates)
        candidates, at_start = candidates_with_fixed_scale(setup, candidates, every)
        nominal_values = setup.start.cpu().numpy()[candidates]
        redundancy = find_redundancy(at_start, nominal_values)
        refuse_too_few(problem, redundancy, explicit, len(unknowns), source)
        floating = set(floating_bases(setup))
        chosen = self._chosen(problem.space, nominal_values, redundancy)
        active = [*(index for index in chosen if index not in floating), *unknowns]
        estimated_count = count_estimated_unknowns(redundancy, explicit, len(unknowns))
        return RankFindings(nominal_values, redundancy, [], estimated_count), candidates, active

    def _chosen(
        self,
        space: ParameterSpace,
        nominal_values: Float64[np.ndarray, " candidates"],
        redundancy: Redundancy,
    ) -> list[int]:
        """Return the indices of the parameters that are estimated first."""
        if self.elimination == "exact":
            return [space.index(name) for name in redundancy.kept]
        names = redundancy.names
        if self.elimination == "pairwise":
            names = find_pairwise_redundancy(redundancy.information, nominal_values).kept
        return [space.index(name) for name in names]

    def _solve_roughly(
        self, setup: CalibrationSetup, findings: RankFindings, candidates: list[int], active: list[int]
    ) -> tuple[Solution[Tensor], RankFindings, list[int]]:
        """Perform some steps without the prior, and add the parameters that the data then determine.

        The steps determine the noise relative to which the prior is weighted; a few thousand rows are sufficient for
        them.

        Returns:
            The solution after these steps, the findings with the added parameters, and indices of all free parameters.
        """
        problem = setup.problem.with_active(active)
        if problem.rows > _ROUGH_ROWS:
            problem = problem.select(randomly_chosen_rows(problem.rows, _ROUGH_ROWS).to(problem.q.device))
        steps = min(_ROUGH_STEPS, self.maximum_iterations)
        rough = levenberg_marquardt(problem.without_prior(), setup.start, steps, step_tolerance=1.0)
        unknowns, here = setup.free_unknowns, rough.linearisation
        kept = sorted(set(active) - set(unknowns))
        others = [i for i in candidates if i not in set(kept)]
        most = problem.space.max_identifiable(problem.needs_rotation)
        if self.elimination != "exact" or not others or len(kept) >= most:
            return rough, findings, active
        now = information(problem, here.point, unknowns + kept + others, contributions_and_noise_of(here))
        columns = additional_columns(without_sensor_unknowns(setup, now), len(kept))
        extended = [(kept + others)[i] for i in columns]
        return rough, replace(findings, added_parameters=extended), [*active, *extended]
