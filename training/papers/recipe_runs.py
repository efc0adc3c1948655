"""Running a recipe: its model folder, and the stored result for the page."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from elimination_cases import report_correlations, report_eliminations
from jig_recipe import JIGS
from jig_run import run_jigs_recipe
from markdown_text import command_of
from pisigma.calibration.geometric.result import CalibrationResult
from pisigma.files.output_file import write_atomically
from pisigma.files.output_folder import check_folder
from pisigma.measurement.dataset import Measurements
from pisigma.workflow.recipes.data import simulate
from pisigma.workflow.recipes.reader import read_recipe
from pisigma.workflow.recipes.recipe import GeometricRecipe
from pisigma.workflow.settings.training import TrainSettings
from pisigma.workflow.train import InverseTraining, Training, train
from published import read_published
from stored_results import RESULTS, result_text
from training_course import report_course


def run_recipe(folder: Path, name: str, data: Path | None, out: Path | None) -> None:
    """Run a recipe, write its model folder and store its result, one value per line.

    Args:
        folder: The folder of the recipes.
        name: Name of the recipe.
        data: Measured data, if the recipe needs them.
        out: Model folder to write; None: runs/NAME.

    Raises:
        PisigmaError: The recipe, the data or the folder are invalid; nothing is stored.
    """
    out = out or Path("runs") / name
    if name == JIGS.stem:
        result = run_jigs_recipe(folder / JIGS, out)
    else:
        check_folder(out, overwrite=True)
        path = folder / f"{name}.yaml"
        rows = None if data is None else replace(Measurements.read_csv(data), source=data.name)
        training = train(path, rows, TrainSettings(show_progress=True))
        training.save(out, name, command_of(name), overwrite=True)
        result = {"model": str(out), **figures_of(training), **extra_figures(folder, name, training)}
    (folder / RESULTS).mkdir(exist_ok=True)
    write_atomically(folder / RESULTS / f"{name}.json", result_text(result))


def figures_of(training: Training) -> dict[str, Any]:
    """Return all figures of a training, without the command."""
    figures = training.to_json()
    del figures["command"]
    return figures


def extra_figures(folder: Path, name: str, training: Training) -> dict[str, Any]:
    """Return figures that only the page shows: the course of a training, and the effect of eliminating parameters.

    Args:
        folder: The folder of the recipes.
        name: Name of the recipe.
        training: The training.

    Raises:
        PisigmaError: A parameter to eliminate does not exist, or the rows do not determine the others.
    """
    if isinstance(training, InverseTraining):
        return report_course(training.run) if training.recipe.paper else {}
    recipe = read_recipe(folder / f"{name}.yaml")
    if not (isinstance(recipe, GeometricRecipe) and isinstance(training.result, CalibrationResult)):
        return {}
    if not recipe.paper:
        return {}
    cases = read_published(folder).redundant_sums[name.split("_")[0]].cases
    (_, held_out), *_ = simulate(recipe).simulations
    return {
        **report_eliminations(recipe, cases, training.result, training.rows, held_out),
        **report_correlations(training.result),
    }
