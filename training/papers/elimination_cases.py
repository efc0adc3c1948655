"""The same calibration with different parameters eliminated, and the correlations that show which can be eliminated."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pisigma.calibration.geometric.identifiability.pairwise import CorrelationTable
from pisigma.calibration.geometric.problem.parameters import ParameterSpace
from pisigma.calibration.geometric.result import CalibrationResult
from pisigma.files.errors import RecipeError, choice_remedy
from pisigma.measurement.dataset import Measurements
from pisigma.robot.description import Robot
from pisigma.simulation.true_robot import TrueRobot
from pisigma.validation.held_out.calibration_validation import pose_errors_of
from pisigma.workflow.recipes.recipe import GeometricRecipe

_DECIMALS = 6


def report_eliminations(
    recipe: GeometricRecipe,
    cases: Sequence[Sequence[str]],
    result: CalibrationResult,
    rows: Measurements,
    held_out: Measurements,
) -> dict[str, Any]:
    """Calibrate without the parameters of each case, and with all parameters (Park et al. 2022, Tables 7 to 10).

    Args:
        recipe: Recipe of the calibration.
        cases: Parameters of the arm to eliminate; a last case without elimination is added.
        result: Calibration of the recipe, for its redundant sets.
        rows: Measurements to calibrate with.
        held_out: Measurements for the evaluation.

    Returns:
        ``{"elimination_cases": [...], "true_values": {...}}``: per case the eliminated parameters, the number of
        estimated parameters, the RMS error after every iteration, that of held-out rows, and the values of all members
        of redundant sets [mm, deg].

    Raises:
        RecipeError: A case names something other than a parameter of the arm.
    """
    names = [name.removeprefix("-") for members in result.pairwise_redundancy.sets for name in members]
    space = ParameterSpace(result.robot, (recipe.measurements.frame,), ("",))
    compared = []
    for removed in (*cases, ()):
        found = calibrate_without(recipe, removed, rows)
        errors = pose_errors_of(found, held_out).figures.figures_by_name
        compared.append(
            {
                "removed": list(removed),
                "parameters": len(found.free_parameters),
                "status": found.status.value,
                "rmse_mm": [value * 1e3 for value in found.rms_path],
                "held_out_rms_mm": errors["rms_mm"],
                "values": _values(found.robot, names, space),
            }
        )
    truth = TrueRobot(Robot.load(recipe.robot), recipe.errors).true_geometry
    return {"elimination_cases": compared, "true_values": _values(truth, names, space)}


def calibrate_without(
    recipe: GeometricRecipe, removed: Sequence[str], rows: Measurements
) -> CalibrationResult:
    """Calibrate all parameters of the arm except those removed, even if the others are redundant.

    Raises:
        RecipeError: A removed name is not a parameter of the arm.
        IdentificationError: The rows do not determine the parameters.
    """
    robot = Robot.load(recipe.robot)
    space = ParameterSpace(robot, (recipe.measurements.frame,), ("",))
    arm = [parameter.name for parameter in space.parameters[: space.arm_parameter_count]]
    for name in removed:
        if name not in arm:
            raise RecipeError(
                f"there is no parameter '{name}' of the arm to eliminate; {choice_remedy(name, arm)}",
                option="cases",
                value=name,
            )
    calibrator = recipe.calibration.calibrator(robot)
    free = tuple(name for name in arm if name not in removed)
    return replace(calibrator, free=free, elimination="none").fit(rows)


def report_correlations(result: CalibrationResult) -> dict[str, Any]:
    """Return Pearson correlations of lengths and of angles (Park et al. 2022, Tables 3 to 6); None if undefined."""
    pairwise = result.pairwise_redundancy
    return {"correlations": {"lengths": _table(pairwise.lengths), "angles": _table(pairwise.angles)}}


def _table(table: CorrelationTable) -> dict[str, Any]:
    values = [
        [None if np.isnan(value) else round(float(value), _DECIMALS) for value in row] for row in table.values
    ]
    return {"names": list(table.names), "values": values}


def _values(robot: Robot, names: list[str], space: ParameterSpace) -> dict[str, float]:
    """Return parameters of the arm by name [mm, deg]."""
    values = robot.dh.reshape(-1)
    found = {}
    for name in names:
        place = space.index(name)
        length = space.parameters[place].unit == "m"
        found[name] = float(values[place]) * 1e3 if length else math.degrees(float(values[place]))
    return found
