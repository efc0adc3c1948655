"""`pisigma calibrate`: geometric or hybrid calibration of measured data."""

from collections.abc import Iterator, Sequence
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
from pisigma.cli.cell import cell_at, next_lines, refuse_with_cell, report_overrides
from pisigma.cli.lifetime.recalibrate import recalibrate_into
from pisigma.cli.output import (
    command_line,
    print_json,
    saved,
)
from pisigma.cli.progress import progress_of
from pisigma.cli.screen import Block, print_screen, sentences, table
from pisigma.cli.settings_options import StatedOptions, takes_settings
from pisigma.files.errors import AcceptanceError
from pisigma.workflow.settings.calibration import CalibrationSettings
from pisigma.workflow.settings.recalibration import RecalibrationSettings

if TYPE_CHECKING:
    from pisigma.validation.held_out.calibration_summary import CalibrationSummary
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
        help="Start from this model folder of `pisigma fleet prior` where that predicts held-out rows better.",
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
    settings: CalibrationSettings,
    stated: StatedOptions,
    base: Base = None,
    tip: Tip = None,
    prior: Prior = None,
    accept_implausible: AcceptImplausible = False,
    overwrite: Overwrite = False,
    verbose: Verbose = False,
    as_json: AsJson = False,
) -> None:
    """Calibrate a robot from measurements and write a model folder with card and figures.

    Estimates geometry, base, tool and, where it predicts held-out rows better, a joint correction. Exits with status 3
    and writes no folder if the result must not be trusted.
    """
    from pisigma.files.output_folder import check_folder
    from pisigma.robot.description import Robot
    from pisigma.robot.robot_file import robot_file
    from pisigma.workflow import calibrate as workflow

    if (cell := cell_at(robot)) is not None:
        refuse_with_cell(DATA=data, __out=out, __base=base, __tip=tip, __prior=prior)
        return _calibrate_cell(cell, stated, accept_implausible, verbose, as_json)
    if not data or out is None:
        raise typer.BadParameter(f"expected {'--out DIR' if data else 'DATA'}, or a cell instead of a robot")
    seen_by = settings.cameras.files if settings.cameras else ()
    check_folder(out, overwrite, inputs=(robot_file(robot), prior, *data, *seen_by))
    nominal = Robot.load(robot, base, tip)
    if prior is not None:
        settings.check_unused()
        again = RecalibrationSettings(cameras=settings.cameras)
        return recalibrate_into(
            context, prior, data, again, out, accept_implausible, overwrite, as_json, verbose, drawn=nominal
        )
    with progress_of("calibrate") as progress:
        calibration = workflow.calibrate(nominal, data, settings, progress)
    with saved(calibration, out, accept_implausible, overwrite, command=command_line(context)) as folder:
        if as_json:
            print_json({"model": folder and str(folder), **calibration.to_json()})
        else:
            print_calibration(calibration.summary, folder, calibration.seconds, verbose)


def _calibrate_cell(
    cell: "Cell", stated: StatedOptions, accept_implausible: bool, verbose: bool, as_json: bool
) -> None:
    """Calibrate with the rows of a cell, store the model there, and print it."""
    with progress_of("calibrate") as progress:
        calibration, entry = cell.calibrate(
            progress, accept_implausible, **report_overrides(cell, "calibrate", stated)
        )
    folder = None if entry is None else cell.model_folder(entry.name)
    if as_json:
        print_json(
            {"model": folder and str(folder), **calibration.to_json(), "next": cell.status().step.to_json()}
        )
    else:
        remark = [f"Model '{entry.name}': {entry.remark}."] if entry is not None else []
        also = [sentences("the cell", [*remark, *next_lines(cell)])]
        print_calibration(calibration.summary, folder, calibration.seconds, verbose, also)
    if entry is None:
        raise AcceptanceError(
            "no model was stored, because the result must not be trusted, for the reasons above."
        )


