"""The geometric calibrator."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64
from torch import Tensor

from pisigma.errors import IdentificationError
from pisigma.identification.extension import told_besides
from pisigma.identification.information import Information, information
from pisigma.identification.least_squares import Solution, levenberg_marquardt
from pisigma.identification.loss import AbstractLoss, HampelLoss
from pisigma.identification.pairwise import find_pairwise_redundancy
from pisigma.identification.parameters import ParameterSpace, Prior
from pisigma.identification.problem import CalibrationProblem, view_of
from pisigma.identification.redundancy import Redundancy, find_redundancy
from pisigma.identification.result import CalibrationResult
from pisigma.identification.result_assembly import Findings, assemble_result
from pisigma.identification.setup import CalibrationSetup, build_setup, chosen_rows
from pisigma.identification.sufficiency import check_sufficiency
from pisigma.measurement.dataset import Measurements
from pisigma.robot.description import Robot

ROUGH_ROWS = 4_096
"""Rows that the first steps and the start are worked out from."""
ROUGH_STEPS = 3
"""Steps without the prior, which show the noise before the prior is weighed against it."""


@dataclass(frozen=True)
class GeometricCalibrator:
    """Identifies DH + Hayati parameters, base and tool from measured poses or positions, by least squares.

    No initial guess is asked for: base and tool start in closed form, the arm at its nominal values.

    Attributes:
        robot: the nominal robot.
        free: "identifiable": all that the data can tell; "joint_offsets": theta of turning and d of sliding
            joints; or names of parameters, such as "a_2". Base and tool come on top, see below.
        base: "free", or "fixed" to the robot's own (then only parameters that `free` names are estimated).
        tool: the same for the tool.
        elimination: how redundant parameters are left out: "exact" (rank and pivoted QR), "pairwise" (the
            paper's Pearson correlation), or "none". The predicted poses do not depend on it.
        prior: standard deviations of the parameters' errors, or None. With it, what the data cannot see
            stays at its nominal value.
        loss: `HampelLoss()` gives rows that are far off less weight or none; `SquaredLoss()` does not.
        maximum_iterations: steps tried at most.
    """

    robot: Robot
    free: str | Sequence[str] = "identifiable"
    base: str = "free"
    tool: str = "free"
    elimination: str = "exact"
    prior: Prior | None = field(default_factory=Prior)
    loss: AbstractLoss = field(default_factory=HampelLoss)
    maximum_iterations: int = 50

    def __post_init__(self) -> None:
        """Refuse options that do not exist."""
        for name, choices in (
            ("base", ("free", "fixed")),
            ("tool", ("free", "fixed")),
            ("elimination", ("exact", "pairwise", "none")),
        ):
            if getattr(self, name) not in choices:
                raise IdentificationError(
                    f"{name}='{getattr(self, name)}' is no choice; valid: {', '.join(choices)}."
                )
        if isinstance(self.free, str) and self.free not in ("identifiable", "joint_offsets"):
            raise IdentificationError(
                f"free='{self.free}' is no choice; valid: identifiable, joint_offsets, or a list of "
                "parameter names."
            )

    def fit(self, measurements: Measurements) -> CalibrationResult:
        """Calibrate.

        Raises:
            IdentificationError: the measurements do not determine what is asked for; the message says what to
                measure or what to fix.
            PoseError: the joint values do not fit the robot.
        """
        setup = self.build(measurements)
        candidates = self.candidates(setup.problem.space)
        seen = information(setup.problem, setup.start, candidates)
        sizes = setup.start.cpu().numpy()[candidates]
        redundancy = find_redundancy(seen, sizes)
        warnings = check_sufficiency(
            self.robot, setup.problem, redundancy, not isinstance(self.free, str), measurements.source
        )
        active = self._chosen(setup.problem.space, seen, sizes, redundancy)
        problem = setup.problem.with_active(active)
        solution, problem, extended = self._solved(problem, setup.start, candidates)
        findings = Findings(seen, sizes, redundancy, extended, warnings)
        return assemble_result(measurements, setup, problem, solution, findings)

    def build(self, measurements: Measurements) -> CalibrationSetup:
        """The problem and its start, without solving it.

        Raises:
            IdentificationError: nothing usable was measured, or too little for base and tool.
            PoseError: the joint values do not fit the robot.
        """
        return build_setup(
            self.robot, measurements, self.base == "free", self.tool == "free", self.prior, self.loss
        )

    def candidates(self, space: ParameterSpace) -> list[int]:
        """Indices of the parameters that may be estimated.

        Raises:
            IdentificationError: `free` names a parameter that does not exist.
        """
        found = {i for i, p in enumerate(space.parameters) if p.group == "base" and self.base == "free"}
        found |= {i for i, p in enumerate(space.parameters) if p.group == "tool" and self.tool == "free"}
        if self.free == "identifiable":
            found |= set(range(space.arm_size))
        elif self.free == "joint_offsets":
            for row in self.robot.joint_rows:
                found.add(5 * row + (1 if self.robot.rows[row].type == "prismatic" else 0))
        else:
            found |= {space.index(name) for name in self.free}
        return sorted(found)

    def _chosen(
        self,
        space: ParameterSpace,
        seen: Information,
        sizes: Float64[np.ndarray, " candidates"],
        redundancy: Redundancy,
    ) -> list[int]:
        """Indices of the parameters to start with."""
        if self.elimination == "exact":
            return [space.index(name) for name in redundancy.kept]
        names = seen.names
        if self.elimination == "pairwise":
            names = find_pairwise_redundancy(seen, sizes).kept
        return [space.index(name) for name in names]

    def _solved(
        self, problem: CalibrationProblem, start: Float64[Tensor, " parameters"], candidates: list[int]
    ) -> tuple[Solution[Tensor], CalibrationProblem, list[int]]:
        """Solve roughly without the prior, add what the data tell there, then solve with the prior.

        The rough steps show the noise that the prior is weighed against; a few thousand rows are enough for
        them.
        """
        few = problem
        if problem.q.shape[0] > ROUGH_ROWS:
            few = problem.select(chosen_rows(problem.q.shape[0], ROUGH_ROWS).to(problem.q.device))
        rough = levenberg_marquardt(few.without_prior(), start, min(ROUGH_STEPS, self.maximum_iterations))
        here = rough.linearisation
        extended: list[int] = []
        kept = [candidates.index(i) for i in problem.active.tolist()]
        if self.elimination == "exact" and len(kept) < len(candidates):
            now = information(few, here.point, candidates, view_of(here))
            extended = [candidates[i] for i in told_besides(now, kept)]
            problem = problem.with_active(problem.active.tolist() + extended)
        if extended or few.q is not problem.q:
            here = problem.linearise(here.point, here)
        else:
            here = problem.combined(here.point, view_of(here))
        fine = levenberg_marquardt(problem, here, self.maximum_iterations - rough.iterations)
        iterations = rough.iterations + fine.iterations
        path = rough.path + fine.path[1:]
        return Solution(fine.linearisation, iterations, fine.status, path), problem, extended
