"""What the commands print: tables for people on stdout, one JSON object, one line for a problem."""

import functools
import json
from collections.abc import Callable, Sequence
from typing import Any

import typer

from pisigma.errors import AcceptanceError, PisigmaError

WIDTH_WITHOUT_TERMINAL = 120

NOT_ACCEPTED = 3
"""Exit status of a model that does not meet its limits."""

_INTERRUPTED = 130


def print_json(result: Any) -> None:
    """Print one JSON object on stdout; what is no number has to be None, as JSON has no NaN."""
    typer.echo(json.dumps(result, allow_nan=False))


def print_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table; columns that hold numbers are set right, and no cell is cut or wrapped."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(box=SIMPLE_HEAD, padding=(0, 1), pad_edge=False, collapse_padding=True)
    for index, column in enumerate(columns):
        number = index > 0 and all(_is_number(row[index]) for row in rows)
        table.add_column(Text(column), justify="right" if number else "left", no_wrap=True)
    for row in rows:
        table.add_row(*(Text(cell) for cell in row))
    console = Console(highlight=False)
    width = console.width if console.is_terminal else WIDTH_WITHOUT_TERMINAL
    widest = console.measure(table, options=console.options.update(max_width=10_000)).maximum
    console.width = max(width, widest)
    console.print(Text(title), soft_wrap=True)
    console.print(table)


def tell_problems(command: Callable[..., None]) -> Callable[..., None]:
    """Make a command end with one line on stderr and a status that says whose fault it is.

    2 where the user's input is at fault, 3 where a model does not meet the limits that were set.
    """

    @functools.wraps(command)
    def told(*args: Any, **kwargs: Any) -> None:
        try:
            command(*args, **kwargs)
        except AcceptanceError as problem:
            fail(str(problem), NOT_ACCEPTED)
        except PisigmaError as problem:
            fail(str(problem))
        except KeyboardInterrupt:
            typer.echo("pisigma: interrupted; nothing was left half written.", err=True)
            raise typer.Exit(_INTERRUPTED) from None

    return told


def fail(sentence: str, status: int = 2) -> None:
    """Say what is wrong in one line on stderr and end with an exit status."""
    typer.echo(f"pisigma: {' '.join(sentence.split())}", err=True)
    raise typer.Exit(status) from None


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True
