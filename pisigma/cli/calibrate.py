"""`pisigma calibrate`: geometric or hybrid calibration of measured data."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pisigma.cli.arguments import (
    AcceptImplausible,
    AsJson,
    Overwrite,
    Verbose,
    complete_model,
    complete_robot,
)
from pisigma.cli.cell import cell_at, next_step_lines, refuse_with_cell, report_overrides
from pisigma.cli.lifetime.recalibrate import recalibrate_into
from pisigma.cli.output import (
    command_line,
    print_json,
    saved_model_folder,
    wrap_lines,
)
from pisigma.cli.progress import progress_of
from pisigma.cli.screen import print_result
from pisigma.cli.settings_options import StatedSettings, takes_settings
from pisigma.files.errors import AcceptanceError
from pisigma.workflow.settings.calibration import CalibrationSettings
from pisigma.workflow.settings.recalibration import RecalibrationSettings

if TYPE_CHECKING:
    from pisigma.workflow.cell.cell import Cell

RobotName = Annotated[
    str,
    typer.Argument(
        metavar="ROBOT|CELL",
        help="Catalogue name, robot file (YAML or URDF), or a cell.",
        autocompletion=complete_robot,
    ),
]
Data = Annotated[
    list[Path] | None, typer.Argument(metavar="DATA...", help="Measurements (CSV), one or more files.")
]
Out = Annotated[Path | None, typer.Option(help="Model folder to write.")]
Base = Annotated[str | None, typer.Option(help="Base link of a URDF file. [default: its root]")]
Tip = Annotated[str | None, typer.Option(help="Tool link of a URDF file. [default: its only leaf]")]
Prior = Annotated[
    Path | None,
    typer.Option(
        help="Start from this model folder of `pisigma fleet prior` if it predicts held-out rows better.",
        autocompletion=complete_model,
    ),
]


@takes_settings
def calibrate(
    context: typer.Context,
    robot: RobotName,
    *,
    data: Data = None,
    out: Out = None,
    settings: StatedSettings[CalibrationSettings],
    base: Base = None,
    tip: Tip = None,
    prior: Prior = None,
    accept_implausible: AcceptImplausible = False,
    overwrite: Overwrite = False,
    verbose: Verbose = False,
    as_json: AsJson = False,
) -> None:
    """Calibrate a robot from measurements and write a model folder with card and figures.

    Estimates geometry, base, tool and, if it predicts held-out rows better, a joint correction. Exits with status 3
    and writes no folder if the result must not be trusted.
    """
    from pisigma.files.output_folder import check_folder
    from pisigma.reporting.calibration_text import calibration_text
    from pisigma.robot.description import Robot
    from pisigma.robot.robot_file import robot_file
    from pisigma.workflow import calibrate as workflow

    if (cell := cell_at(robot)) is not None:
        refuse_with_cell(DATA=data, __out=out, __base=base, __tip=tip, __prior=prior)
        return _calibrate_cell(cell, settings, accept_implausible, verbose, as_json)
    if not data or out is None:
        raise typer.BadParameter(f"expected {'--out DIR' if data else 'DATA'}, or a cell instead of a robot")
    chosen = settings.build()
    seen_by = chosen.cameras.files if chosen.cameras else ()
    check_folder(out, overwrite, inputs=(robot_file(robot), prior, *data, *seen_by))
    nominal = Robot.load(robot, base, tip)
    if prior is not None:
        chosen.check_unused()
        again = RecalibrationSettings(cameras=chosen.cameras)
        return recalibrate_into(
            context, prior, data, again, out, accept_implausible, overwrite, as_json, verbose, nominal=nominal
        )
    with progress_of("calibrate") as progress:
        calibration = workflow.calibrate(nominal, data, chosen, progress)
    with saved_model_folder(
        calibration, out, accept_implausible, overwrite, command=command_line(context)
    ) as folder:
        if as_json:
            print_json({"model": folder and str(folder), **calibration.to_json()})
        else:
            print_result(calibration_text(calibration.summary, folder, calibration.seconds), verbose)


def _calibrate_cell(
    cell: "Cell",
    settings: StatedSettings[CalibrationSettings],
    accept_implausible: bool,
    verbose: bool,
    as_json: bool,
) -> None:
    """Calibrate with the rows of a cell, store the model there, and print it."""
    from pisigma.reporting.calibration_text import calibration_text
    from pisigma.workflow.calibrate import Calibration

    with progress_of("calibrate") as progress:
        calibration, entry = cell.calibrate(
            progress, accept_implausible, **report_overrides(cell, "calibrate", settings)
        )
    folder = None if entry is None else cell.model_folder(entry.name)
    if as_json:
        print_json(
            {"model": folder and str(folder), **calibration.to_json(), "next": cell.status().step.to_json()}
        )
    else:
        remark = []
        if entry is not None and cell.history.in_use is not None:
            remark = [f"Model '{entry.name}': {entry.remark}."]
        assert isinstance(calibration, Calibration)  # there is no prior
        text = calibration_text(calibration.summary, folder, calibration.seconds)
        print_result(text, verbose, [*wrap_lines(remark), *next_step_lines(cell.status())])
    if entry is None:
        raise AcceptanceError(
            "no model was stored, because the result must not be trusted, for the reasons above."
        )
