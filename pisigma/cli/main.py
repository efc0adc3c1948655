"""The `pisigma` command."""

import io
import os
import sys
from typing import Annotated

import typer

from pisigma import __version__
from pisigma.cli.calibrate import calibrate
from pisigma.cli.cell import event, pack, session, status, unpack, use
from pisigma.cli.endings import exit_with_problem, report_problems
from pisigma.cli.evaluate import evaluate
from pisigma.cli.export import export
from pisigma.cli.fleet.commands import fleet
from pisigma.cli.fleet.new import new
from pisigma.cli.help import ShortHelpCommand
from pisigma.cli.ik.command import ik
from pisigma.cli.images.camera import camera
from pisigma.cli.images.detect import detect
from pisigma.cli.import_ import import_
from pisigma.cli.lifetime.compare import compare
from pisigma.cli.lifetime.monitor import monitor
from pisigma.cli.lifetime.recalibrate import recalibrate
from pisigma.cli.measure.command import measure
from pisigma.cli.plan import plan
from pisigma.cli.report import report
from pisigma.cli.robots import robots
from pisigma.cli.serve.command import serve
from pisigma.cli.serve.open_ import open_
from pisigma.cli.simulate import simulate
from pisigma.cli.training.distill import distill
from pisigma.cli.training.train import train
from pisigma.cli.upgrade import upgrade
from pisigma.cli.verify import verify

app = typer.Typer(
    name="pisigma",
    help="Calibrate robots from measurements and compute joint values that reach the requested pose.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
for command in (
    new,
    status,
    open_,
    robots,
    simulate,
    plan,
    measure,
    import_,
    camera,
    detect,
    calibrate,
    recalibrate,
    monitor,
    compare,
    train,
    evaluate,
    report,
    ik,
    serve,
    distill,
    export,
    verify,
    upgrade,
    use,
    session,
    event,
    pack,
    unpack,
):
    app.command(command.__name__.rstrip("_"), cls=ShortHelpCommand)(report_problems(command))
app.add_typer(fleet)


def _show_version(value: bool) -> None:
    if value:
        typer.echo(f"pisigma {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Robot calibration and corrected inverse kinematics."""


def run() -> None:
    """Run the command line.

    Exits with status 0 on success, 2 if the input is at fault, 3 if limits are not met, and 1 for a defect of pisigma.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(
            stream, io.TextIOWrapper
        ):  # characters that the terminal cannot show must not cause an error
            stream.reconfigure(errors="backslashreplace")
    # Waiting threads are put to sleep soon: if they keep spinning while other processes run, both become many times
    # slower.
    os.environ.setdefault("GOMP_SPINCOUNT", "2000")
    try:
        try:
            app()
        except Exception as problem:  # ended by the command line itself, or by its help
            exit_with_problem(problem)
    except typer.Exit as end:
        sys.exit(end.exit_code)
