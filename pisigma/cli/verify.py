"""`pisigma verify`: check with new measurements that a correction is active and right."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pisigma.cli.arguments import AsJson, ModelOrCell, Verbose
from pisigma.cli.cell import cell_at, next_lines, refuse_with_cell, report_overrides
from pisigma.cli.output import print_json, print_lines, screen_width
from pisigma.cli.progress import progress_of
from pisigma.cli.screen import Block, print_screen, table
from pisigma.cli.settings_options import StatedOptions, takes_settings
from pisigma.files.errors import AcceptanceError
from pisigma.workflow.settings.verification import VerificationSettings

if TYPE_CHECKING:
    from pisigma.validation.held_out.model_comparison import ModelComparison, ModelFigures
    from pisigma.workflow.cell.cell import Cell
    from pisigma.workflow.verify import Verification

Hash = Annotated[
    str | None,
    typer.Option(
        "--sha256",
        help="Refuse the model unless its model.yaml has this SHA-256.",
    ),
]
Data = Annotated[
    Path | None,
    typer.Argument(
        help="New measurements (CSV) at commanded joint values. [default: newest session of a cell]"
    ),
]
OfModel = Annotated[
    str | None, typer.Option("--model", help="Model of the cell. [default: in use, else the newest]")
]

NEXT_STEPS = {
    "better": "use the model, and verify again after a change of tool, base or arm.",
    "not_better": "check that the controller applies the correction once, then measure again or recalibrate.",
    "undecided": "measure more poses that differ, and verify again.",
    "moved": "recalibrate the model with these rows.",
    "setup_fault": "correct what is named above and measure again.",
    "implausible": "correct what is named above and measure again.",
}


@takes_settings
def verify(
    model: ModelOrCell,
    *,
    data: Data = None,
    settings: VerificationSettings,
    stated: StatedOptions,
    of_model: OfModel = None,
    sha256: Hash = None,
    verbose: Verbose = False,
    as_json: AsJson = False,
) -> None:
    """Check with new measurements that a correction is active and right.

    Compares the corrected model with the nominal robot. Also says what has moved since the model was made and how to
    recalibrate, and names setup faults (units, order, signs or zeros of joints, a correction applied twice or not at
    all) that explain large errors. Leaves out rows of the set "train". Exits with status 3 if the corrected model
    does not explain the measurements better, or the arm has moved.
    """
    from pisigma.files.model_files import check_model_hash
    from pisigma.workflow import verify as workflow

    if (cell := cell_at(model)) is not None:
        refuse_with_cell(DATA=data, __sha256=sha256)
        return _verify_cell(cell, stated, of_model, verbose, as_json)
    if data is None or of_model is not None:
        raise typer.BadParameter("expected DATA" if data is None else "--model names a model of a cell")
    if sha256 is not None:
        check_model_hash(model, sha256)
    with progress_of("verify") as progress:
        progress("comparing the models and looking for setup faults")
        verification = workflow.verify(model, data, settings)
    if as_json:
        print_json(verification.to_json())
    else:
        _print(verification, verbose)
    if not verification.accepted:
        raise AcceptanceError(verification.sentence)


def _verify_cell(
    cell: "Cell", stated: StatedOptions, model: str | None, verbose: bool, as_json: bool
) -> None:
    """Verify a model of a cell with its newest session."""
    with progress_of("verify") as progress:
        progress("comparing the models and looking for setup faults")
        verification, entry = cell.verify(None, model, **report_overrides(cell, "verify", stated))
    in_use = cell.history.in_use
    if as_json:
        use = None if in_use is None else in_use.name
        print_json({**verification.to_json(), "in_use": use, "next": cell.status().step.to_json()})
    else:
        _print(verification, verbose)
        used = (
            [f"Model '{entry.name}' is in use."] if in_use is not None and in_use.name == entry.name else []
        )
        print_lines([*used, *next_lines(cell)])
    if not verification.accepted:
        raise AcceptanceError(verification.sentence)


def _print(verification: "Verification", verbose: bool) -> None:
    """Print the verdict, warnings, and the errors with and without the correction."""
    from pisigma.reporting.verdict import Verdict, uncapitalised

    trust = {"better": "yes", "undecided": "not known"}.get(verification.verdict, "no")
    figures, rows = verification.comparison.models, verification.rows
    errors = f"{model_rms(figures[-1], rows)} RMS with the correction, {model_rms(figures[0], rows)} without"
    command = f"run `{verification.recalibration}`."
    verdict = Verdict(
        f"{errors} ({rows} rows of {Path(verification.data).name}).",
        f"{trust}: {uncapitalised(verification.sentence)}",
        command if verification.recalibration else NEXT_STEPS[verification.verdict],
    )
    warnings = [*(fault.sentence for fault in verification.setup_faults), *verification.warnings]
    print_screen(
        verdict,
        warnings,
        *comparison_blocks(verification.comparison, verification.data, verbose),
        verbose=verbose,
    )


def model_rms(figures: "ModelFigures", rows: int) -> str:
    """Write the RMS errors of a model."""
    from pisigma.reporting.verdict import rounded

    errors = (figures.position, figures.orientation)
    return " and ".join(
        f"{rounded(one.statistics['rms'], rows)} {one.unit}" for one in errors if one is not None
    )


def comparison_blocks(
    comparison: "ModelComparison", data: str, verbose: bool
) -> tuple[list[Block], list[Block]]:
    """Lay out the errors of models on the rows of a file, and what is left out of them without `verbose`."""
    from pisigma.reporting.comparison_tables import comparison_tables
    from pisigma.reporting.tables import distance_table

    def blocks(whole: bool) -> list[Block]:
        tables = comparison_tables(comparison, Path(data).name, screen_width(), whole)
        return [
            table(title, *cells, "all statistics" if whole else title.split()[0].lower())
            for title, cells in tables
        ]

    shown = blocks(whole=verbose)
    if comparison.socket_distance is not None:
        shown.append(table("stated distances of sockets", *distance_table(comparison.socket_distance)))
    return shown, [] if verbose else blocks(whole=True)
