"""The `pisigma` command."""

import sys
from typing import Annotated

import typer

from pisigma import __version__
from pisigma.cli.evaluate import evaluate
from pisigma.cli.ik import ik
from pisigma.cli.robots import robots
from pisigma.cli.simulate import simulate
from pisigma.cli.train import train
from pisigma.errors import PisigmaError

app = typer.Typer(
    name="pisigma",
    help="Robot calibration: learn a robot's errors from measurements and command joints that really reach the pose.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
for command in (robots, simulate, train, evaluate, ik):
    app.command()(command)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"pisigma {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version.")] = False,
) -> None:
    """Robot calibration and corrected inverse kinematics."""


def run() -> None:
    """Run the command line; a `PisigmaError` becomes one line on stderr and exit status 2."""
    try:
        app()
    except PisigmaError as problem:
        print(f"pisigma: {problem}", file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        print("pisigma: interrupted; nothing was left half written.", file=sys.stderr)
        raise SystemExit(130) from None
