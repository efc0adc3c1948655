"""`pisigma plan`: choose poses to measure, with the accuracy to expect."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pisigma.cli.arguments import AsJson, Verbose, complete_robot
from pisigma.cli.calibrate import Base, Tip
from pisigma.cli.cell import cell_at, refuse_with_cell, report_overrides
from pisigma.cli.output import print_json
from pisigma.cli.progress import progress_of
from pisigma.cli.screen import print_screen, sentences, table
from pisigma.cli.settings_options import StatedOptions, takes_settings
from pisigma.planning.plan_settings import PlanSettings
from pisigma.reporting.verdict import Verdict, counted, rounded

if TYPE_CHECKING:
    from pisigma.workflow.cell.cell import Cell as OpenedCell
    from pisigma.workflow.plan import Plan

MAX_POINTS = 8
"""Rows of the table of expected errors without `--verbose`."""

Subject = Annotated[
    str,
    typer.Argument(
        metavar="ROBOT|MODEL|CELL",
        help="Catalogue name, robot file (YAML or URDF), a model folder to measure again, or a cell.",
        autocompletion=complete_robot,
    ),
]
Out = Annotated[Path | None, typer.Option(help="CSV file of poses to write, with a .plan.yaml next to it.")]
CellFile = Annotated[Path | None, typer.Option("--cell", help="Obstacles around the robot (YAML).")]
Programs = Annotated[
    list[Path] | None,
    typer.Option(
        "--program",
        help="Also write a robot program: .script (URScript), .src (KUKA), .mod (ABB) or .ls (FANUC).",
    ),
]


@takes_settings
def plan(
    subject: Subject,
    *,
    out: Out = None,
    settings: PlanSettings,
    stated: StatedOptions,
    cell: CellFile = None,
    program: Programs = None,
    base: Base = None,
    tip: Tip = None,
    verbose: Verbose = False,
    as_json: AsJson = False,
) -> None:
    """Plan which poses to measure for an accurate calibration with few of them.

    Prints the expected accuracy against the number of poses, and writes the poses in the order of measurement. Add the
    measured columns and give the file to `pisigma calibrate`.
    """
    from pisigma.planning.plan_file import yaml_of
    from pisigma.planning.subject import Subject as PlanningSubject
    from pisigma.workflow import plan as workflow

    if (opened := cell_at(subject)) is not None:
        refuse_with_cell(__out=out, __cell=cell, __base=base, __tip=tip)
        return _plan_cell(opened, stated, program or [], verbose, as_json)
    if out is None:
        raise typer.BadParameter("expected a CSV file", param_hint="'--out'")
    planned_for, programs = PlanningSubject.load(subject, base, tip), program or []
    workflow.check_files(out, programs, settings, planned_for.robot, (subject, cell))
    with progress_of("plan") as progress:
        planned = workflow.plan(planned_for, settings, cell, progress)
    planned.save(out, programs)
    if as_json:
        print_json({"file": str(out), **planned.to_json()})
    else:
        _print(planned, [out, yaml_of(out), *programs], verbose)


def _plan_cell(
    cell: "OpenedCell", stated: StatedOptions, programs: list[Path], verbose: bool, as_json: bool
) -> None:
    """Plan for a cell, and store the plan there."""
    from pisigma.planning.plan_file import yaml_of

    with progress_of("plan") as progress:
        planned, out = cell.plan(progress, programs, **report_overrides(cell, "plan", stated))
    if as_json:
        print_json({"file": str(out), **planned.to_json(), "next": cell.status().step.to_json()})
    else:
        _print(planned, [out, yaml_of(out), *programs], verbose)


def _print(planned: "Plan", files: list[Path], verbose: bool) -> None:
    """Print what is expected of the poses, and what remains uncertain."""
    columns = ("poses", "RMS [mm]", "95 % [mm]", "RMS of random poses [mm]")
    rows = [
        (str(point.poses), *(rounded(error * 1e3) for error in (point.rms, point.p95, point.random_rms)))
        for point in planned.curve
    ]
    title = "expected errors of the tool's position by number of poses"
    short = rows if len(rows) <= MAX_POINTS else [*rows[:: -(-len(rows) // MAX_POINTS)], rows[-1]]
    weak = ["What the expected error will mostly come from:", *(f"- {line}" for line in planned.weak)]
    points = sum(map(len, planned.stored.way_points))
    lines = [planned.candidates.sentence, f"The poses are joined with {counted(points, 'way point')}."]
    print_screen(
        _verdict(planned, files[0]),
        planned.warnings,
        [
            sentences("criterion and limit", _curve_lines(planned)),
            table(title, columns, list(dict.fromkeys(short))),
            sentences("what remains uncertain", weak, "  "),
            sentences("what limits a camera", () if planned.camera is None else planned.camera.sentences),
        ],
        [
            *([table(f"{title}, all", columns, rows)] if len(short) < len(rows) else []),
            sentences("candidates and way points", lines),
        ],
        [f"Written to {', '.join(map(str, files))}."],
        verbose,
    )


def _verdict(planned: "Plan", file: Path) -> Verdict:
    """Say how accurate a calibration with the poses is expected to be."""
    last, settings, warnings = planned.curve[-1], planned.stored.settings, planned.warnings
    cautions = f"with caution ({counted(len(warnings), 'warning')})" if warnings else "yes"
    return Verdict(
        f"{rounded(last.rms * 1e3)} mm RMS and {rounded(last.p95 * 1e3)} mm for 95 % expected of the tool's position "
        f"with {planned.poses} poses; {rounded(last.random_rms * 1e3)} mm RMS with random poses.",
        f"{cautions}, if the sensor scatters as stated; {counted(planned.checks, 'pose')} will check it.",
        f"measure the poses, about {planned.travel / 60:.0f} min at {settings.speed_deg_s:g} deg/s and "
        f"{settings.settling_s:g} s a pose, with `pisigma measure {file} --rows ROWS.csv`.",
    )


def _curve_lines(planned: "Plan") -> list[str]:
    """Say what the curve does not show, and how many poses the limit needs, if there is one."""
    lines, last, settings = [], planned.curve[-1], planned.stored.settings
    limit = settings.limit_mm
    if settings.criterion == "D" and last.rms > last.random_rms:
        lines.append(
            "Criterion D determines all unknowns of the robot and need not lower the error of the tool's position; use "
            "criterion I for that."
        )
    if limit is not None and planned.needed is None:
        lines.append(
            f"More than {planned.poses} poses are needed to keep 95 % of the errors below {limit:g} mm."
        )
    elif limit is not None:
        needed = f"with {planned.needed} poses" if planned.needed else "already, without more poses"
        lines.append(f"95 % of the errors are expected below {limit:g} mm {needed}.")
    return lines
