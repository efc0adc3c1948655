"""`pisigma calibrate`: geometric or hybrid calibration of measured data."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pisigma.cli.arguments import (
    AcceptImplausible,
    AsJson,
    Overwrite,
    complete_model,
    complete_robot,
)
from pisigma.cli.lifetime.recalibrate import recalibrate_into
from pisigma.cli.output import (
    command_line,
    print_json,
    print_line,
    print_lines,
    print_table,
    progress_of,
    saved,
)
from pisigma.cli.settings_options import takes_settings
from pisigma.workflow.settings.calibration import CalibrationSettings
from pisigma.workflow.settings.recalibration import RecalibrationSettings

if TYPE_CHECKING:
    from pisigma.validation.held_out.calibration_summary import CalibrationSummary

RobotName = Annotated[
    str,
    typer.Argument(
        metavar="ROBOT", help="Catalogue name or robot file (YAML or URDF).", autocompletion=complete_robot
    ),
]
Data = Annotated[
    list[Path], typer.Argument(metavar="DATA...", help="Measurements (CSV), in one file or several.")
]
Out = Annotated[Path, typer.Option(help="Model folder to write.")]
Base = Annotated[str | None, typer.Option(help="Of a URDF file: link that is the base. [default: its root]")]
Tip = Annotated[
    str | None, typer.Option(help="Of a URDF file: link that is the tool. [default: its only leaf]")
]
Prior = Annotated[
    Path | None,
    typer.Option(
        help="Model folder of `pisigma fleet prior` to begin with; left-out rows decide whether it helps. "
        "Options that say how to calibrate or to validate do not go with it.",
        autocompletion=complete_model,
    ),
]
Verbose = Annotated[bool, typer.Option("--verbose", help="Print all parameters.")]


@takes_settings
def calibrate(
    context: typer.Context,
    robot: RobotName,
    data: Data,
    out: Out,
    settings: CalibrationSettings,
    base: Base = None,
    tip: Tip = None,
    prior: Prior = None,
    accept_implausible: AcceptImplausible = False,
    overwrite: Overwrite = False,
    verbose: Verbose = False,
    as_json: AsJson = False,
) -> None:
    """Calibrate a robot from measurements and write it as a model folder with card and figures.

    Geometry, base and tool, and with them a correction of the joints where it predicts left-out rows better. Exit
    status 3, and no folder, where the result must not be trusted.
    """
    from pisigma.files.output_folder import check_folder
    from pisigma.robot.description import Robot
    from pisigma.robot.robot_file import robot_file
    from pisigma.workflow import calibrate as workflow

    seen_by = settings.cameras.files if settings.cameras else ()
    check_folder(out, overwrite, inputs=(robot_file(robot), prior, *data, *seen_by))
    nominal = Robot.load(robot, base, tip)
    if prior is not None:
        settings.check_unused()
        again = RecalibrationSettings(cameras=settings.cameras)
        return recalibrate_into(
            context, prior, data, again, out, accept_implausible, overwrite, as_json, drawn=nominal
        )
    with progress_of("calibrate") as progress:
        calibration = workflow.calibrate(nominal, data, settings, progress)
    with saved(calibration, out, accept_implausible, overwrite, command=command_line(context)) as folder:
        if as_json:
            print_json({"model": folder and str(folder), **calibration.to_json()})
        else:
            print_calibration(calibration.summary, folder, calibration.seconds, verbose)


def print_calibration(
    summary: "CalibrationSummary", folder: Path | None, seconds: float, verbose: bool = False
) -> None:
    """Print for people what a calibration gave: accuracy and verdict first, then parameters.

    Args:
        summary: its figures.
        folder: where the model was written; None where it was not.
        seconds: time it took [s].
        verbose: print all parameters, not only those that were estimated.
    """
    from pisigma.reporting import calibration_tables as tables

    print_lines(f"Implausible: {line}" for line in tables.implausible_lines(summary))
    _print_accuracy(summary)
    if summary.hybrid is not None:
        print_lines(tables.learned_lines(summary.hybrid))
    print_lines(f"Warning: {line}" for line in tables.warning_lines(summary))
    if summary.learning_curve is not None:
        print_table(
            "errors of held-out rows by number of training rows", *tables.curve_table(summary.learning_curve)
        )
    if summary.hybrid is not None:
        print_table("what was tried beyond the geometry", *tables.trial_table(summary.hybrid))
    _print_parameters(summary, verbose)
    count = len(summary.outliers)
    worst = f"; the worst is {summary.outliers[0].place}" if count else ""
    print_lines([f"Rank {summary.rank}, {summary.iterations} iterations, {count} outliers{worst}."])
    if folder is not None:
        print_lines([f"Model written to {folder} in {seconds:.1f} s; read its README.md."])


def _print_accuracy(summary: "CalibrationSummary") -> None:
    """Print the errors of held-out rows, and then of those that were calibrated with."""
    from pisigma.reporting import calibration_tables as tables
    from pisigma.reporting.tables import distance_table, pose_rows

    if summary.predicted_rms_mm is not None:
        print_lines([tables.predicted_line(summary.predicted_rms_mm)])
    for figures, title in (
        (summary.held_out, "pose errors of {rows} other simulated rows"),
        (summary.cross_validation, "pose errors of {rows} held-out rows ({how})"),
        (summary.test, "pose errors of the {rows} rows of the set 'test', which were kept apart"),
        (summary.calibrated, "pose errors of the {rows} rows that were calibrated with"),
    ):
        if figures is not None:
            title = title.format(rows=figures.rows, how=tables.folds_text(figures))
            print_table(title, *pose_rows(figures.models))
            print_lines([*tables.held_out_lines(figures), *filter(None, [tables.coverage_line(figures)])])
            if figures.socket_distance is not None:
                what = "stated distances of sockets, under calibrations without them"
                print_table(what, *distance_table(figures.socket_distance))


def _print_parameters(summary: "CalibrationSummary", verbose: bool) -> None:
    """Print the parameters that were estimated, or all, and what the data cannot determine."""
    from pisigma.reporting.calibration_tables import parameter_table, undetermined_lines

    estimated = [row for row in summary.parameters if verbose or row.standard_error is not None]
    rest = len(summary.parameters) - len(estimated)
    title = f"estimated parameters ({rest} others are nominal: --verbose)" if rest else "parameters"
    print_table(title, *parameter_table(estimated))
    print_line("What these data cannot determine:")
    print_lines((f"- {line}" for line in undetermined_lines(summary)), indent="  ")
