"""`pisigma calibrate`: geometric or hybrid calibration of measured data."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

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
from pisigma.workflow.settings.calibration import WITH_PRIOR, CalibrationSettings
from pisigma.workflow.settings.recalibration import RecalibrationSettings

if TYPE_CHECKING:
    from pisigma.workflow.cell.cell import Cell
    from pisigma.workflow.frames.calibrate_frame import FrameCalibration

RobotName = Annotated[
    str,
    typer.Argument(
        metavar="ROBOT|CELL",
        help="Catalogue name, robot file (YAML or URDF) or cell.",
        autocompletion=complete_robot,
    ),
]
Data = Annotated[
    list[Path] | None, typer.Argument(metavar="DATA...", help="One or more measurement files (CSV).")
]
Out = Annotated[Path | None, typer.Option(help="Model folder to write.")]
Base = Annotated[str | None, typer.Option(help="Base link of a URDF file. [default: root link]")]
Tip = Annotated[str | None, typer.Option(help="Tool link of a URDF file. [default: only leaf link]")]
Prior = Annotated[
    Path | None,
    typer.Option(
        help="Model folder written by `pisigma fleet prior`; used if it improves the prediction of held-out rows.",
        autocompletion=complete_model,
    ),
]

FrameChoice = Literal["tool", "base", "hand-eye"]

Only = Annotated[
    FrameChoice | None,
    typer.Option(
        metavar="FRAME", help="Fit only the tool, base or hand-eye transform; ROBOT may be a model."
    ),
]
_NOT_STORED = "no model was stored, because the result must not be trusted (see the reasons above)."
_ARM_AS_GIVEN = "with --only, the arm is used as given and no row is held out"


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
    only: Only = None,
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
    from pisigma.lifetime.cell.layout import is_cell_of_arms
    from pisigma.reporting.calibration_text import calibration_text
    from pisigma.robot.description import Robot
    from pisigma.robot.robot_file import robot_file
    from pisigma.workflow import calibrate as workflow

    if is_cell_of_arms(robot):
        refuse_with_cell(DATA=data, __out=out, __base=base, __tip=tip, __prior=prior, __only=only)
        return _calibrate_arms(Path(robot), settings, accept_implausible, verbose, as_json)
    if (cell := cell_at(robot)) is not None:
        refuse_with_cell(DATA=data, __out=out, __base=base, __tip=tip, __prior=prior)
        if only is not None:
            return _calibrate_frame_of_cell(cell, only, accept_implausible, verbose, as_json)
        return _calibrate_cell(cell, settings, accept_implausible, verbose, as_json)
    if not data or out is None:
        raise typer.BadParameter(f"expected {'--out DIR' if data else 'DATA'}, or a cell instead of a robot")
    chosen = settings.build()
    seen_by = chosen.cameras.files if chosen.cameras else ()
    check_folder(out, overwrite, inputs=(robot_file(robot), prior, *data, *seen_by))
    if only is not None:
        return _calibrate_frame(
            context,
            only,
            robot,
            base,
            tip,
            data,
            chosen,
            out,
            accept_implausible,
            overwrite,
            verbose,
            as_json,
        )
    nominal = Robot.load(robot, base, tip)
    if prior is not None:
        chosen.check_unused(WITH_PRIOR)
        again = RecalibrationSettings(cameras=chosen.cameras)
        return recalibrate_into(
            context,
            prior,
            data,
            again,
            out,
            accept_implausible,
            overwrite,
            as_json,
            verbose,
            fleet_robot=nominal,
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


def _calibrate_frame(
    context: typer.Context,
    only: FrameChoice,
    robot: str,
    base: str | None,
    tip: str | None,
    data: list[Path],
    settings: CalibrationSettings,
    out: Path,
    accept_implausible: bool,
    overwrite: bool,
    verbose: bool,
    as_json: bool,
) -> None:
    """Calibrate base, tool or both with the arm of a robot or model, write the model folder, and print it."""
    from pisigma.files.model_files import is_model
    from pisigma.robot.description import Robot
    from pisigma.workflow.frames.calibrate_frame import calibrate_frame

    settings.check_unused(_ARM_AS_GIVEN)
    arm = robot if is_model(Path(robot)) else Robot.load(robot, base, tip)
    calibration = calibrate_frame(arm, data, only, settings.cameras)
    command = command_line(context)
    with saved_model_folder(calibration, out, accept_implausible, overwrite, command=command) as folder:
        _print_frame(calibration, folder, verbose, as_json)


def _calibrate_frame_of_cell(
    cell: "Cell", only: FrameChoice, accept_implausible: bool, verbose: bool, as_json: bool
) -> None:
    """Calibrate base, tool or both with the newest session of a cell, store the model there, and print it."""
    from pisigma.workflow.frames.calibrate_frame import calibrate_frame_of_cell

    calibration, entry = calibrate_frame_of_cell(cell, only, accept_implausible)
    folder = None if entry is None else cell.model_folder(entry.name)
    _print_frame(calibration, folder, verbose, as_json, cell)
    if entry is None:
        raise AcceptanceError(_NOT_STORED)


def _print_frame(
    calibration: "FrameCalibration",
    folder: Path | None,
    verbose: bool,
    as_json: bool,
    cell: "Cell | None" = None,
) -> None:
    from pisigma.reporting.frame_text import frame_text

    if as_json:
        then = {} if cell is None else {"next": cell.status().step.to_json()}
        print_json({"model": folder and str(folder), **calibration.to_json(), **then})
    else:
        text = frame_text(calibration.summary, folder, calibration.seconds)
        print_result(text, verbose, [] if cell is None else next_step_lines(cell.status()))


def _calibrate_arms(
    cell: Path,
    settings: StatedSettings[CalibrationSettings],
    accept_implausible: bool,
    verbose: bool,
    as_json: bool,
) -> None:
    """Calibrate the arms of a cell, store their models and bases there, and print them."""
    from pisigma.reporting.frame_text import arms_text
    from pisigma.workflow.arms.calibrate_arms import calibrate_arms_of_cell

    with progress_of("calibrate") as progress:
        found, folder = calibrate_arms_of_cell(cell, progress, accept_implausible, **settings.values)
    if as_json:
        print_json({"folder": folder and str(folder), **found.to_json()})
    else:
        summaries = {name: one.summary for name, one in found.calibrations.items()}
        print_result(arms_text(found.summary, summaries, found.warnings, folder, found.seconds), verbose)
    if folder is None:
        raise AcceptanceError(_NOT_STORED)


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
        assert isinstance(calibration, Calibration)  # a cell has no prior of a fleet
        text = calibration_text(calibration.summary, folder, calibration.seconds)
        print_result(text, verbose, [*wrap_lines(remark), *next_step_lines(cell.status())])
    if entry is None:
        raise AcceptanceError(_NOT_STORED)
