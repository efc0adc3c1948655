"""Running a recipe: its model folder, and the result that the page is made of."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from elimination_cases import report_correlations, report_eliminations
from jig_recipe import JIGS
from jig_run import run_jigs_recipe
from pisigma.errors import RecipeError
from pisigma.export.output_file import write_whole
from pisigma.recipes.geometric_recipe import GeometricRecipe
from pisigma.recipes.recipe import Recipe
from pisigma.recipes.recipe_data import load_measurements, simulate_held_out, simulate_training
from pisigma.recipes.recipe_kinds import read_any_recipe
from pisigma.workflow.run import train_recipe
from published import read_published
from stored_results import RESULTS, Result, result_text
from training_course import report_course

_COMMAND = "from pisigma.cli.main import run; run()"


def run_recipe(folder: Path, name: str, data: Path | None, out: Path | None) -> None:
    """Run a recipe, write its model folder and store its result, one value a line.

    Args:
        folder: the folder of the recipes.
        name: of the recipe.
        data: measured data, where it asks for them.
        out: model folder to write; None: runs/NAME.

    Raises:
        PisigmaError: the recipe, the data or the folder do not fit; nothing is stored.
    """
    out = out or Path("runs") / name
    if name == JIGS.stem:
        result = run_jigs_recipe(folder / JIGS, out)
    else:
        result = _train(folder / f"{name}.yaml", data, out)
        result |= extra_figures(folder, name, data)
    (folder / RESULTS).mkdir(exist_ok=True)
    write_whole(folder / RESULTS / f"{name}.json", result_text(result))


def _train(recipe: Path, data: Path | None, out: Path) -> Result:
    """What `pisigma train` prints."""
    command = [sys.executable, "-c", _COMMAND, "train", str(recipe), "--out", str(out), "--json"]
    command += ["--data", str(data)] if data else []
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        raise RecipeError(f"{recipe}: `pisigma train` ended with status {done.returncode}.")
    result: Result = json.loads(done.stdout)
    return result


def extra_figures(folder: Path, name: str, data: Path | None) -> dict[str, Any]:
    """Figures that only the page shows: the course of a training, and what leaving out parameters changes.

    Args:
        folder: the folder of the recipes.
        name: of the recipe.
        data: measured data, where it asks for them.

    Raises:
        PisigmaError: the recipe or the data do not fit.
    """
    recipe = read_any_recipe(folder / f"{name}.yaml")
    if isinstance(recipe, Recipe):
        return report_course(recipe, train_recipe(recipe, load_measurements(recipe, data)))
    if isinstance(recipe, GeometricRecipe):
        rows, cases = (
            simulate_training(recipe),
            read_published(folder).redundant_sums[name.split("_")[0]].cases,
        )
        result = recipe.calibrate(rows)
        return {
            **report_eliminations(recipe, cases, result, rows, simulate_held_out(recipe)),
            **report_correlations(result),
        }
    return {}
