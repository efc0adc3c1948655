"""Recipes of a robot that touches jigs: its errors, the touches, and the evaluation."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from jaxtyping import Float64
from pydantic import Field, model_validator
from torch import Tensor

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.problem.parameters import Prior
from pisigma.calibration.geometric.result import CalibrationResult
from pisigma.estimation.loss import SquaredLoss
from pisigma.files.errors import IdentificationError, RecipeError
from pisigma.files.yaml_file import Section, read_yaml
from pisigma.measurement.dataset import Measurements
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.jacobian import singularity_measure
from pisigma.robot.se3 import rotation_from_zyx, transform
from pisigma.simulation.commanded import BranchSection
from pisigma.simulation.noise import SensorNoise
from pisigma.simulation.poses import CubeRandom
from pisigma.simulation.touch_candidates import (
    JigPlacement,
    TouchCandidates,
    TouchCandidatesSection,
    check_names,
)
from pisigma.simulation.touching import simulate_touches
from pisigma.simulation.true_robot import ErrorSource, TrueRobot
from touch_planning import PlanningProblem, build_planning_problem

Triple = tuple[float, float, float]
Free = Literal["paper", "default"]

CLEAR_OF_SINGULARITIES = 0.05
"""Minimum `singularity_measure` of the poses of the workspace."""


JIGS = Path("papers") / "jigs.yaml"
"""File name of the recipe in the folder of the recipes."""


class PointSection(Section):
    """A named point [mm] in the robot's frame and the orientation of the tool there [deg]."""

    name: str = Field(min_length=1)
    xyz_mm: Triple
    rpy_deg: Triple

    @property
    def T_base_tool(self) -> Float64[Tensor, "4 4"]:
        """The pose [m]."""
        return _pose(self.xyz_mm, self.rpy_deg)


class LineSection(Section):
    """A straight line in the robot's frame.

    Attributes:
        name: Name in the table.
        from_mm: Start [mm].
        to_mm: End [mm].
        rpy_deg: Orientation of the tool along the line [deg].
    """

    name: str
    from_mm: Triple
    to_mm: Triple
    rpy_deg: Triple

    @property
    def T_ends(self) -> Float64[Tensor, "2 4 4"]:
        """Poses of the ends [m]."""
        return torch.stack([_pose(self.from_mm, self.rpy_deg), _pose(self.to_mm, self.rpy_deg)])


class PlanningSection(Section):
    """Planning of touches.

    Attributes:
        candidates: Candidates to choose from; the count is per placement.
        touches: Number of touches to choose.
    """

    candidates: TouchCandidatesSection
    touches: int = Field(ge=1)


