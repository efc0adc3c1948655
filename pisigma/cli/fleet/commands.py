"""`pisigma fleet run` and `pisigma fleet status`: many robots with one command."""

import datetime
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pisigma.cli.arguments import AsJson, Overwrite, Verbose
from pisigma.cli.endings import NOT_ACCEPTED, report_problems
from pisigma.cli.help import ShortHelpCommand
from pisigma.cli.output import command_line, print_json
from pisigma.cli.progress import progress_of
from pisigma.cli.screen import print_screen
from pisigma.cli.settings_options import takes_settings
from pisigma.files.errors import FleetError
from pisigma.reporting.result_text import sentences, table_block
from pisigma.workflow.settings.calibration import CalibrationSettings
from pisigma.workflow.settings.fleet import FleetSettings

if TYPE_CHECKING:
    from pisigma.lifetime.fleet.status import FleetStatus
    from pisigma.reporting.verdict import Verdict
    from pisigma.workflow.fleet.prior import FleetPriorResult
    from pisigma.workflow.fleet.run import FleetRun

DAYS_AHEAD = 366
"""Days from today that --today may be ahead, to see what will be overdue within a year."""
SHOWN = 10
"""Largest number of robots in a table."""

NEXT_STEPS = {
    "refused": "correct the files of the refused robots and run the fleet again.",
    "missing": "run the same `pisigma fleet run` again.",
    "drifting": "measure the drifting robots and recalibrate them (`pisigma fleet run --task recalibrate`).",
    "overdue": "measure the overdue robots.",
}
"""What to do about robots in a state, the most urgent first."""

Source = Annotated[
    Path,
    typer.Argument(
        metavar="FLEET",
        help="Manifest (CSV) with the columns id, robot and data (and camera and board for corners of images), or a "
        "folder with one folder per robot.",
    ),
]
Out = Annotated[Path, typer.Option(help="Folder of the fleet; an existing one is resumed.")]
RobotName = Annotated[
    str | None, typer.Option(metavar="ROBOT", help="Catalogue name or robot file, for robots without one.")
]
Model = Annotated[str, typer.Option(help="Kind of calibration: hybrid or geometric.")]
PriorOut = Annotated[Path, typer.Option("--out", help="Model folder to write.")]
Folder = Annotated[Path, typer.Argument(metavar="DIR", help="Folder that `pisigma fleet run` wrote.")]
Page = Annotated[Path | None, typer.Option(help="HTML page to write, with filters by state and name.")]
OverdueDays = Annotated[
    int, typer.Option(min=0, help="Days without a session after which a robot is overdue.")
]
Today = Annotated[
    str | None, typer.Option(metavar="DAY", help="Day to count from, such as 2026-11-22. [default: today]")
]

fleet = typer.Typer(name="fleet", help="Calibrate, recalibrate or monitor many robots.", no_args_is_help=True)


@fleet.command(cls=ShortHelpCommand)
@report_problems
@takes_settings
def run(
    source: Source,
    out: Out,
    settings: FleetSettings,
    robot: RobotName = None,
    model: Model = "hybrid",
    as_json: AsJson = False,
) -> None:
    """Calibrate, recalibrate or monitor all robots of a fleet: a model folder each and one table of results.

    Resumes an interrupted call. Skips robots whose files are refused, names them, and exits with status 3.
    """
    from pisigma.workflow.fleet.run import run_fleet

    kind: Any = model
    settings = replace(settings, calibration=CalibrationSettings(model=kind))
    with progress_of("fleet") as progress:
        result = run_fleet(source, out, settings, robot, progress)
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
    source: Source,
    out: PriorOut,
    robot: RobotName = None,
    overwrite: Overwrite = False,
    verbose: Verbose = False,
    as_json: AsJson = False,
) -> None:
    """Estimate what robots of one type have in common, from the first session of each.

    Writes a model folder for `pisigma calibrate --prior DIR` and `pisigma plan DIR`.
    """
    from pisigma.files.output_folder import check_folder
    from pisigma.workflow.fleet.prior import estimate_fleet_prior

    check_folder(out, overwrite, inputs=(source,))
    with progress_of("fleet prior") as progress:
        result = estimate_fleet_prior(source, robot, progress)
    result.save(out, command=command_line(context), overwrite=overwrite)
    if as_json:
        print_json({"model": str(out), **result.to_json()})
        return
    _print_prior(result, out, verbose)


@fleet.command(cls=ShortHelpCommand)
@report_problems
def status(
    folder: Folder,
    page: Page = None,
    overdue_days: OverdueDays = 180,
    today: Today = None,
    verbose: Verbose = False,
    as_json: AsJson = False,
) -> None:
    """Summarise a fleet: the largest errors, and the robots that drift, are overdue, refused or missing.

    Exits with status 3 if a robot drifts, was refused or has no result yet.
    """
    from pisigma.files.output_file import check_output, write_whole
    from pisigma.lifetime.fleet.record import expected_robots, read_records
    from pisigma.lifetime.fleet.status import FleetStatus

    if page is not None:
        check_output(page, (".html", ".htm"), "a page", (folder / "records",))
    seen = FleetStatus.from_records(read_records(folder), _day(today), overdue_days, expected_robots(folder))
    if page is not None:
        from pisigma.reporting.page.lifetime import fleet_page

        write_whole(page, fleet_page(seen, folder.resolve().name))
    if as_json:
        print_json(seen.to_json())
    else:
        _print_status(seen, page, verbose)
    if seen.action:
        raise typer.Exit(NOT_ACCEPTED)


