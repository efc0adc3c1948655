"""Output of commands: tables and sentences for people on stdout, or one JSON object.

The contents of files reach a terminal as text only: see `pisigma.files.errors.make_printable`.
"""

import json
import shlex
import textwrap
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import typer

from pisigma.files.errors import AcceptanceError, make_printable

if TYPE_CHECKING:
    from rich.table import Table

    from pisigma.workflow.result import AbstractModelResult

_WIDTH_WITHOUT_TERMINAL = 80

_ONLY_FOR_PRINTING = ("as_json", "verbose", "help_all")


def print_json(result: Any) -> None:
    """Print a JSON object on stdout; unknown numbers must be None, because JSON has no NaN."""
    typer.echo(json.dumps(result, allow_nan=False))


def print_line(line: str, to_stderr: bool = False) -> None:
    """Print a line without wrapping it; control characters are made visible."""
    typer.echo(make_printable(line, cut=False), err=to_stderr)


def print_lines(lines: Iterable[str], indent: str = "") -> None:
    """Print sentences, each wrapped to the width of the screen; continuation lines are indented."""
    for line in wrap_lines(lines, indent):
        typer.echo(line)


def wrap_lines(lines: Iterable[str], indent: str = "") -> list[str]:
    """Wrap sentences to the width of the screen; continuation lines are indented."""
    width = screen_width()
    return [
        part
        for line in lines
        for part in textwrap.wrap(
            make_printable(line, cut=False),
            width,
            subsequent_indent=indent,
            break_long_words=False,
            break_on_hyphens=False,  # file names are not divided
        )
    ]


def print_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table; see `table_lines`."""
    for line in table_lines(title, columns, rows):
        typer.echo(line)


def table_lines(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table: numbers are aligned right, and headings and texts wrapped on narrow screens.

    Numbers and words are never cut, so a table may be wider than the screen.
    """
    from rich.box import SIMPLE_HEAD
    from rich.table import Table
    from rich.text import Text

    rows = [[make_printable(cell, cut=False) for cell in row] for row in rows]
    cells = list(zip(*rows, strict=True)) or [()] * len(columns)
    width, gaps = screen_width(), 2 * len(columns)
    widest = sum(max(map(len, (column, *texts))) for column, texts in zip(columns, cells, strict=True))
    table = Table(box=SIMPLE_HEAD, padding=(0, 1), pad_edge=False, collapse_padding=True, show_edge=False)
    narrowest = gaps
    for index, (column, texts) in enumerate(zip(columns, cells, strict=True)):
        number = index > 0 and all(_is_number(text) for text in texts)
        longest = max((len(word) for text in (column, *texts) for word in text.split()), default=0)
        if widest + gaps > width and number:
            column = textwrap.fill(column, longest)
        justify: Literal["right", "left"] = "right" if number else "left"
        table.add_column(Text(column), justify=justify, no_wrap=number, min_width=longest)
        narrowest += longest
    for row in rows:
        table.add_row(*(Text(cell) for cell in row))
    return [*wrap_lines([title]), *_rich_lines(table, max(width, narrowest)), ""]


@contextmanager
def saved_model_folder(
    result: "AbstractModelResult", folder: Path, accept_implausible: bool, overwrite: bool, **texts: str
) -> Iterator[Path | None]:
    """Write a result as a model folder, and yield the folder for printing; None if it was not written.

    Args:
        result: result with its diagnostics.
        folder: folder to write.
        accept_implausible: write it even if it must not be trusted.
        overwrite: replace the model in the folder.
        texts: name and command, see `AbstractModelResult.save`.

    Raises:
        AcceptanceError: at the end, if it must not be trusted.
    """
    try:
        result.save(folder, accept_implausible=accept_implausible, overwrite=overwrite, **texts)
    except AcceptanceError:
        yield None
        raise
    yield folder


def screen_width() -> int:
    """Return the width of the terminal, or 80 without one."""
    from rich.console import Console

    console = Console()
    return console.width if console.is_terminal else _WIDTH_WITHOUT_TERMINAL


def command_line(context: typer.Context, files: Collection[str] = ("out",)) -> str:
    """Return the running command for cards; folders of files, and options with their defaults, are left out.

    Args:
        context: context of the command.
        files: names of the options whose values are files or folders; all arguments may be.
    """
    above: Any = context.parent
    groups = [] if above is None or above.parent is None else [str(above.info_name)]
    words = ["pisigma", *groups, str(context.info_name)]
    for parameter in context.command.params:
        value = context.params.get(str(parameter.name))
        if parameter.param_type_name == "argument":
            words += [Path(str(one)).name for one in (value if isinstance(value, list) else [value])]
        elif value != parameter.default and parameter.name not in _ONLY_FOR_PRINTING:
            if isinstance(value, bool):
                words.append((parameter.opts if value else parameter.secondary_opts)[0])
            elif getattr(parameter, "multiple", False):
                named = [Path(one).name if isinstance(one, Path) else str(one) for one in value or ()]
                words += [word for name in named for word in (parameter.opts[0], name)]
            elif isinstance(value, tuple):
                words += [parameter.opts[0], *(f"{number:g}" for number in value)]
            else:
                text = Path(str(value)).name if parameter.name in files else str(value)
                words += [parameter.opts[0], text]
    return make_printable(shlex.join(words), cut=False)


def _rich_lines(table: "Table", width: int) -> list[str]:
    """Lay out a table as text: rich's own printing ends the process if the output has no reader."""
    from rich.console import Console

    console = Console(highlight=False)
    console.width = width
    with console.capture() as printed:
        console.print(table)
    return [line.rstrip() for line in printed.get().splitlines()]


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return not cell
    return True