class JigRecipe(Section):
    """A simulated robot that is calibrated by touching the faces of jigs.

    Attributes:
        kind: "jig_calibration".
        name: Name of the recipe and, by default, of the model.
        description: Purpose of the recipe, for the model's card.
        not_validated: Conclusions that the result does not support, for the card.
        robot: Catalogue name or robot file of the nominal robot.
        errors: All errors of the true robot.
        placements: Placements of the jigs; each is a frame.
        touches: Touches on every jig; seed k uses the stated seed + k.
        noise: Noise of the touches; seed k uses the stated seed + k.
        paper_parameters: Names of the arm's parameters that the paper estimates, in addition to the tool's position
            and every base.
        branch: Branch of the inverse kinematics at the test points and on the lines.
        test_points: Points at which the absolute error is evaluated.
        workspace: Poses over the workspace; those out of reach are ignored.
        lines: Straight lines to move along.
        planning: Planning of touches.
        seeds: Number of seeds for averages and ratios.
        paper: Published figures for comparison.
    """

    kind: Literal["jig_calibration"]
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")]
    description: str
    not_validated: str
    robot: str
    errors: tuple[ErrorSource, ...]
    placements: tuple[JigPlacement, ...] = Field(min_length=1)
    touches: TouchCandidatesSection
    noise: SensorNoise
    paper_parameters: tuple[str, ...] = Field(min_length=1)
    branch: BranchSection
    test_points: tuple[PointSection, ...] = Field(min_length=1)
    workspace: CubeRandom
    lines: tuple[LineSection, ...] = ()
    planning: PlanningSection
    seeds: int = Field(ge=1)
    paper: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _names_differ(self) -> "JigRecipe":
        try:
            check_names(self.placements)
        except RecipeError as problem:
            raise ValueError(str(problem)) from None
        return self

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of the placements."""
        return tuple(placement.name for placement in self.placements)

    def true_robot(self) -> TrueRobot:
        """Return the true robot."""
        return TrueRobot(Robot.load(self.robot), self.errors)

    def draw_touches(self, seed: int) -> TouchCandidates:
        """Return the random touches of one seed."""
        section = self.touches.model_copy(update={"seed": self.touches.seed + seed})
        return section.find(Robot.load(self.robot), self.placements)

    def measure(self, candidates: TouchCandidates, seed: int) -> Measurements:
        """Measure these touches with the true robot, with the noise of one seed.

        Raises:
            UnreachablePoseError: A touch misses its face.
        """
        noise = self.noise.model_copy(update={"seed": self.noise.seed + seed})
        travel = self.touches.travel_mm / 1e3
        return simulate_touches(self.true_robot(), self.placements, candidates, noise, travel)

    def calibrator(self, free: Free, jigs: Sequence[str]) -> GeometricCalibrator:
        """Return the calibrator for some jigs: the paper's parameters by plain least squares, or pisigma's default."""
        robot = Robot.load(self.robot)
        guesses = {name: base.tolist() for name, base in self.believed_bases().items() if name in jigs}
        if free == "default":
            return GeometricCalibrator(robot, base_guesses=guesses)
        return GeometricCalibrator(
            robot,
            free=self.paper_parameters,
            tool="position",
            elimination="none",
            prior=None,
            loss=SquaredLoss(),
            base_guesses=guesses,
        )

    def believed_bases(self) -> dict[str, Float64[np.ndarray, " 6"]]:
        """Assumed base of the robot in the frame of each jig: x, y, z [m], roll, pitch, yaw [rad]."""
        return {placement.name: placement.base.to_si() for placement in self.placements}

    def workspace_joints(self) -> Float64[Tensor, "poses dof"]:
        """Return joint values [rad or m] of the nominal robot at the reachable poses of the workspace."""
        robot = Robot.load(self.robot)
        q, reached = BranchSection(near_deg={}).solve_nominal(robot, self.workspace.transforms())
        return q[reached & (singularity_measure(robot, q) >= CLEAR_OF_SINGULARITIES)]

    def planning_problem(self, candidates: TouchCandidates, prior: Prior | None = None) -> PlanningProblem:
        """Return the planning problem: the information of the candidates about the paper's parameters."""
        return build_planning_problem(
            Robot.load(self.robot),
            candidates,
            torch.stack([placement.T_jig_base for placement in self.placements]),
            self.workspace_joints(),
            self.paper_parameters,
            prior,
            self.noise.sigma() or 1e-6,
        )


def read_jig_recipe(path: str | os.PathLike[str]) -> JigRecipe:
    """Read a recipe of a robot that touches jigs.

    Raises:
        RecipeError: The file cannot be read or is invalid; it names file, line and key.
    """
    return read_yaml(path, JigRecipe, RecipeError)


@dataclass(frozen=True, eq=False)
class JigCalibration:
    """A calibration in the robot's frame.

    Attributes:
        arm: The calibrated robot; its base is the robot's frame.
        bases: x, y, z [m], roll, pitch, yaw [rad] of T_jig_base by jig; for all jigs, or for those touched.
        result: Result of the calibrator; None for the nominal robot.
    """

    arm: Robot
    bases: dict[str, Float64[np.ndarray, " 6"]]
    result: CalibrationResult | None = None


def nominal_calibration(recipe: JigRecipe) -> JigCalibration:
    """Return the nominal robot with the assumed placements of the jigs."""
    return JigCalibration(Robot.load(recipe.robot), recipe.believed_bases())


def calibrate_on(
    recipe: JigRecipe,
    measurements: Measurements,
    frames: Sequence[str],
    free: Free = "paper",
) -> JigCalibration:
    """Calibrate with the touches on some of the jigs.

    Raises:
        IdentificationError: The touches do not determine the parameters, or there are none on these jigs.
    """
    rows = torch.tensor([name in frames for name in measurements.frame]).nonzero()[:, 0]
    if not len(rows):
        raise IdentificationError(
            expected=f"touches on {', '.join(frames)}",
            value=f"touches on {', '.join(recipe.frames)}",
            option="frames",
        )
    result = recipe.calibrator(free, frames).fit(measurements.select(rows))
    return JigCalibration(result.robot.with_geometry(base=np.zeros(6)), dict(result.bases), result)


def _pose(xyz_mm: Triple, rpy_deg: Triple) -> Float64[Tensor, "4 4"]:
    R = rotation_from_zyx(torch.deg2rad(torch.tensor(rpy_deg, dtype=torch.float64)))
    return transform(R, torch.tensor(xyz_mm, dtype=torch.float64) / 1e3)
