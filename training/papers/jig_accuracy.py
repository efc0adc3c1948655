"""Position errors of a robot that was calibrated on jigs, at test points and over the workspace."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float64
from torch import Tensor

from jig_recipe import JigCalibration, JigRecipe
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import transform_from_xyz_zyx
from pisigma.simulation.true_robot import TrueRobot
from straight_lines import Controller

DEFINITIONS = (
    "absolute error, robot frame: the controller solves the inverse kinematics of a test point with its "
    "parameters; the error is the resulting position of the true tool minus the test point, in the robot's "
    "frame",
    "absolute error, seen from a jig: the same tool position measured in the true frame of the jig, minus "
    "the position of the test point in it according to the parameters; this includes the error of the jig's"
    " base",
    "RMS: over the x, y and z errors of all test points; deviation: the mean over x, y and z of the errors'"
    " standard deviation over the test points (both reproduce the paper's figures from its Tables 3 to 7)",
    "Move-L: both ends are taught with the true robot, so they are reached exactly; the deviation is the "
    "position of the true tool minus that on the straight line between them, for each axis the largest "
    "along the line",
    "I-Move: only the start is taught, direction and distance are commanded; dL is the true distance "
    "between the ends minus the commanded one",
    "nominal, one jig, both: the paper's parameters by plain least squares; default: everything "
    "identifiable from the touches on both jigs, with pisigma's prior; planned and random: the paper's "
    "parameters from touches chosen from many candidates, and from the same number drawn at random from "
    "them",
    "workspace: distance between the true tool and its position according to the parameters at the same "
    "joint values, over poses of the workspace, in the robot's frame",
)
"""Definitions of the figures, as sentences."""


@dataclass(frozen=True, eq=False)
class Bench:
    """The true robot and the poses at which it is evaluated; the same for all calibrations of a recipe.

    Attributes:
        recipe: Recipe of the simulation.
        true_robot: The simulated true robot.
        workspace: joint values over the workspace [rad or m].
    """

    recipe: JigRecipe
    true_robot: TrueRobot
    workspace: Float64[Tensor, "poses dof"]

    @staticmethod
    def from_recipe(recipe: JigRecipe) -> "Bench":
        """Return the bench of a recipe.

        Raises:
            RecipeError: the recipe names a robot, joint or branch that does not exist.
        """
        return Bench(recipe, recipe.true_robot(), recipe.workspace_joints())

    @cached_property
    def true_positions(self) -> Float64[Tensor, "poses 3"]:
        """Positions of the true tool over the workspace [m]."""
        return self.true_robot.forward(self.workspace)[:, :3, 3]

    @cached_property
    def T_test_points(self) -> Float64[Tensor, "points 4 4"]:
        """Poses of the test points [m]."""
        return torch.stack([point.T_base_tool for point in self.recipe.test_points])

    def controller(self, arm: Robot) -> Controller:
        """Return a controller with these parameters."""
        return Controller(self.true_robot.nominal, arm, self.recipe.branch)


@dataclass(frozen=True, eq=False)
class Accuracy:
    """Errors of one calibration; see `DEFINITIONS`.

    Attributes:
        points: Errors at the test points, in the robot's frame [m].
        seen_from: The same in the frame of each jig whose base was calibrated [m].
        workspace: Distances over the workspace [m].
    """

    points: Float64[Tensor, "points 3"]
    seen_from: dict[str, Float64[Tensor, "points 3"]]
    workspace: Float64[Tensor, " poses"]


def measure_accuracy(bench: Bench, calibration: JigCalibration) -> Accuracy:
    """Move to the test points with the parameters of a calibration, and compare positions there and over the workspace.

    Raises:
        UnreachablePoseError: a test point cannot be reached.
    """
    wanted = bench.T_test_points[:, :3, 3]
    q = bench.controller(calibration.arm).joints(bench.T_test_points)
    reached = bench.true_robot.forward(q)[:, :3, 3]
    seen_from = {}
    for placement in bench.recipe.placements:
        if placement.name in calibration.bases:
            believed = transform_from_xyz_zyx(torch.from_numpy(calibration.bases[placement.name]))
            seen_from[placement.name] = _moved(placement.true_T_jig_base, reached) - _moved(believed, wanted)
    predicted = forward_kinematics(calibration.arm, bench.workspace)[:, :3, 3]
    distance = (bench.true_positions - predicted).norm(dim=-1)
    return Accuracy(reached - wanted, seen_from, distance)


def rms(errors: Float64[Tensor, "points 3"]) -> float:
    """Return the root mean square over all coordinates, as in the paper [m]."""
    return float(errors.square().mean().sqrt())


def deviation(errors: Float64[Tensor, "points 3"]) -> float:
    """Return the mean over the axes of the standard deviation over the points, as in the paper [m]."""
    return float(errors.std(0, correction=0).mean())


def accuracy_figures(accuracy: Accuracy) -> dict[str, object]:
    """Return the figures in millimetres."""
    return {
        "robot_frame": _figures(accuracy.points),
        "seen_from": {name: _figures(errors) for name, errors in accuracy.seen_from.items()},
        "workspace": {
            "median_mm": float(accuracy.workspace.median()) * 1e3,
            "rms_mm": float(accuracy.workspace.square().mean().sqrt()) * 1e3,
            "p95_mm": float(accuracy.workspace.quantile(0.95)) * 1e3,
            "max_mm": float(accuracy.workspace.max()) * 1e3,
        },
    }


def _figures(errors: Float64[Tensor, "points 3"]) -> dict[str, object]:
    return {
        "rms_mm": rms(errors) * 1e3,
        "deviation_mm": deviation(errors) * 1e3,
        "mean_mm": float(errors.norm(dim=-1).mean()) * 1e3,
        "points_mm": (errors * 1e3).tolist(),
    }


def _moved(T: Float64[Tensor, "4 4"], points: Float64[Tensor, "points 3"]) -> Float64[Tensor, "points 3"]:
    return points @ T[:3, :3].mT + T[:3, 3]
