"""`pisigma verify`: check with new measurements that a correction is active and right."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pisigma.cli.arguments import AsJson, ModelOrCell, Verbose
from pisigma.cli.cell import cell_at, next_step_lines, refuse_with_cell, report_overrides
from pisigma.cli.output import print_json, screen_width
from pisigma.cli.progress import progress_of
from pisigma.cli.screen import print_result
from pisigma.cli.settings_options import StatedSettings, takes_settings
from pisigma.files.errors import AcceptanceError
from pisigma.workflow.settings.verification import VerificationSettings

if TYPE_CHECKING:
    from pisigma.workflow.cell.cell import Cell

Hash = Annotated[
    str | None,
    typer.Option(
        "--sha256",
        help="Refuse the model unless its model.yaml has this SHA-256 hash.",
    ),
]
Data = Annotated[
    Path | None,
    typer.Argument(
        help="New measurements (CSV) at commanded joint values. [default: newest session of a cell]"
    ),
]
OfModel = Annotated[
    str | None,
    typer.Option(
        "--model", help="Name of a model of the cell. [default: the model in use, otherwise the newest]"
    ),
]


@takes_settings
def verify(
    model: ModelOrCell,
    *,
    data: Data = None,
    settings: StatedSettings[VerificationSettings],
    of_model: OfModel = None,
    sha256: Hash = None,
    verbose: Verbose = False,
    as_json: AsJson = False,
) -> None:
    """Check with new measurements that a correction is active and right.

    Compares the corrected model with the nominal robot. Also reports what has moved since the model was made and how to
    recalibrate, and names setup faults (units, order, signs or zeros of joints, a correction applied twice or not at
    all) that explain large errors. Excludes rows of the set "train". Exits with status 3 if the corrected model does
    not explain the measurements better than the nominal robot, or if a part of the arm, its base or its tool has moved.
    """
    from pisigma.files.model_files import check_model_hash
    from pisigma.workflow import verify as workflow
    from pisigma.workflow.result_texts import verification_text

    if (cell := cell_at(model)) is not None:
        refuse_with_cell(DATA=data, __sha256=sha256)
        return _verify_cell(cell, settings, of_model, verbose, as_json)
    if data is None or of_model is not None:
        raise typer.BadParameter(
            "the argument DATA is missing" if data is None else "--model applies only to a cell"
        )
    chosen = settings.build()
    if sha256 is not None:
        check_model_hash(model, sha256)
    with progress_of("verify") as progress:
        progress("comparing the models and looking for setup faults")
        verification = workflow.verify(model, data, chosen)
    if as_json:
        print_json(verification.to_json())
    else:
        print_result(verification_text(verification, screen_width(), verbose), verbose)
    if not verification.accepted:
        raise AcceptanceError(verification.sentence)


def _verify_cell(
    cell: "Cell",
    settings: StatedSettings[VerificationSettings],
    model: str | None,
    verbose: bool,
    as_json: bool,
) -> None:
    """Verify a model of a cell with its newest session."""
    from pisigma.workflow.result_texts import verification_text

    with progress_of("verify") as progress:
        progress("comparing the models and looking for setup faults")
        verification, entry = cell.verify(None, model, **report_overrides(cell, "verify", settings))
    in_use = cell.history.in_use
    if as_json:
        use = None if in_use is None else in_use.name
        print_json({**verification.to_json(), "in_use": use, "next": cell.status().step.to_json()})
    else:
        lines = (
            [f"Model '{entry.name}' is in use."] if in_use is not None and in_use.name == entry.name else []
        )
        text = verification_text(verification, screen_width(), verbose)
        print_result(text, verbose, [*lines, *next_step_lines(cell.status())])
    if not verification.accepted:
        raise AcceptanceError(verification.sentence)
