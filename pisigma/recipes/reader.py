"""Reading a recipe of whatever kind."""

import os
from collections.abc import Callable
from functools import partial
from typing import Literal

from pydantic import ConfigDict

from pisigma.errors import RecipeError
from pisigma.recipes.geometric_recipe import GeometricRecipe
from pisigma.recipes.hybrid_recipe import HybridRecipe, hybrid_checks
from pisigma.recipes.recipe import Recipe, read_recipe
from pisigma.recipes.recipe_checks import check_fit, geometric_checks
from pisigma.yaml_file import Section, read_yaml

AnyRecipe = Recipe | GeometricRecipe | HybridRecipe


class _KindOnly(Section):
    model_config = ConfigDict(extra="ignore")
    kind: Literal["inverse_calibration", "geometric_calibration", "hybrid_calibration"] = (
        "inverse_calibration"
    )


def read_any_recipe(path: str | os.PathLike[str]) -> AnyRecipe:
    """Read a recipe of the kind that it states, and check it against its robot.

    Raises:
        RecipeError: the file cannot be read or does not fit; the message names file, line and key.
        RobotError: its robot cannot be used; the message names file, line and key too.
    """
    readers: dict[str, Callable[[str | os.PathLike[str]], AnyRecipe]] = {
        "inverse_calibration": read_recipe,
        "geometric_calibration": read_geometric_recipe,
        "hybrid_calibration": read_hybrid_recipe,
    }
    return readers[read_yaml(path, _KindOnly, RecipeError).kind](path)


def read_geometric_recipe(path: str | os.PathLike[str]) -> GeometricRecipe:
    """Read a recipe of the geometric calibrator and check it against its robot.

    Raises:
        RecipeError: the file cannot be read or does not fit; the message names file, line and key.
        RobotError: its robot cannot be used; the message names file, line and key too.
    """
    recipe = read_yaml(path, GeometricRecipe, RecipeError)
    check_fit(path, recipe.robot, partial(geometric_checks, recipe))
    return recipe


def read_hybrid_recipe(path: str | os.PathLike[str]) -> HybridRecipe:
    """Read a recipe of the hybrid calibrator and check it against its robot.

    Raises:
        RecipeError: the file cannot be read or does not fit; the message names file, line and key.
        RobotError: its robot cannot be used; the message names file, line and key too.
    """
    recipe = read_yaml(path, HybridRecipe, RecipeError)
    check_fit(path, recipe.robot, partial(hybrid_checks, recipe))
    return recipe
