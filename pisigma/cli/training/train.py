"""`pisigma train`: from a recipe to a model folder."""

import shlex
import shutil
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pisigma.cli.arguments import AcceptImplausible, AsJson, Overwrite, Verbose
from pisigma.cli.output import print_json, saved_model_folder
from pisigma.cli.progress import progress_of
from pisigma.cli.screen import print_result, print_screen
from pisigma.cli.settings_options import takes_settings
from pisigma.files.errors import make_printable
from pisigma.reporting.result_text import Block, table_block
from pisigma.reporting.verdict import Verdict, rms_text, rounded_text, uncapitalised
from pisigma.workflow.settings.training import TrainSettings

if TYPE_CHECKING:
    from pisigma.validation.held_out.calibration_summary import CalibrationSummary
    from pisigma.validation.held_out.training_summary import TrainingSummary


@takes_settings
def train(
    recipe: Annotated[Path, typer.Argument(help="Recipe (YAML), such as training/kiro3.yaml.")],
    settings: TrainSettings,
    data: Annotated[
        Path | None, typer.Option(help="Measured data (CSV), for recipes that need them.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Model folder to write. [default: runs/NAME, or the next free name]")
    ] = None,
    accept_implausible: AcceptImplausible = False,
    overwrite: Overwrite = False,
    verbose: Verbose = False,
    as_json: AsJson = False,
) -> None:
    """Train the model of a recipe and write it as a model folder with card and figures.

    Exits with status 3 and writes no folder if a calibration must not be trusted.
    """
    started = time.perf_counter()
    from pisigma.files.conflicts import check_conflicts
    from pisigma.files.output_folder import check_folder
    from pisigma.reporting.calibration_text import calibration_text
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
    texts = {"name": read.name, "command": make_printable(shlex.join(command), cut=False)}
    with saved_model_folder(training, folder, accept_implausible, overwrite, **texts) as written:
        shutil.rmtree(checkpoints, ignore_errors=True)
        training = replace(training, seconds=time.perf_counter() - started)
        if as_json:
            print_json({"model": written and str(written), **training.to_json(), "command": texts["command"]})
        elif isinstance(training, InverseTraining):
            _print_training(training.summary, folder, training.seconds, verbose)
        else:
            also = list(_redundancy(training.summary))
            print_result(calibration_text(training.summary, written, training.seconds, also), verbose)


def _next_free(name: str) -> Path:
    """Return `runs/NAME`, or the first of `runs/NAME-2` and so on that does not exist."""
    names = (name, *(f"{name}-{number}" for number in range(2, 1_000)))
    return next(path for path in (Path("runs") / free for free in names) if not path.exists())


def _print_training(summary: "TrainingSummary", folder: Path, seconds: float, verbose: bool) -> None:
    """Print the errors of held-out poses and of joints."""
    from pisigma.reporting.tables import joint_rows, pose_rows

    columns = [
        f"{when}\n{name}" for when in ("before", "after") for name in ("average", "deviat.", "maximum")
    ]
    rows, blocks, held_out = summary.rows, list[Block](), ""
    for figures, which in (
        (summary.test, "{rows} rows of the set 'test'"),
        (summary.cross_validation, "held out in {folds}-fold cross-validation"),
    ):
        if figures is not None:
            which = which.format(rows=figures.rows, folds=figures.folds)
            *_, best = figures.models.values()
            held_out = (
                f"{rms_text(best, rows.used)} RMS, {which}; nominal {rms_text(figures.nominal, rows.used)}"
            )
            blocks.insert(0, table_block(f"errors of poses, {which}", *pose_rows(figures.models)))
    blocks.append(
        table_block("absolute joint errors", ("joint", "unit", "rows", *columns), joint_rows(summary.joints))
    )
    reason = f" ({rows.rule})" if rows.left_out else ""
    verdict = Verdict(
        f"{held_out or _worst_joint(summary)}.",
        uncapitalised(summary.verdict or "not known for a measured robot: the rows are simulated."),
        f"verify with other poses: `pisigma verify {folder} ROWS.csv`.",
    )
    closing = [
        f"{rows.used} rows used, {rows.left_out} left out{reason}.",
        f"Model written to {folder} in {seconds:.1f} s; its README.md has all figures.",
    ]
    print_screen(verdict, blocks=blocks, closing_sentences=closing, verbose=verbose)


def _worst_joint(summary: "TrainingSummary") -> str:
    """Return a text with the mean error of the worst joint, before and after the correction."""
    errors = {one.name: (one.held_out or one.training, one.held_out is None) for one in summary.joints}
    known = {name: one for name, one in errors.items() if one[0] is not None}
    if not known:
        return "not known, because no row was judged"
    name, (worst, is_fit) = max(known.items(), key=lambda one: one[1][0].after.values[0])  # type: ignore[union-attr]
    assert worst is not None
    after, before = (rounded_text(one.values[0]) for one in (worst.after, worst.before))
    kind = "fit to the training rows" if is_fit else "held-out simulated rows"
    return f"{after} {worst.after.unit} mean error of the worst joint, {name}, {kind}; {before} before the correction"


def _redundancy(summary: "CalibrationSummary") -> Iterator[Block]:
    """Return tables of redundant parameters and convergence, compared with the paper."""
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
    yield table_block("redundancy and convergence", ("what", "pisigma", "paper"), rows)


def _sets_side_by_side(
    ours: Sequence[Sequence[str]], papers: Sequence[Sequence[str]]
) -> list[tuple[str, str, str]]:
    """Return one row per set; equal sets share a row."""
    pairs = [(members, next((one for one in papers if set(one) == set(members)), ())) for members in ours]
    pairs += [((), one) for one in papers if set(one) not in [set(members) for members in ours]]
    return [
        ("" if number else "redundant sets", _in_braces(our), _in_braces(papers_set))
        for number, (our, papers_set) in enumerate(pairs)
    ]


def _in_braces(names: Sequence[str]) -> str:
    return f"{{{', '.join(names)}}}" if names else ""
