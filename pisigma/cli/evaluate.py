"""`pisigma evaluate`: errors of models on measurements that they were not trained on."""

from typing import TYPE_CHECKING, Annotated

import typer

from pisigma.cli.arguments import AsJson, Verbose
from pisigma.cli.cell import cell_at, refuse_with_cell, report_overrides
from pisigma.cli.output import print_json, screen_width
from pisigma.cli.progress import progress_of
from pisigma.cli.screen import print_screen
from pisigma.cli.settings_options import StatedSettings, takes_settings
from pisigma.files.errors import AcceptanceError
from pisigma.workflow.settings.evaluation import EvaluationSettings

if TYPE_CHECKING:
    from pisigma.workflow.evaluate import Evaluation

Paths = Annotated[
    list[str],
    typer.Argument(
        metavar="MODEL... DATA|CELL",
        help="Model folders, 'nominal' (base and tool fitted) or 'geometric' (without the joint correction), followed "
        "by the measurements (CSV) in the frames of the models; or a cell.",
    ),
]
Hashes = Annotated[
    list[str] | None,
    typer.Option(
        "--sha256",
        help="Refuse the models unless their model.yaml files have these SHA-256 hashes, one per folder, in order.",
    ),
]


@takes_settings
def evaluate(
    paths: Paths,
    settings: StatedSettings[EvaluationSettings],
    sha256: Hashes = None,
    verbose: Verbose = False,
    as_json: AsJson = False,
) -> None:
    """Compare models on measurements, with confidence intervals, and check them against acceptance limits.

    Compares a single model with the nominal robot. Excludes rows of the set "train". Exits with status 3 if a
    model misses a limit, if the base or the tool has moved, or if the errors are too large for a calibrated robot.
    """
    from pisigma.files.model_files import check_model_hash
    from pisigma.workflow import evaluate as workflow

    if len(paths) == 1 and (cell := cell_at(paths[0])) is not None:
        refuse_with_cell(__sha256=sha256)
        return _tell(cell.evaluate(**report_overrides(cell, "evaluate", settings)), verbose, as_json)
    if len(paths) < 2:
        raise typer.BadParameter("expected one or more model folders followed by a measurement file")
    chosen = settings.build()
    folders = [path for path in paths[:-1] if path not in workflow.REFERENCES]
    if sha256 and len(sha256) != len(folders):
        raise typer.BadParameter(
            f"expected one hash for each of the {len(folders)} model folders, got {len(sha256)}",
            param_hint="'--sha256'",
        )
    for folder, expected in zip(folders, sha256 or (), strict=False):
        check_model_hash(folder, expected)
    with progress_of("evaluate") as progress:
        progress("comparing the models")
        evaluation = workflow.evaluate(paths[:-1], paths[-1], chosen)
    _tell(evaluation, verbose, as_json)


def _tell(evaluation: "Evaluation", verbose: bool, as_json: bool) -> None:
    """Print an evaluation, and end with status 3 if a model is not accepted."""
    if as_json:
        print_json(evaluation.to_json())
    else:
        _print(evaluation, verbose)
    if not evaluation.accepted:
        missed = [f"not accepted: {'; '.join(evaluation.missed_limits)}."] if evaluation.missed_limits else []
        raise AcceptanceError(" ".join([*missed, *(one.sentence for one in evaluation.diagnostics)]))


def _print(evaluation: "Evaluation", verbose: bool) -> None:
    """Print the verdict, warnings, and the errors of all models."""
    from pisigma.reporting.comparison_tables import comparison_blocks, model_rms_text
    from pisigma.reporting.verdict import Verdict

    rows = evaluation.rows
    errors = ", ".join(f"{one.name} {model_rms_text(one, rows)}" for one in evaluation.models)
    fitted = [name for name, one in evaluation.model_descriptions.items() if one.trained_on]
    kind = f"; fit of {' and '.join(fitted)}, which these rows calibrated" if fitted else ""
    verdict = Verdict(
        f"RMS of {rows} rows: {errors}{kind}.",
        _trust(evaluation),
        "correct the problem named above, and evaluate again."
        if evaluation.diagnostics
        else "recalibrate with these rows (`pisigma recalibrate`), or calibrate with more."
        if evaluation.missed_limits
        else "see the intervals below for what differs by more than chance.",
    )
    warnings = [*(one.sentence for one in evaluation.diagnostics[1:]), *evaluation.warnings]
    print_screen(
        verdict,
        warnings,
        *comparison_blocks(evaluation.comparison, evaluation.data, screen_width(), verbose),
        verbose=verbose,
    )


def _trust(evaluation: "Evaluation") -> str:
    """Return a sentence about whether the models were accepted."""
    from pisigma.reporting.verdict import count_text

    stated, warnings = evaluation.settings.limits.stated_limits, evaluation.warnings
    cautions = f" ({count_text(len(warnings), 'warning')})" if warnings else ""
    if evaluation.missed_limits:
        return f"not accepted: {'; '.join(evaluation.missed_limits)}."
    if evaluation.diagnostics:
        return f"no: {evaluation.diagnostics[0].sentence}"
    if not stated:
        return f"not decided{cautions}, because no limit was stated (--max-p95-mm and others)."
    limits = ", ".join(f"{name} {limit:g}" for name, limit in stated.items())
    return f"accepted{cautions}: every model stays within {limits}."
