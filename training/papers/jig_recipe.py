"""Recipes of a robot that touches jigs: what is wrong, what is touched, and what is looked at afterwards."""

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
from pisigma.robot.kinematics.singularity import singularity_measure
from pisigma.robot.se3 import rotation_from_rpy, transform
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
"""Least `singularity_measure` of the poses of the workspace."""


JIGS = Path("papers") / "jigs.yaml"
"""The recipe in the folder of the recipes."""


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
        name: what the table calls it.
        from_mm: its start [mm].
        to_mm: its end [mm].
        rpy_deg: orientation of the tool on it [deg].
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
    """Which touches are planned.

    Attributes:
        candidates: of which touches are chosen; the count is per placement.
        touches: how many are chosen.
    """

    candidates: TouchCandidatesSection
    touches: int = Field(ge=1)


class JigRecipe(Section):
    """A simulated robot that touches the faces of jigs and is calibrated by that.

    Attributes:
        kind: "jig_calibration".
        name: of the recipe and, by default, of the model.
        description: what it shows, for the model's card.
        not_validated: what a reader must not take from it, for the card.
        robot: catalogue name or robot file of the nominal robot.
        errors: what is wrong with the true robot, completely.
        placements: of the jigs; each is a frame.
        touches: on every jig; seed k takes the stated seed + k.
        noise: of the touches; seed k takes the stated seed + k.
        paper_parameters: names of the arm's parameters that the paper estimates, next to the tool's position and
            every base.
        branch: on which the controller works at the test points and on the lines.
        test_points: where the absolute error is looked at.
        workspace: poses over the workspace; those out of reach are not counted.
        lines: straight lines to drive.
        planning: of touches.
        seeds: how often everything random is drawn anew for averages and ratios.
        paper: published figures to stand beside ours.
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
        """The robot as it really is."""
        return TrueRobot(Robot.load(self.robot), self.errors)

    def draw_touches(self, seed: int) -> TouchCandidates:
        """The touches of one seed, drawn at random."""
        section = self.touches.model_copy(update={"seed": self.touches.seed + seed})
        return section.find(Robot.load(self.robot), self.placements)

    def measure(self, candidates: TouchCandidates, seed: int) -> Measurements:
        """Touch these with the true robot, with the noise of one seed.

        Raises:
            UnreachablePoseError: a touch misses its face.
        """
        noise = self.noise.model_copy(update={"seed": self.noise.seed + seed})
        travel = self.touches.travel_mm / 1e3
        return simulate_touches(self.true_robot(), self.placements, candidates, noise, travel)

    def calibrator(self, free: Free, jigs: Sequence[str]) -> GeometricCalibrator:
        """The calibrator for some jigs: the paper's parameters by plain least squares, or pisigma's default."""
        robot = Robot.load(self.robot)
        frames = {name: base.tolist() for name, base in self.believed_bases().items() if name in jigs}
        if free == "default":
            return GeometricCalibrator(robot, frames=frames)
        return GeometricCalibrator(
            robot,
            free=self.paper_parameters,
            tool="position",
            elimination="none",
            prior=None,
            loss=SquaredLoss(),
            frames=frames,
        )

    def believed_bases(self) -> dict[str, Float64[np.ndarray, " 6"]]:
        """Where the operator believes that the robot stands, by jig: x, y, z [m], roll, pitch, yaw [rad]."""
        return {placement.name: placement.base.to_si() for placement in self.placements}

    def workspace_joints(self) -> Float64[Tensor, "poses dof"]:
        """Joint values [rad or m] of the nominal robot at those poses of the workspace that it reaches."""
        robot = Robot.load(self.robot)
        q, reached = BranchSection(near_deg={}).find(robot, self.workspace.transforms())
        return q[reached & (singularity_measure(robot, q) >= CLEAR_OF_SINGULARITIES)]

    def planning_problem(self, candidates: TouchCandidates, prior: Prior | None = None) -> PlanningProblem:
        """What the candidates tell of the paper's parameters."""
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
        RecipeError: the file cannot be read or does not fit; the message names file, line and key.
    """
    return read_yaml(path, JigRecipe, RecipeError)


@dataclass(frozen=True, eq=False)
class JigCalibration:
    """A calibration in the robot's own frame.

    Attributes:
        arm: the calibrated robot; its base is the robot's frame.
        bases: by jig x, y, z [m], roll, pitch, yaw [rad] of T_jig_base; of all jigs, or of those touched.
        result: what the calibrator gave; None for the nominal robot.
    """

    arm: Robot
    bases: dict[str, Float64[np.ndarray, " 6"]]
    result: CalibrationResult | None = None


def nominal_calibration(recipe: JigRecipe) -> JigCalibration:
    """The robot as drawn and the jigs where the operator believes them."""
    return JigCalibration(Robot.load(recipe.robot), recipe.believed_bases())


def calibrate_on(
    recipe: JigRecipe,
    measurements: Measurements,
    frames: Sequence[str],
    free: Free = "paper",
) -> JigCalibration:
    """Calibrate with the touches on some of the jigs.

    Raises:
        IdentificationError: the touches do not determine what is asked for, or there are none on these jigs.
    """
    rows = torch.tensor([name in frames for name in measurements.frame]).nonzero()[:, 0]
    if not len(rows):
        raise IdentificationError(
            f"touches on {', '.join(frames)} were wanted, but there are none; the jigs are "
            f"{', '.join(recipe.frames)}."
        )
    result = recipe.calibrator(free, frames).fit(measurements.select(rows))
    return JigCalibration(result.robot.with_geometry(base=np.zeros(6)), dict(result.bases), result)


def _pose(xyz_mm: Triple, rpy_deg: Triple) -> Float64[Tensor, "4 4"]:
    R = rotation_from_rpy(torch.deg2rad(torch.tensor(rpy_deg, dtype=torch.float64)))
    return transform(R, torch.tensor(xyz_mm, dtype=torch.float64) / 1e3)
