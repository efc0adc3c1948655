"""`pisigma calibrate`: geometric or hybrid calibration of measured data."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pisigma.cli.arguments import (
    AcceptImplausible,
    AsJson,
    Overwrite,
    SocketDistance,
    complete_model,
    complete_robot,
    socket_distances,
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
from pisigma.files.errors import IdentificationError
from pisigma.measurement.camera.camera_files import CameraFiles

if TYPE_CHECKING:
    from pisigma.validation.held_out.calibration_summary import CalibrationSummary
    from pisigma.workflow.calibrate import CalibrationSettings

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
Model = Annotated[
    str,
    typer.Option(help="hybrid: geometry and, where the data are for it, a joint correction; or geometric."),
]
Folds = Annotated[
    int | None,
    typer.Option(min=0, help="Folds of the cross-validation; 0 for none. [default: 5, or one per placement]"),
]
HoldOut = Annotated[float | None, typer.Option(help="Share of the rows to hold out once, instead of folds.")]
Split = Annotated[
    str, typer.Option(help="How rows are split: joints (at random), interleaved, time, space or placement.")
]
Repeats = Annotated[
    int | None,
    typer.Option(
        min=1,
        help="Repeats of the cross-validation. [default: 200 / number of different joint values, 1 to 10]",
    ),
]
Jobs = Annotated[
    int | None,
    typer.Option(
        help="Processes that calibrate with all rows and with those of each fold side by side, with one thread each. "
        "[default: threads]"
    ),
]
Seed = Annotated[int, typer.Option(help="Seed of the split, and of drawing training rows.")]
TrainRows = Annotated[
    int | None,
    typer.Option(
        help="Number of rows, drawn at random, to calibrate with, in the cross-validation too. [default: all]"
    ),
]
Free = Annotated[
    str, typer.Option(help="Free parameters: identifiable, joint_offsets, or names such as a_2,theta_3.")
]
PriorMm = Annotated[
    float, typer.Option(help="Prior standard deviation of length errors [mm]; 0 for no prior.")
]
PriorMrad = Annotated[
    float, typer.Option(help="Prior standard deviation of angle errors [mrad]; 0 for no prior.")
]
RobotClassName = Annotated[
    str | None,
    typer.Option(
        "--class",
        help="How large errors of the geometry can be: industrial, cobot or hobby (also of old and surgical arms). "
        "[default: as the maker and the data say]",
    ),
]
Robust = Annotated[bool, typer.Option(help="Let rows that are far off count less.")]
Features = Annotated[
    str | None,
    typer.Option(
        help="Features of the joint correction that are tried, such as gravity,lines,series. [default: all that fit, "
        "and those of plug-ins]"
    ),
]
Gravity = Annotated[
    str | None,
    typer.Option(
        help="Direction in which things fall, in the robot's base frame, such as 0,0,-1. [default: the axis that the "
        "data show]"
    ),
]
NewFrameAt = Annotated[
    list[int] | None,
    typer.Option(
        metavar="LINE",
        help="Line of DATA from which on the rows are in a frame of their own, as the instrument was moved; may be "
        "repeated.",
    ),
]
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
    model: Model = "hybrid",
    folds: Folds = None,
    hold_out: HoldOut = None,
    split: Split = "joints",
    repeats: Repeats = None,
    jobs: Jobs = None,
    seed: Seed = 0,
    train_rows: TrainRows = None,
    free: Free = "identifiable",
    prior_mm: PriorMm = 1.0,
    prior_mrad: PriorMrad = 1.0,
    robot_class: RobotClassName = None,
    robust: Robust = True,
    features: Features = None,
    gravity: Gravity = None,
    new_frame_at: NewFrameAt = None,
    socket_distance: SocketDistance = None,
    cameras: CameraFiles | None = None,
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

    stated = cameras.files if cameras else ()
    check_folder(out, overwrite, inputs=(robot_file(robot), prior, *data, *stated))
    settings, nominal = _settings(context.params, cameras), Robot.load(robot, base, tip)
    if prior is not None:
        settings.check_unused()
        return recalibrate_into(
            context, prior, data, out, accept_implausible, overwrite, as_json, cameras, drawn=nominal
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


def _settings(options: Mapping[str, Any], cameras: CameraFiles | None) -> "CalibrationSettings":
    """Settings by the options of the command."""
    from pisigma.workflow.calibrate import CalibrationSettings

    same = (
        "model",
        "folds",
        "hold_out",
        "split",
        "repeats",
        "jobs",
        "seed",
        "train_rows",
        "robot_class",
        "robust",
    )
    return CalibrationSettings(
        free=_free(options["free"]),
        prior_length=options["prior_mm"] / 1e3,
        prior_angle=options["prior_mrad"] / 1e3,
        features=None if options["features"] is None else _names(options["features"]),
        gravity=_gravity(options["gravity"]),
        new_frame_at=tuple(options["new_frame_at"] or ()),
        socket_distances=socket_distances(options["socket_distance"]),
        cameras=cameras,
        **{name: options[name] for name in same},
    )


def _free(stated: str) -> Any:
    """Free parameters as the settings have them."""
    if stated in ("identifiable", "joint_offsets"):
        return stated
    return _names(stated)


def _names(stated: str) -> tuple[str, ...]:
    """Names with commas between."""
    return tuple(name.strip() for name in stated.split(","))


def _gravity(stated: str | None) -> Any:
    """Direction of gravity, from "X,Y,Z"."""
    try:
        direction = None if stated is None else tuple(map(float, stated.split(",")))
    except ValueError:
        direction = ()
    if direction is not None and len(direction) != 3:
        raise IdentificationError(
            f"the direction of gravity as X,Y,Z was wanted, such as 0,0,-1, got '{stated}'."
        )
    return direction
