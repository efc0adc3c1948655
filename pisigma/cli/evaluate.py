"""`pisigma evaluate`: how well models explain measurements that they were not trained on."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from pisigma.judging.model_comparison import ModelComparison
    from pisigma.workflow.evaluate import Evaluation


def evaluate(
    paths: Annotated[
        list[str],
        typer.Argument(
            metavar="MODEL... DATA",
            help="Model folders, and 'nominal' (the robot as drawn, base and tool fitted) or 'geometric' (what a "
            "hybrid builds upon) of the first that has it; last, measurements (CSV) in the frames that they were "
            "fitted in. A single model is compared with nominal.",
        ),
    ],
    max_mean_mm: Annotated[
        float | None, typer.Option(help="Accept only where the mean position error is at most this.")
    ] = None,
    max_p95_mm: Annotated[
        float | None, typer.Option(help="Accept only where 95 % of the position errors are at most this.")
    ] = None,
    max_mm: Annotated[
        float | None, typer.Option(help="Accept only where no position error is larger.")
    ] = None,
    max_mean_deg: Annotated[
        float | None, typer.Option(help="Accept only where the mean orientation error is at most this.")
    ] = None,
    fit_frame: Annotated[
        bool, typer.Option("--fit-frame", help="The sensor was moved since: fit its frame to these rows.")
    ] = False,
    resamples: Annotated[
        int, typer.Option(min=2, help="Resamples of the configurations, for confidence intervals.")
    ] = 2000,
    seed: Annotated[int, typer.Option(help="Seed of the resamples.")] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Compare models on measurements, with confidence intervals, and accept them or not.

    Rows of the set "train" are left out where the file has a column "set". With a limit, every model folder has to
    meet it, else the exit status is 3.
    """
    from pisigma.cli.output import print_json
    from pisigma.errors import AcceptanceError
    from pisigma.judging.bootstrap import Bootstrap
    from pisigma.workflow import evaluate as workflow

    if len(paths) < 2:
        raise typer.BadParameter("a model folder and, last, a file of measurements were wanted.")
    limits = workflow.Limits(max_mean_mm, max_p95_mm, max_mm, max_mean_deg)
    settings = workflow.EvaluationSettings(limits, fit_frame, Bootstrap(resamples, seed))
    evaluation = workflow.evaluate(paths[:-1], paths[-1], settings)
    if as_json:
        print_json(evaluation.to_json())
    else:
        _print(evaluation)
    if not evaluation.accepted:
        raise AcceptanceError(f"not accepted: {'; '.join(evaluation.missed)}.")


def print_comparison(comparison: "ModelComparison", data: str) -> None:
    """Print the errors of every model and its differences to the first."""
    from pisigma.cli.output import print_table, screen_width
    from pisigma.reporting.comparison_tables import difference_table, error_table

    tables = [error_table(comparison)]
    if len(comparison.models) > 1:
        tables.append(difference_table(comparison))
    for table in tables:
        for head, rows in table.fitting(screen_width()):
            print_table(f"{table.title} of {Path(data).name}", head, rows)


def _print(evaluation: "Evaluation") -> None:
    from pisigma.cli.output import print_lines

    stated = evaluation.settings.limits.stated
    if stated and evaluation.accepted:
        limits = ", ".join(f"{name} {limit:g}" for name, limit in stated.items())
        print_lines([f"Accepted: every model stays within {limits}."])
    elif stated:
        print_lines([f"Not accepted: {'; '.join(evaluation.missed)}."])
    print_comparison(evaluation.comparison, evaluation.data)
    print_lines(evaluation.warnings)
