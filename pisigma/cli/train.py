"""`pisigma train`: from a recipe to a model folder."""

import shlex
import shutil
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pisigma.cli.arguments import AcceptImplausible, AsJson, Overwrite
from pisigma.cli.calibrate import print_calibration
from pisigma.cli.output import print_json, print_line, print_lines, print_table, progress_of, saved
from pisigma.cli.settings_options import takes_settings
from pisigma.files.errors import printable
from pisigma.workflow.settings.training import TrainSettings

if TYPE_CHECKING:
    from pisigma.validation.held_out.calibration_summary import CalibrationSummary
    from pisigma.validation.held_out.training_summary import TrainingSummary


@takes_settings
def train(
    recipe: Annotated[Path, typer.Argument(help="Recipe (YAML), such as training/kiro3.yaml.")],
    settings: TrainSettings,
    data: Annotated[
        Path | None, typer.Option(help="Measured data (CSV), for recipes that ask for them.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Model folder to write. [default: runs/NAME, or the next free name]")
    ] = None,
    accept_implausible: AcceptImplausible = False,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Train the model of a recipe and write it as a model folder with card and figures.

    Exit status 3, and no folder, where a calibration must not be trusted.
    """
    started = time.perf_counter()
    from pisigma.files.conflicts import check_conflicts
    from pisigma.files.output_folder import check_folder
    from pisigma.robot.robot_file import robot_file
    from pisigma.workflow.recipes.reader import read_recipe
    from pisigma.workflow.train import InverseTraining
    from pisigma.workflow.train import train as train_recipe

    read = read_recipe(recipe)
    folder = out or _next_free(read.name)
    inputs = (recipe, data, robot_file(read.robot))
    check_folder(folder, overwrite, inputs)
    if settings.logs is not None:
        check_conflicts(settings.logs / "metrics.csv", inputs, "--logs")
    checkpoints = folder.parent / f".{folder.name}.training"
    settings = replace(settings, checkpoints=checkpoints, show_progress=True)
    with progress_of("training") as progress:
        training = train_recipe(recipe, data, settings, progress)
    command = ["pisigma", "train", recipe.as_posix(), *(["--data", data.name] if data else [])]
    texts = {"name": read.name, "command": printable(shlex.join(command), cut=False)}
    with saved(training, folder, accept_implausible, overwrite, **texts) as written:
        shutil.rmtree(checkpoints, ignore_errors=True)
        training = replace(training, seconds=time.perf_counter() - started)
        if as_json:
            print_json({"model": written and str(written), **training.to_json(), "command": texts["command"]})
        elif isinstance(training, InverseTraining):
            _print_training(training.summary)
            print_line(f"Model written to {folder} in {training.seconds:.1f} s; read its README.md.")
        else:
            _print_redundancy(training.summary)
            print_calibration(training.summary, written, training.seconds)


def _next_free(name: str) -> Path:
    """`runs/NAME`, or with a number behind it the first that is not there."""
    names = (name, *(f"{name}-{number}" for number in range(2, 1_000)))
    return next(path for path in (Path("runs") / free for free in names) if not path.exists())


def _print_training(summary: "TrainingSummary") -> None:
    """Print the errors of joints and of held-out poses."""
    from pisigma.reporting.tables import joint_rows, pose_rows

    columns = [
        f"{when}\n{name}" for when in ("before", "after") for name in ("average", "deviat.", "maximum")
    ]
    print_table("absolute joint errors", ("joint", "unit", "rows", *columns), joint_rows(summary.joints))
    if summary.cross_validation is not None:
        title = f"pose errors of held-out rows, {summary.cross_validation.folds}-fold cross-validation"
        print_table(title, *pose_rows(summary.cross_validation.models))
        print_lines([summary.verdict or ""])
    if summary.test is not None:
        title = f"pose errors of the {summary.test.rows} rows of the set 'test', which were kept aside"
        print_table(title, *pose_rows(summary.test.models))
    rows = summary.rows
    reason = f" ({rows.rule})" if rows.left_out else ""
    print_lines([f"{rows.used} rows used, {rows.left_out} left out{reason}."])


def _print_redundancy(summary: "CalibrationSummary") -> None:
    """Print what is redundant beside the paper's, and how the calibration converged."""
    if summary.redundant_sets is None:
        return
    paper = summary.paper or {}
    rows = _sets_side_by_side(summary.redundant_sets, paper.get("redundant_sets", ()))  # type: ignore[arg-type]
    rows.append(("no effect", _in_braces(summary.no_effect or ()), _in_braces(paper.get("no_effect", ()))))  # type: ignore[arg-type]
    for label, value, key, form in (
        ("left by pairs", summary.pairwise_parameters, "pairwise_parameters", "{}"),
        ("rank", summary.rank, "rank", "{}"),
        ("iterations", summary.iterations, "iterations_to_converge", "{}"),
        ("RMSE after [mm]", summary.rmse_mm[-1], "rmse_after_mm", "{:.2e}"),
    ):
        rows.append((label, form.format(value), form.format(paper[key]) if key in paper else ""))
    print_table("redundancy and convergence", ("what", "pisigma", "paper"), rows)


def _sets_side_by_side(
    ours: Sequence[Sequence[str]], papers: Sequence[Sequence[str]]
) -> list[tuple[str, str, str]]:
    """A row per set, equal sets on one."""
    pairs = [(members, next((one for one in papers if set(one) == set(members)), ())) for members in ours]
    pairs += [((), one) for one in papers if set(one) not in [set(members) for members in ours]]
    return [
        ("" if number else "redundant sets", _in_braces(our), _in_braces(papers_set))
        for number, (our, papers_set) in enumerate(pairs)
    ]


def _in_braces(names: Sequence[str]) -> str:
    return f"{{{', '.join(names)}}}" if names else ""