def _print_prior(result: "FleetPriorResult", out: Path, verbose: bool) -> None:
    """Print what robots have in common."""
    from pisigma.reporting.derived_cards import UNDETERMINED, common_table, spectrum_table
    from pisigma.reporting.verdict import Verdict, counted

    summary = result.summary
    warnings = len(summary.warnings)
    verdict = Verdict(
        f"common errors of {counted(summary.robots, 'robot')}, in {counted(len(summary.parameters), 'parameter')}.",
        f"with caution ({counted(warnings, 'warning')})." if warnings else "yes, for robots of this type.",
        f"calibrate a robot of this type with few poses: `pisigma calibrate ROBOT ROWS.csv --prior {out} --out DIR`.",
        "Prior",
    )
    print_screen(
        verdict,
        summary.warnings,
        [table_block("joint correction", *spectrum_table(summary))],
        [
            table_block(f"parameters that {summary.robots} robots have in common", *common_table(summary)),
            sentences("undetermined parameters", [UNDETERMINED]),
        ],
        [f"Model written to {out} in {result.seconds:.1f} s; its README.md has all figures."],
        verbose,
    )


def _day(stated: str | None) -> datetime.date:
    """Return a stated day, or today."""
    from pisigma.measurement.dates import is_date

    if stated is None:
        return datetime.date.today()
    if not is_date(stated, DAYS_AHEAD):
        raise FleetError(
            expected="a day from 1970-01-01 to a year from now, such as 2026-11-22",
            value=stated,
            option="--today",
        )
    return datetime.date.fromisoformat(stated)


def _print_run(result: "FleetRun") -> None:
    """Print how many robots are done, and why others are not."""
    from pisigma.reporting.verdict import Verdict

    count, refused = len(result.records), len(result.refused)
    again = f"; an earlier call had processed {result.resumed} of the {count}" if result.resumed else ""
    verdict = Verdict(
        f"{result.done} of {count} robots are done{again}; {result.seconds:.1f} s.",
        f"no: {refused} refused." if refused else "see `pisigma fleet status` for the errors of each robot.",
        f"{'correct the files named below and run it again' if refused else 'see the summary'}: "
        f"`pisigma fleet status {result.results.parent}`.",
        "Done",
    )
    refusals = [f"{robot} was refused: {reason}" for robot, reason in result.refused]
    print_screen(verdict, refusals, closing=[f"Results written to {result.results}."])


def _print_status(seen: "FleetStatus", page: Path | None, verbose: bool) -> None:
    """Print how many robots are in each state, the worst, and what is to be done."""
    from pisigma.reporting.lifetime_tables import ERRORS_NOTE, not_compared, robot_table, state_table

    count, worst = len(seen.robots), seen.robots_by_error
    title = f"{count} robot{'' if count == 1 else 's'}, as of {seen.today}"
    details = [table_block("errors of all robots", *robot_table(worst))] if len(worst) > SHOWN else []
    print_screen(
        _status_verdict(seen),
        [*_states(seen), *filter(None, [not_compared(seen)]), *seen.warnings],
        [
            table_block(title, *state_table(seen)),
            *([table_block("largest errors", *robot_table(worst[:SHOWN]))] if worst else []),
        ],
        [*details, sentences("which errors these are", [ERRORS_NOTE] if worst else [])],
        [] if page is None else [f"Page written to {page}."],
        verbose,
    )


def _status_verdict(seen: "FleetStatus") -> "Verdict":
    """Judge a fleet by its worst robot and by those that need attention."""
    from pisigma.reporting.verdict import Verdict, counted, rounded

    worst = next(iter(seen.robots_by_error), None)
    error = None if worst is None or worst.last is None else worst.last.error_mm
    states = {
        state: len(seen.robots_in_state(state)) for state in ("drifting", "refused", "missing", "overdue")
    }
    found = ", ".join(f"{number} {state}" for state, number in states.items() if number)
    return Verdict(
        "no robot has an error yet."
        if worst is None or error is None
        else f"largest error {rounded(error, 0)} mm RMS, of {worst.robot}.",
        f"{found} of {counted(len(seen.robots), 'robot')}." if found else "yes: all robots are fine.",
        next(
            (advice for state, advice in NEXT_STEPS.items() if states[state]),
            "measure the next session in time.",
        ),
    )


def _states(seen: "FleetStatus") -> Iterator[str]:
    """Name the robots that drift, were refused, are overdue or are missing."""
    for state in ("drifting", "refused"):
        for one in seen.robots_in_state(state):
            said = one.refused or one.last
            assert said is not None
            yield f"{state}: {one.robot}, {said.session}: {said.sentence}"
    if overdue := sorted(seen.robots_in_state("overdue"), key=lambda one: -(one.days or 0)):
        longest = ", ".join(f"{one.robot} ({one.days} days)" for one in overdue[:SHOWN])
        more = f", and {len(overdue) - SHOWN} more" if len(overdue) > SHOWN else ""
        yield f"overdue: {longest}{more}."
    if missing := [one.robot for one in seen.robots_in_state("missing")]:
        yield f"missing: {', '.join(missing)}; run the same `pisigma fleet run` again."
