"""`pisigma recalibrate`: a model brought up to date with few new rows."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pisigma.cli.arguments import AcceptImplausible, AsJson, ModelOrCell, Overwrite, Verbose
from pisigma.cli.cell import cell_at, next_step_lines, refuse_with_cell, report_overrides
from pisigma.cli.output import command_line, print_json, saved_model_folder
from pisigma.cli.progress import progress_of
from pisigma.cli.screen import print_result
from pisigma.cli.settings_options import StatedSettings, takes_settings
from pisigma.files.errors import AcceptanceError
from pisigma.workflow.settings.recalibration import RecalibrationSettings

if TYPE_CHECKING:
    from pisigma.robot.description import Robot
    from pisigma.workflow.cell.cell import Cell
    from pisigma.workflow.recalibrate import Recalibration

Data = Annotated[
    list[Path] | None,
    typer.Argument(
        metavar="ROWS...",
        help="New measurements (CSV) of ten poses or more. [default: newest session of a cell]",
    ),
]
Out = Annotated[Path | None, typer.Option(help="Model folder to write; not with --dry-run.")]
DryRun = Annotated[
    bool, typer.Option("--dry-run", help="Report which model would be kept, without writing it.")
]


@takes_settings
def recalibrate(
    context: typer.Context,
    model: ModelOrCell,
    *,
    data: Data = None,
    settings: StatedSettings[RecalibrationSettings],
    out: Out = None,
    dry_run: DryRun = False,
    accept_implausible: AcceptImplausible = False,
    overwrite: Overwrite = False,
    verbose: Verbose = False,
    as_json: AsJson = False,
) -> None:
    """Bring a model up to date with new rows, and report what has moved since it was made.

    Keeps the model that predicts held-out rows best: the old one with the frames of these rows, the recalibrated one,
    or a calibration from scratch. Exits with status 3 and writes no folder if the result must not be trusted.
    """
    from pisigma.files.output_folder import check_folder

    if (cell := cell_at(model)) is not None:
        refuse_with_cell(ROWS=data, __out=out, __dry_run=dry_run, __overwrite=overwrite)
        return _recalibrate_cell(cell, settings, accept_implausible, as_json, verbose)
    if not data:
        raise typer.BadParameter("expected ROWS..., or a cell instead of a model")
    if (out is None) is not dry_run:
        raise typer.BadParameter("expected either --out DIR or --dry-run", param_hint="'--out'")
    chosen = settings.build()
    if out is not None:
        seen_by = chosen.cameras.files if chosen.cameras else ()
        check_folder(out, overwrite, inputs=(model, *data, *seen_by))
    recalibrate_into(context, model, data, chosen, out, accept_implausible, overwrite, as_json, verbose)


def recalibrate_into(
    context: typer.Context,
    model: Path,
    data: Sequence[Path],
    settings: RecalibrationSettings,
    out: Path | None,
    accept_implausible: bool,
    overwrite: bool,
    as_json: bool,
    verbose: bool = False,
    fleet_robot: "Robot | None" = None,
) -> None:
    """Recalibrate a model with new rows, write the chosen model if a folder is stated, and print the result.

    Args:
        context: context of the command, for the card.
        model: folder of the model.
        data: files of the rows.
        settings: settings of the recalibration.
        out: folder to write; None to write none.
        accept_implausible: write the model even if it must not be trusted.
        overwrite: replace the model in the folder.
        as_json: print one JSON object.
        verbose: print all tables.
        fleet_robot: the robot, if the model must be the prior of its fleet; None for any model.

    Raises:
        ModelError: the model belongs to another robot, or is not a fleet prior.
    """
    from pisigma.workflow import recalibrate as workflow

    with progress_of("recalibration") as progress:
        recalibration = workflow.recalibrate(model, data, settings, progress, fleet_robot)
    if out is None:
        _print(recalibration, None, as_json, verbose)
        if not (recalibration.trusted or accept_implausible):
            raise AcceptanceError(
                "the result must not be trusted (see the reasons above); nothing would be written."
            )
        return
    with saved_model_folder(
        recalibration, out, accept_implausible, overwrite, command=command_line(context)
    ) as folder:
        _print(recalibration, folder, as_json, verbose)


def _recalibrate_cell(
    cell: "Cell",
    settings: StatedSettings[RecalibrationSettings],
    accept_implausible: bool,
    as_json: bool,
    verbose: bool,
) -> None:
    """Recalibrate the model in use of a cell with its newest session."""
    with progress_of("recalibration") as progress:
        recalibration, entry = cell.recalibrate(
            None, progress, accept_implausible, **report_overrides(cell, "recalibrate", settings)
        )
    folder = None if entry is None else cell.model_folder(entry.name)
    _print(recalibration, folder, as_json, verbose, cell)
    if entry is None:
        raise AcceptanceError(
            "no model was stored, because the result must not be trusted (see the reasons above)."
        )


def _print(
    recalibration: "Recalibration",
    folder: Path | None,
    as_json: bool,
    verbose: bool,
    cell: "Cell | None" = None,
) -> None:
    """Print the result, and the next step of a cell."""
    from pisigma.workflow.result_texts import recalibration_text

    if as_json:
        then = {} if cell is None else {"next": cell.status().step.to_json()}
        print_json({"model": folder and str(folder), **recalibration.to_json(), **then})
        return
    lines: list[str] = []
    if cell is not None and (in_use := cell.history.in_use) is not None:
        lines = [f"Model '{in_use.name}' is in use.", *next_step_lines(cell.status())]
    print_result(recalibration_text(recalibration, folder), verbose, lines)