def print_calibration(
    summary: "CalibrationSummary",
    folder: Path | None,
    seconds: float,
    verbose: bool = False,
    also: Sequence[Block] = (),
) -> None:
    """Print a calibration for people: the verdict, warnings, and errors of held-out rows.

    Args:
        summary: its figures.
        folder: where the model was written; None if it was not.
        seconds: time it took [s].
        verbose: print all tables and all parameters.
        also: what a command prints in addition.
    """
    from pisigma.reporting import calibration_tables as tables
    from pisigma.reporting.calibration_verdict import (
        POSSIBLE_SCALE,
        calibration_verdict,
        scale_error,
        scale_matters,
        scale_text,
    )

    warnings = [*tables.implausible_lines(summary)[1:], *tables.warning_lines(summary)]
    found = [one.sentence for one in summary.diagnostics if one.kind == "scale"]
    remarks = []
    if summary.scale is not None and found:
        warnings = [f"{one} {scale_error(summary.scale)}" if one in found else one for one in warnings]
    elif summary.scale is not None and scale_matters(summary):
        warnings = [scale_text(summary.scale), *warnings]
    elif summary.scale is not None and scale_matters(summary, POSSIBLE_SCALE):
        remarks = [scale_text(summary.scale)]
    written = f"Model written to {folder} in {seconds:.1f} s; its README.md has all figures."
    print_screen(
        calibration_verdict(summary, folder, len(warnings)),
        warnings,
        [*also, *_accuracy(summary), sentences("scale of the sensor", remarks)],
        [*_learned(summary), *_fit(summary), *_parameters(summary)],
        [] if folder is None else [written],
        verbose,
    )


def _accuracy(summary: "CalibrationSummary") -> Iterator[Block]:
    """Lay out the errors of rows that were held out, and what is to be said of them."""
    from pisigma.reporting import calibration_tables as tables
    from pisigma.reporting.calibration_verdict import error_table, how_held_out, of_what
    from pisigma.reporting.tables import distance_table

    judged = [one for one in (summary.cross_validation, summary.held_out, summary.test) if one is not None]
    for figures in judged:
        title = f"errors of {of_what(summary)}, {how_held_out(figures, summary)}"
        yield table(title, *error_table(figures), "errors of held-out rows")
        if figures.socket_distance is not None:
            what = "stated distances of sockets, under calibrations without them"
            yield table(what, *distance_table(figures.socket_distance), "distances of sockets")
        yield sentences("remarks on the held-out rows", tables.held_out_lines(figures))


def _learned(summary: "CalibrationSummary") -> Iterator[Block]:
    """Lay out the joint correction, and what else was tried."""
    from pisigma.reporting import calibration_tables as tables

    if summary.hybrid is not None:
        yield sentences("joint correction", tables.learned_lines(summary.hybrid))
        yield table("joint corrections that were tried", *tables.trial_table(summary.hybrid), "trials")
    if summary.judged is not None and (coverage := tables.coverage_line(summary.judged)):
        yield sentences("predicted intervals", [coverage])
    if summary.learning_curve is not None:
        what = "errors of held-out rows by number of training rows"
        yield table(what, *tables.curve_table(summary.learning_curve), "learning curve")


def _fit(summary: "CalibrationSummary") -> Iterator[Block]:
    """Lay out the errors of the rows that were calibrated with, and how the search ended."""
    from pisigma.reporting.calibration_verdict import error_table, how_held_out

    if summary.calibrated is not None:
        what = f"errors of the rows used in the calibration, {how_held_out(summary.calibrated, summary)}"
        yield table(what, *error_table(summary.calibrated), "errors of the fit")
    count = len(summary.outliers)
    worst = f"; the worst is {summary.outliers[0].place}" if count else ""
    line = f"Rank {summary.rank}, {summary.iterations} iterations, {count} outliers{worst}."
    yield sentences("outliers", [line])


def _parameters(summary: "CalibrationSummary") -> Iterator[Block]:
    """Lay out all parameters, and what the data cannot determine."""
    from pisigma.reporting.calibration_tables import parameter_table, undetermined_lines

    yield table("parameters", *parameter_table(summary.parameters), f"{len(summary.parameters)} parameters")
    lines = ["What these data cannot determine:", *(f"- {one}" for one in undetermined_lines(summary))]
    yield sentences("undetermined parameters", lines, "  ")
