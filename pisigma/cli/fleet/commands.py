"""`pisigma fleet run` and `pisigma fleet status`: many robots with one command."""

import datetime
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pisigma.cli.arguments import AsJson, Overwrite
from pisigma.cli.endings import NOT_ACCEPTED, tell_problems
from pisigma.cli.output import command_line, print_json, print_lines, print_table, progress_of
from pisigma.cli.settings_options import takes_settings
from pisigma.files.errors import FleetError
from pisigma.workflow.settings.calibration import CalibrationSettings
from pisigma.workflow.settings.fleet import FleetSettings

if TYPE_CHECKING:
    from pisigma.lifetime.fleet.status import FleetStatus
    from pisigma.workflow.fleet.run import FleetRun

DAYS_AHEAD = 366
"""`fleet status` also says what will be overdue within a year."""
SHOWN = 10
"""Robots that a table for people has at most."""

Source = Annotated[
    Path,
    typer.Argument(
        metavar="FLEET",
        help="Manifest (CSV) with the columns id, robot and data (and camera and board, where data are corners of "
        "images), or a folder with one folder per robot.",
    ),
]
Out = Annotated[Path, typer.Option(help="Folder of the fleet; one that is there already is gone on with.")]
RobotName = Annotated[
    str | None, typer.Option(metavar="ROBOT", help="Catalogue name or robot file of robots that state none.")
]
Model = Annotated[str, typer.Option(help="hybrid or geometric.")]
PriorOut = Annotated[Path, typer.Option("--out", help="Model folder to write.")]
Folder = Annotated[Path, typer.Argument(metavar="DIR", help="Folder that `pisigma fleet run` wrote.")]
Page = Annotated[Path | None, typer.Option(help="HTML page to write, with filters by state and name.")]
OverdueDays = Annotated[
    int, typer.Option(min=0, help="Days without a session after which a robot is overdue.")
]
Today = Annotated[str | None, typer.Option(metavar="DAY", help="Day to count from, such as 2026-11-22.")]

fleet = typer.Typer(name="fleet", help="Calibrate, recalibrate or monitor many robots.", no_args_is_help=True)


@fleet.command()
@tell_problems
@takes_settings
def run(
    source: Source,
    out: Out,
    settings: FleetSettings,
    robot: RobotName = None,
    model: Model = "hybrid",
    as_json: AsJson = False,
) -> None:
    """Work out all robots of a fleet: a model folder each, and one table of all results.

    A call that was ended goes on where it was. A robot whose files are bad is named and does not stop the others; exit
    status 3 then.
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


@fleet.command("prior")
@tell_problems
def estimate_prior(
    context: typer.Context,
    source: Source,
    out: PriorOut,
    robot: RobotName = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Estimate what robots of one type have in common, from the first session of each, as a model folder.

    `pisigma calibrate --prior DIR` and `pisigma plan DIR` begin with it.
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
    from pisigma.reporting.fleet_prior_card import UNDETERMINED, common_table, spectrum_table

    print_table(f"what {result.summary.robots} robots have in common", *common_table(result.summary))
    print_lines([UNDETERMINED])
    print_table("joint correction", *spectrum_table(result.summary))
    print_lines(f"Warning: {sentence}" for sentence in result.summary.warnings)
    print_lines([f"Model written to {out} in {result.seconds:.1f} s; calibrate with --prior {out}."])


@fleet.command()
@tell_problems
def status(
    folder: Folder,
    page: Page = None,
    overdue_days: OverdueDays = 180,
    today: Today = None,
    as_json: AsJson = False,
) -> None:
    """Say how a fleet stands: the worst robots, those that drift, that were not measured for long, or were refused.

    Exit status 3 where a robot drifts, was refused, or has not been worked out yet.
    """
    from pisigma.files.output_file import check_output, write_whole
    from pisigma.lifetime.fleet.record import expected_robots, read_records
    from pisigma.lifetime.fleet.status import FleetStatus

    if page is not None:
        check_output(page, (".html", ".htm"), "a page", (folder / "records",))
    seen = FleetStatus.of(read_records(folder), _day(today), overdue_days, expected_robots(folder))
    if page is not None:
        from pisigma.reporting.page.lifetime import fleet_page

        write_whole(page, fleet_page(seen, folder.resolve().name))
    if as_json:
        print_json(seen.to_json())
    else:
        _print_status(seen, page)
    if seen.action:
        raise typer.Exit(NOT_ACCEPTED)


def _day(stated: str | None) -> datetime.date:
    """A stated day, or today."""
    from pisigma.measurement.dates import is_date

    if stated is None:
        return datetime.date.today()
    if not is_date(stated, DAYS_AHEAD):
        raise FleetError(
            f"today: expected a day from 1970-01-01 to a year from now, such as 2026-11-22, got '{stated}'; correct it."
        )
    return datetime.date.fromisoformat(stated)


def _print_run(result: "FleetRun") -> None:
    """Print how many robots are done, and why others are not."""
    count = len(result.records)
    again = f"; an earlier call had worked out {result.resumed} of the {count}" if result.resumed else ""
    print_lines([f"{result.done} of {count} robots are done{again}; {result.seconds:.1f} s."])
    print_lines((f"Refused: {robot}, {reason}" for robot, reason in result.refused), indent="  ")
    print_lines(
        [f"Results written to {result.results}; `pisigma fleet status {result.results.parent}` sums them up."]
    )


def _print_status(seen: "FleetStatus", page: Path | None) -> None:
    """Print how many robots are in each state, the worst, and what is to be done."""
    from pisigma.reporting.fleet_tables import ERRORS_NOTE, not_compared, robot_table, state_table

    count = len(seen.robots)
    print_table(f"{count} robot{'' if count == 1 else 's'}, seen on {seen.today}", *state_table(seen))
    if worst := seen.worst_first[:SHOWN]:
        print_table("largest errors", *robot_table(worst))
        print_lines([ERRORS_NOTE])
    for state, title in (("drifting", "Drifting"), ("refused", "Refused")):
        for one in seen.in_state(state):
            said = one.refused or one.last
            assert said is not None
            print_lines([f"{title}: {one.robot}, {said.session}: {said.sentence}"], indent="  ")
    if overdue := sorted(seen.in_state("overdue"), key=lambda one: -(one.days or 0)):
        longest = ", ".join(f"{one.robot} ({one.days} days)" for one in overdue[:SHOWN])
        more = f", and {len(overdue) - SHOWN} more" if len(overdue) > SHOWN else ""
        print_lines([f"Overdue: {longest}{more}."], indent="  ")
    if missing := [one.robot for one in seen.in_state("missing")]:
        print_lines([f"Missing: {', '.join(missing)}; give the same `pisigma fleet run` again."], indent="  ")
    print_lines(
        filter(None, [not_compared(seen), *(f"Warning: {one}" for one in seen.warnings)]), indent="  "
    )
    if page is not None:
        print_lines([f"Page written to {page}."])
