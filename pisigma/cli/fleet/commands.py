"""`pisigma fleet run`, `status` and `prior`: all cells in a folder with one command."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pisigma.cli.arguments import AsJson, Overwrite, Verbose
from pisigma.cli.endings import NOT_ACCEPTED, report_problems
from pisigma.cli.help import ShortHelpCommand
from pisigma.cli.output import command_line, print_json
from pisigma.cli.progress import progress_of
from pisigma.cli.screen import print_screen
from pisigma.cli.settings_options import takes_settings
from pisigma.reporting.result_text import sentence_block, table_block
from pisigma.workflow.settings.fleet import FleetSettings

if TYPE_CHECKING:
    from pisigma.lifetime.fleet.status import FleetStatus
    from pisigma.workflow.fleet.prior import FleetPriorResult
    from pisigma.workflow.fleet.run import FleetRun

_SHOWN = 10
"""Largest number of cells in a table."""

Folder = Annotated[
    Path, typer.Argument(metavar="FOLDER", help="Folder of cells; `pisigma new --from MANIFEST` creates one.")
]
PriorOut = Annotated[Path, typer.Option("--out", help="Model folder to write.")]
Page = Annotated[Path | None, typer.Option(help="HTML page to write, with filters by state and name.")]

fleet = typer.Typer(name="fleet", help="Calibrate and monitor all cells in a folder.", no_args_is_help=True)


@fleet.command(cls=ShortHelpCommand)
@report_problems
@takes_settings
def run(folder: Folder, settings: FleetSettings, as_json: AsJson = False) -> None:
    """Calibrate, verify, monitor and recalibrate all cells in a folder, as the status of each requires.

    Writes FOLDER/results.parquet, one row per check. After an interruption, the next run continues where it
    stopped. Names the cells that need attention, and exits with status 3 if there are any.
    """
    from pisigma.workflow.fleet.run import run_fleet

    with progress_of("fleet") as progress:
        result = run_fleet(folder, settings, progress)
    if as_json:
        print_json(result.to_json())
    else:
        _print_run(result)
    if result.refused:
        raise typer.Exit(NOT_ACCEPTED)


@fleet.command("prior", cls=ShortHelpCommand)
@report_problems
def estimate_prior(
    context: typer.Context,
    folder: Folder,
    out: PriorOut,
    overwrite: Overwrite = False,
    verbose: Verbose = False,
    as_json: AsJson = False,
) -> None:
    """Estimate what robots of one type have in common, from the first valid session of each cell.

    Writes a model folder for `pisigma calibrate --prior DIR` and `pisigma plan DIR`.
    """
    from pisigma.files.output_folder import check_folder
    from pisigma.workflow.fleet.prior import estimate_fleet_prior

    check_folder(out, overwrite, inputs=(folder,))
    with progress_of("fleet prior") as progress:
        result = estimate_fleet_prior(folder, progress)
    result.save(out, command=command_line(context), overwrite=overwrite)
    if as_json:
        print_json({"model": str(out), **result.to_json()})
        return
    _print_prior(result, out, verbose)


@fleet.command(cls=ShortHelpCommand)
@report_problems
def status(folder: Folder, page: Page = None, verbose: Verbose = False, as_json: AsJson = False) -> None:
    """Summarise all cells in a folder: their states, the largest errors, and what to do.

    Exits with status 3 if a cell needs attention, or if `pisigma fleet run` has steps to carry out.
    """
    if show_fleet(folder, page, verbose, as_json).needs_action:
        raise typer.Exit(NOT_ACCEPTED)


def show_fleet(
    folder: Path, page: Path | None = None, verbose: bool = False, as_json: bool = False
) -> "FleetStatus":
    """Print the status of all cells in a folder, and write it as a page.

    Args:
        folder: folder of the cells.
        page: HTML file to write; None to write none.
        verbose: print all tables.
        as_json: print one JSON object.
    """
    from pisigma.files.output_file import check_output, write_atomically
    from pisigma.lifetime.fleet.status import FleetStatus

    if page is not None:
        check_output(page, (".html", ".htm"), "a page", (folder / "results.parquet",))
    seen = FleetStatus.read(folder)
    if page is not None:
        from pisigma.reporting.page.lifetime import fleet_page

        write_atomically(page, fleet_page(seen, page.parent))
    if as_json:
        print_json(seen.to_json())
    else:
        _print_status(seen, page, verbose)
    return seen


def _print_prior(result: "FleetPriorResult", out: Path, verbose: bool) -> None:
    """Print the prior of a fleet: what its robots have in common."""
    from pisigma.reporting.derived_cards import UNDETERMINED, common_error_table, weight_spread_table
    from pisigma.reporting.verdict import Verdict, count_text

    summary = result.summary
    warnings = len(summary.warnings)
    verdict = Verdict(
        f"common errors of {count_text(summary.robots, 'robot')}, in "
        f"{count_text(len(summary.parameters), 'parameter')}.",
        f"with caution ({count_text(warnings, 'warning')})." if warnings else "yes, for robots of this type.",
        f"calibrate a robot of this type with few poses: `pisigma calibrate ROBOT ROWS.csv --prior {out} --out DIR`.",
        "Prior",
    )
    print_screen(
        verdict,
        summary.warnings,
        [table_block("joint correction", *weight_spread_table(summary))],
        [
            table_block(
                f"parameters that {summary.robots} robots have in common", *common_error_table(summary)
            ),
            sentence_block("undetermined parameters", [UNDETERMINED]),
        ],
        [f"Model written to {out} in {result.seconds:.1f} s; its README.md has all figures."],
        verbose,
    )


def _print_run(result: "FleetRun") -> None:
    """Print the number of cells that are done, and the reasons why others need attention."""
    from pisigma.reporting.verdict import Verdict, count_text

    refused, folder = len(result.refused), result.results.parent
    unchanged = f"; nothing was due in {result.unchanged}" if result.unchanged else ""
    verdict = Verdict(
        f"{result.cells_not_refused} of {count_text(result.cells, 'cell')} are done{unchanged}; "
        f"{result.seconds:.1f} s.",
        f"no: {count_text(refused, 'cell')} need attention."
        if refused
        else "see `pisigma fleet status` for the errors of each robot.",
        f"{'correct the problems named below and run it again' if refused else 'see the summary'}: `pisigma fleet "
        f"status {folder}`.",
        "Done",
    )
    lines = [f"{cell}: {reason}" for cell, reason in result.refused]
    print_screen(verdict, lines, closing_sentences=[f"Results written to {result.results}."])


def _print_status(seen: "FleetStatus", page: Path | None, verbose: bool) -> None:
    """Print the number of cells in every state, the largest error, and what to do."""
    from pisigma.lifetime.cell.step import ATTENTION
    from pisigma.reporting.fleet_tables import ERRORS_NOTE, cell_table, fleet_verdict, state_table

    worst, few = [one for one, _ in seen.sorted_by_error], len(seen.cells) <= _SHOWN
    warned = [f"{one.name}: {one.step.reason}" for one in seen.cells if one.step.state in ATTENTION]
    warned += [f"{name}: {reason}" for name, reason in seen.unreadable.items()]
    print_screen(
        fleet_verdict(seen),
        warned,
        [
            table_block(
                f"{len(seen.cells) + len(seen.unreadable)} cells in {seen.folder}", *state_table(seen)
            ),
            table_block("cells", *cell_table(seen.cells))
            if few
            else table_block("largest errors", *cell_table(worst[:_SHOWN])),
        ],
        [
            table_block("all cells", *cell_table([] if few else seen.cells)),
            sentence_block("meaning of the errors", [ERRORS_NOTE] if worst else []),
        ],
        [] if page is None else [f"Page written to {page}."],
        verbose,
    )
