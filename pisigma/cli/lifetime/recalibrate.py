"""`pisigma recalibrate`: a model brought up to date with few new rows."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pisigma.cli.arguments import AcceptImplausible, AsJson, ModelFolder, Overwrite
from pisigma.cli.output import command_line, print_json, print_lines, print_table, progress_of, saved
from pisigma.cli.settings_options import takes_settings
from pisigma.files.errors import AcceptanceError
from pisigma.workflow.settings.recalibration import RecalibrationSettings

if TYPE_CHECKING:
    from pisigma.robot.description import Robot
    from pisigma.workflow.recalibrate import Recalibration

Data = Annotated[
    list[Path],
    typer.Argument(metavar="ROWS...", help="New measurements (CSV), ten poses or more, of any sensors."),
]
Out = Annotated[Path | None, typer.Option(help="Model folder to write; needed without --dry-run.")]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Say what would be kept, and write nothing.")]


@takes_settings
def recalibrate(
    context: typer.Context,
    model: ModelFolder,
    data: Data,
    settings: RecalibrationSettings,
    out: Out = None,
    dry_run: DryRun = False,
    accept_implausible: AcceptImplausible = False,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Bring a model up to date with new rows, and say what has moved since it was made.

    Left-out rows decide between the old model with the frames of these rows, the recalibrated one, and a calibration
    from scratch; the folder holds the winner. Exit status 3, and no folder, where the result must not be trusted.
    """
    from pisigma.files.output_folder import check_folder

    if (out is None) is not dry_run:
        raise typer.BadParameter("either --out DIR or --dry-run was wanted.", param_hint="'--out'")
    if out is not None:
        stated = settings.cameras.files if settings.cameras else ()
        check_folder(out, overwrite, inputs=(model, *data, *stated))
    recalibrate_into(context, model, data, settings, out, accept_implausible, overwrite, as_json)


def recalibrate_into(
    context: typer.Context,
    model: Path,
    data: Sequence[Path],
    settings: RecalibrationSettings,
    out: Path | None,
    accept_implausible: bool,
    overwrite: bool,
    as_json: bool,
    drawn: "Robot | None" = None,
) -> None:
    """Add rows to a model, write what was kept where a folder is stated, and print it.

    Args:
        context: of the command, for the card.
        model: folder of the model.
        data: files of the rows.
        settings: how.
        out: folder to write; None for none.
        accept_implausible: write also what must not be trusted.
        overwrite: replace the model that the folder holds.
        as_json: print one JSON object.
        drawn: the robot whose fleet the model has to be the prior of; None for any model.

    Raises:
        ModelError: the model is of another robot, or no fleet prior.
    """
    from pisigma.workflow import recalibrate as workflow

    with progress_of("recalibration") as progress:
        recalibration = workflow.recalibrate(model, data, settings, progress, drawn)
    if out is None:
        _print(recalibration, None, as_json)
        if not (recalibration.trusted or accept_implausible):
            raise AcceptanceError(
                "the result must not be trusted, for the reasons above; nothing would be written."
            )
        return
    with saved(recalibration, out, accept_implausible, overwrite, command=command_line(context)) as folder:
        _print(recalibration, folder, as_json)


def _print(recalibration: "Recalibration", folder: Path | None, as_json: bool) -> None:
    """Print what has moved and which model was kept."""
    from pisigma.reporting.recalibration_card import candidate_table

    if as_json:
        print_json({"model": folder and str(folder), **recalibration.to_json()})
        return
    summary = recalibration.summary
    print_lines([*(one.sentence for one in summary.outliers), summary.changed, summary.verdict])
    print_table(f"errors of {summary.left_out} left-out rows", *candidate_table(summary))
    print_lines(f"Implausible: {one.sentence}" for one in summary.diagnostics)
    print_lines(f"Warning: {sentence}" for sentence in summary.warnings)
    if folder is not None:
        print_lines([f"Model written to {folder} in {recalibration.seconds:.1f} s; read its README.md."])
