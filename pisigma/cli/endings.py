"""How a command ends: its exit status, and a message on stderr if there is a problem."""

import contextlib
import errno
import functools
import inspect
import os
import shutil
import sys
import textwrap
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from pisigma.cli.help import HelpAll
from pisigma.cli.output import print_json
from pisigma.files.errors import (
    AcceptanceError,
    PisigmaError,
    make_printable,
    missing_extra,
    system_problem_text,
)
from pisigma.files.plugins import load_files, load_installed

REFUSED = 2
"""Exit status if the user's input is invalid."""
NOT_ACCEPTED = 3
"""Exit status if a model does not meet its limits, or must not be trusted."""
DEFECT = 1
"""Exit status of a defect of pisigma."""
TRACEBACK = "PISIGMA_TRACEBACK"
"""Environment variable; if it is set, Python's traceback is printed after a defect."""

_INTERRUPTED = 130
_NO_READER = 141
"""Status that shells report for a program that SIGPIPE has ended, as in `pisigma robots | head -1`."""


PluginFiles = Annotated[
    list[Path] | None,
    typer.Option(
        "--plugin",
        metavar="FILE",
        help="Python file of plug-ins, run with your permissions. It can register sensors, features or other "
        "extensions. May be repeated.",
    ),
]


def report_problems(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command that loads plug-ins, shows its full help, and reports failures by message and exit status.

    The command gets the options `--plugin` and `--help-all`. See `exit_with_problem` for the exit status.
    """

    @functools.wraps(command)
    def guarded(*, plugin: PluginFiles = None, help_all: HelpAll = False, **values: Any) -> None:
        try:
            load_installed()
            load_files(plugin or ())
            command(**values)
        except (typer.BadParameter, typer.Exit):
            raise  # the command line itself reports these exceptions
        except (Exception, KeyboardInterrupt) as problem:
            exit_with_problem(problem, as_json=bool(values.get("as_json")))

    keyword = inspect.Parameter.KEYWORD_ONLY
    parameters = [
        *inspect.signature(command).parameters.values(),
        inspect.Parameter("plugin", keyword, default=None, annotation=PluginFiles),
        inspect.Parameter("help_all", keyword, default=False, annotation=HelpAll),
    ]
    vars(guarded)["__signature__"] = inspect.Signature([one.replace(kind=keyword) for one in parameters])
    guarded.__annotations__ = {one.name: one.annotation for one in parameters}
    return guarded


def exit_with_problem(problem: BaseException, as_json: bool = False) -> None:
    """Print the error, and end the command with an exit status.

    The status is 2 if the user's input is invalid, 3 if a model does not meet its limits, 130 after an interruption,
    141 if the reader of the output has ended, and 1 for everything else.

    Args:
        problem: the exception that ended the command.
        as_json: also print the fields of a refused input on stdout, as a JSON object with the key `error`. If a
            model does not meet its limits, the whole result is already printed there.
    """
    if isinstance(problem, AcceptanceError):
        exit_with_error(str(problem), NOT_ACCEPTED)
    if isinstance(problem, PisigmaError):
        if as_json:
            print_json({"error": problem.fields()})
        exit_with_error(str(problem))
    if isinstance(problem, ImportError) and (missing := missing_extra(problem)) is not None:
        exit_with_error(str(missing))
    if isinstance(problem, KeyboardInterrupt):
        exit_with_error("interrupted; nothing was left half written.", _INTERRUPTED)
    if fault := system_problem_text(problem):
        exit_with_error(fault)
    if isinstance(problem, OSError) and problem.errno in (errno.EPIPE, errno.ENOSPC, errno.EIO, errno.EFBIG):
        _print_no_more()
        if problem.errno == errno.EPIPE:
            raise typer.Exit(_NO_READER)
        exit_with_error(f"cannot write to standard output ({problem.strerror}); redirect it to another file.")
    if os.environ.get(TRACEBACK):
        raise problem
    exit_with_error(_defect(problem), DEFECT)


def exit_with_error(sentence: str, status: int = REFUSED) -> NoReturn:
    """Print the error on stderr, in one line that is wrapped on a terminal, and end with an exit status."""
    line = f"pisigma: {make_printable(' '.join(sentence.split()))}"
    if sys.stderr.isatty():
        width = shutil.get_terminal_size().columns
        line = textwrap.fill(
            line, width, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False
        )
    with contextlib.suppress(OSError):  # stderr is closed, so nobody can read the message
        typer.echo(line, err=True)
    raise typer.Exit(status) from None


def _defect(problem: BaseException) -> str:
    """Return a sentence about an unexpected problem."""
    frame = traceback.extract_tb(problem.__traceback__)[-1]
    return (
        f"a defect in pisigma ended the command ({type(problem).__name__}: {problem}; {Path(frame.filename).name}, "
        f"line {frame.lineno}). Nothing was left half written. Please report it with the command and its files; "
        f"{TRACEBACK}=1 before the command shows where it happened."
    )


def _print_no_more() -> None:
    """Discard the remaining output, because Python would report the closed stream again when it exits."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
