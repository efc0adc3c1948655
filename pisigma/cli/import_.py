"""`pisigma import`: exports of instruments and controllers as a measurement file."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pisigma.cli.arguments import AsJson
from pisigma.cli.cell import print_next, settings_at
from pisigma.cli.endings import REFUSED, exit_with_error
from pisigma.cli.output import print_json, print_lines, print_table
from pisigma.cli.settings_options import StatedSettings, takes_settings
from pisigma.workflow.settings.importing import ImportSettings

if TYPE_CHECKING:
    from pisigma.workflow.cell.incoming_rows import IncomingRows
    from pisigma.workflow.import_rows import ImportProposal

Files = Annotated[list[Path], typer.Argument(help="Exported text tables, or a LeRobot data set.")]
Yes = Annotated[bool, typer.Option("--yes", "-y", help="Accept the proposed mapping without asking.")]
SaveMap = Annotated[Path | None, typer.Option(help="File to write the mapping to, for use with --map.")]


@takes_settings
def import_(
    files: Files,
    settings: StatedSettings[ImportSettings],
    out: Annotated[Path | None, typer.Option(help="Measurement file to write (.csv).")] = None,
    cell: Annotated[Path | None, typer.Option(help="Cell to which the rows are added as a session.")] = None,
    date: Annotated[
        str,
        typer.Option(
            help="Day of the session. [default: from the date column or the file name, otherwise today]"
        ),
    ] = "",
    accept_implausible: Annotated[
        bool, typer.Option("--accept-implausible", help="Add the rows even if they are implausible.")
    ] = False,
    yes: Yes = False,
    save_map: SaveMap = None,
    as_json: AsJson = False,
) -> None:
    """Import exports of instruments and controllers.

    Recognises encoding, separator, decimal sign, headings and units, shows the mapping of the columns and asks for
    confirmation. Without a terminal, exits with status 2 unless --yes or a complete --map is given.
    """
    from pisigma.files.output_file import check_output
    from pisigma.measurement.foreign.lerobot_dataset import is_lerobot_dataset
    from pisigma.workflow import import_rows as workflow
    from pisigma.workflow.cell.cell import Cell
    from pisigma.workflow.cell.incoming_rows import IncomingRows

    if (cell is None) is (out is None):
        raise typer.BadParameter("expected either --out FILE or --cell CELL", param_hint="'--out'")
    if out is not None:
        check_output(out, (".csv",), "a measurement file", files)
    if save_map is not None:
        check_output(save_map, (".yaml", ".yml"), "a mapping", [*files, *([] if out is None else [out])])
    chosen = settings.build() if cell is None else settings_at(cell, "import", settings)
    if out is not None and is_lerobot_dataset(files[0]):
        return _write_joint_log(files, chosen, out, as_json)
    if cell is not None:
        incoming = IncomingRows(tuple(files), Cell.open(cell), chosen)
        if not incoming.needs_no_conversion:
            _confirm(incoming.proposal, yes, as_json)
            if save_map is not None:
                incoming.proposal.save_map(save_map)
        return _take_in(incoming, date, accept_implausible, as_json)
    proposal = workflow.propose_import(files, chosen)
    _confirm(proposal, yes, as_json)
    rows = workflow.import_rows(proposal)
    assert out is not None  # there is no cell
    rows.save(out)
    if save_map is not None:
        proposal.save_map(save_map)
    if as_json:
        print_json({"file": str(out)} | rows.to_json())
        return
    print_lines([*rows.sentences, f"{rows.row_count} measurements written to {out}."])


def _write_joint_log(files: list[Path], settings: ImportSettings, out: Path, as_json: bool) -> None:
    """Write the joint values of a LeRobot data set."""
    from pisigma.measurement.foreign.lerobot_dataset import read_joint_log

    if len(files) > 1:
        raise typer.BadParameter("expected one LeRobot data set without other files", param_hint="'files'")
    log = read_joint_log(
        files[0], settings.lerobot_units, settings.lerobot_calibration, settings.lerobot_prefix
    )
    log.save(out)
    if as_json:
        print_json({"file": str(out)} | log.to_json())
        return
    columns = ", ".join(f"{motor} as q{number}_deg" for number, motor in enumerate(log.motors, start=1))
    lines = [f"{len(log.rows)} rows of joint values written to {out}: {columns}."]
    if log.left_out:
        lines.append(f"Values that are not positions of joints are left out: {', '.join(log.left_out)}.")
    print_lines(lines)


def _take_in(incoming: "IncomingRows", date: str, accept_implausible: bool, as_json: bool) -> None:
    """Add rows to a cell as a session."""
    if not as_json and incoming.imported_rows is not None:
        print_lines(incoming.imported_rows.sentences)
    entry, cell = incoming.add(accept_implausible, date), incoming.cell
    if as_json:
        print_json(
            {
                "session": entry.name,
                "rows": entry.rows,
                "day": entry.day,
                "next": cell.status().step.to_json(),
            }
        )
        return
    remark = [f"Remark: {entry.remark}"] if entry.remark else []
    print_lines([f"{entry.rows} rows added as session '{entry.name}'.", *remark])
    print_next(cell.status())


def _confirm(proposal: "ImportProposal", yes: bool, as_json: bool) -> None:
    """Show the mapping and ask for confirmation unless it was given; end with status 2 without a terminal."""
    if not as_json:
        for file in proposal.mappings:
            cells = [
                (column.heading, file.first_cell(column), column.target.text, column.reason)
                for column in file.columns
            ]
            print_table(file.title, ("column", "first value", "read as", "because of"), cells)
    if yes or proposal.is_stated:
        return
    if as_json:
        print_json({"file": None, "columns": proposal.columns_json()})
    elif _is_asked() and typer.confirm("Import these columns?"):
        return
    exit_with_error("nothing was imported: accept the mapping with --yes, or change it with --map.", REFUSED)


def _is_asked() -> bool:
    """Return whether there is a terminal for questions."""
    return sys.stdin.isatty()
