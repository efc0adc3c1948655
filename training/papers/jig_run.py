"""Running the recipe of jigs: model folder with card and pictures, and tables on the terminal."""

import shlex
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console

from jig_card import write_jig_card
from jig_figures import ERRORS_PNG, LINES_PNG, SEEDS_PNG, TOUCHES_PNG
from jig_recipe import read_jig_recipe
from jig_report import DEFAULT, report_jigs, run_jigs
from jig_tables import all_tables
from pisigma.cli.output import print_table
from pisigma.files.model_files import MODEL_FILES
from pisigma.files.output_folder import check_folder, staged_folder
from pisigma.model.geometric_model import model_of_calibration
from pisigma.model.inverse.written_model import write_model
from pisigma.robot.description import Robot
from pisigma.validation.held_out.calibration_summary import summarise
from pisigma.workflow.recipes.reader import recipe_hash

_FILES = MODEL_FILES | {ERRORS_PNG, LINES_PNG, SEEDS_PNG, TOUCHES_PNG}


def run_jigs_recipe(path: Path, out: Path) -> dict[str, Any]:
    """Calibrate the simulated robot of the recipe with touches, write the model folder and print the tables.

    Args:
        path: The recipe.
        out: Model folder to write.

    Returns:
        The report of `report_jigs`, with "model" and "seconds".

    Raises:
        PisigmaError: The recipe is invalid, or the folder cannot be written.
    """
    started = time.perf_counter()
    recipe = read_jig_recipe(path)
    check_folder(out, overwrite=True, names=_FILES)
    with Console(stderr=True).status("touching") as status:
        run = run_jigs(recipe, status.update)
    report = report_jigs(run)
    result = run.calibrations[DEFAULT].result
    assert result is not None
    nominal = Robot.load(recipe.robot)
    model = model_of_calibration(
        recipe.name, nominal, result, run.measurements, (recipe.name, recipe_hash(path))
    )
    texts = {
        "description": recipe.description,
        "command": shlex.join(["python", "training/papers", "run", path.stem]),
        "not_validated": recipe.not_validated,
    }
    with staged_folder(out, overwrite=True, names=_FILES) as scratch:
        write_model(replace(model, metrics=summarise(result).to_json()), scratch)
        write_jig_card(model, run, report, texts, scratch)
    for table in all_tables(report):
        print_table(table.title, table.columns, table.rows)
    for sentence in report["definitions"]:
        print(f"- {sentence}.")
    seconds = round(time.perf_counter() - started, 3)
    print(f"Model written to {out} in {seconds:.1f} s; read its README.md.")
    return {"model": str(out), "seconds": seconds, **report}
