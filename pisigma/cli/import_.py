"""`pisigma import`: what instruments and controllers export, as a measurement file."""

import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from pisigma.cli.arguments import AsJson
from pisigma.cli.endings import REFUSED, fail
from pisigma.cli.output import print_json, print_lines, print_table

if TYPE_CHECKING:
    from pisigma.workflow.import_rows import ImportProposal

Files = Annotated[list[Path], typer.Argument(help="Exports: tables as text, in any encoding.")]
Map = Annotated[
    str | None,
    typer.Option(
        "--map",
        help='What columns are: "A1=q1_deg,X=x_mm,note=-" by headings or numbers, or a file of --save-map.',
    ),
]
Unit = Annotated[
    str, typer.Option(help="Units of columns for which the file states none, such as mm,deg or m,rad.")
]
Rotation = Annotated[
    str | None,
    typer.Option(help="Maker whose rotations these are, such as kuka or ur; none leaves them out."),
]
DecimalSign = Annotated[
    Literal["point", "comma"] | None, typer.Option(help="Sign before decimals. [default: by the cells]")
]
Join = Annotated[
    Literal["point", "order", "time"] | None,
    typer.Option(help="Put joint values of one file and measurements of another together."),
]
Within = Annotated[str, typer.Option(help="Time stamps that --join time puts together differ by no more.")]
Yes = Annotated[bool, typer.Option("--yes", "-y", help="Take the proposed mapping without asking.")]
SaveMap = Annotated[Path | None, typer.Option(help="File to write the mapping to, for --map the next time.")]
_SIGNS: dict[str | None, Literal[".", ","] | None] = {None: None, "point": ".", "comma": ","}


def import_(
    files: Files,
    out: Annotated[Path, typer.Option(help="Measurement file to write (.csv).")],
    mapping: Map = None,
    unit: Unit = "",
    rotation: Rotation = None,
    decimal: DecimalSign = None,
    join: Join = None,
    within: Within = "0.2s",
    yes: Yes = False,
    save_map: SaveMap = None,
    as_json: AsJson = False,
) -> None:
    """Import what instruments and controllers export.

    Encoding, separator, decimal sign, headings and units are recognised; the mapping of the columns is shown, and asked
    about on a terminal. Without one, exit status 2 unless --yes is there or --map says what every column is.
    """
    from pisigma.files.output_file import check_output
    from pisigma.measurement.foreign.saved_map import parse_map
    from pisigma.workflow import import_rows as workflow

    check_output(out, (".csv",), "a measurement file", files)
    if save_map is not None:
        check_output(save_map, (".yaml", ".yml"), "a mapping", [*files, out])
    settings = workflow.ImportSettings(
        parse_map(mapping) if mapping else (), unit, rotation, _SIGNS[decimal], join, _seconds(within)
    )
    proposal = workflow.propose_import(files, settings)
    _confirm(proposal, yes, as_json)
    rows = workflow.import_rows(proposal)
    rows.save(out)
    if save_map is not None:
        proposal.save_map(save_map)
    if as_json:
        print_json({"file": str(out)} | rows.to_json())
        return
    print_lines([*rows.sentences, f"{rows.rows} measurements written to {out}."])


def _seconds(text: str) -> float:
    """Seconds of a duration such as 0.2s or 200ms."""
    match = re.fullmatch(r"\s*([0-9]*\.?[0-9]+)\s*(s|ms)?\s*", text)
    if match is None:
        fail(f"--within {text}: a duration was wanted, such as 0.2s or 200ms.")
    return float(match[1]) * (1e-3 if match[2] == "ms" else 1.0)


def _confirm(proposal: "ImportProposal", yes: bool, as_json: bool) -> None:
    """Show the mapping and ask, unless it is stated or accepted; end with 2 where nobody can be asked."""
    if not as_json:
        for file in proposal.mappings:
            cells = [
                (column.heading, file.example(column), column.target.text, column.reason)
                for column in file.columns
            ]
            print_table(file.title, ("column", "first value", "read as", "because of"), cells)
    if yes or proposal.is_stated:
        return
    if as_json:
        print_json({"file": None, "columns": proposal.columns_json()})
    elif _is_asked() and typer.confirm("Import these columns?"):
        return
    fail("nothing was imported: accept the mapping with --yes, or change it with --map.", REFUSED)


def _is_asked() -> bool:
    """Whether somebody can be asked."""
    return sys.stdin.isatty()
