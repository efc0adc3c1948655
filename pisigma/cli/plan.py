"""`pisigma plan`: which poses to measure, and the accuracy that they are expected to give."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pisigma.cli.arguments import AsJson, complete_robot
from pisigma.cli.calibrate import Base, Tip
from pisigma.cli.output import print_json, print_line, print_lines, print_table, progress_of
from pisigma.cli.settings_options import takes_settings
from pisigma.planning.plan_settings import PlanSettings

if TYPE_CHECKING:
    from pisigma.workflow.plan import Plan

Subject = Annotated[
    str,
    typer.Argument(
        metavar="ROBOT|MODEL",
        help="Catalogue name, robot file (YAML or URDF), or a model folder to measure again.",
        autocompletion=complete_robot,
    ),
]
Out = Annotated[Path, typer.Option(help="CSV file of poses to write; its .plan.yaml is written beside it.")]
CellFile = Annotated[
    Path | None, typer.Option("--cell", help="What stands around the robot (YAML): see the documentation.")
]
Programs = Annotated[
    list[Path] | None,
    typer.Option(
        "--program",
        help="Program to write too: .script (URScript), .src (KUKA), .mod (ABB) or .ls (FANUC); may be repeated.",
    ),
]


@takes_settings
def plan(
    subject: Subject,
    out: Out,
    settings: PlanSettings,
    cell: CellFile = None,
    program: Programs = None,
    base: Base = None,
    tip: Tip = None,
    as_json: AsJson = False,
) -> None:
    """Plan which poses to measure so that the calibration gets accurate with few of them.

    Prints the accuracy to expect against the number of poses, and writes the poses in the order in which they are
    measured: add the measured columns, and the file goes to `pisigma calibrate`.
    """
    from pisigma.planning.plan_file import yaml_of
    from pisigma.planning.subject import Subject as PlanningSubject
    from pisigma.workflow import plan as workflow

    wanted, programs = PlanningSubject.of(subject, base, tip), program or []
    workflow.check_files(out, programs, settings, wanted.robot, (subject, cell))
    with progress_of("plan") as progress:
        planned = workflow.plan(wanted, settings, cell, progress)
    planned.save(out, programs)
    if as_json:
        print_json({"file": str(out), **planned.to_json()})
    else:
        _print(planned, [out, yaml_of(out), *programs])


def _print(planned: "Plan", files: list[Path]) -> None:
    """Print for people what is expected of the poses, and what remains uncertain."""
    columns = ("poses", "RMS [mm]", "95 % [mm]", "RMS of random poses [mm]")
    rows = [
        (str(point.poses), *(f"{error * 1e3:.3f}" for error in (point.rms, point.p95, point.random_rms)))
        for point in planned.curve
    ]
    print_table("expected errors of the tool's position by number of poses", columns, rows)
    print_lines(_curve_lines(planned))
    print_line("What the expected error will mostly come from:")
    print_lines((f"- {line}" for line in planned.weak), indent="  ")
    points, settings = sum(map(len, planned.stored.way_points)), planned.stored.settings
    print_lines(
        [
            planned.candidates.sentence,
            f"{planned.poses} poses and {planned.checks} to check with take about {planned.travel / 60:.0f} min at "
            f"{settings.speed_deg_s:g} deg/s and {settings.settling_s:g} s a pose, with {points} way points.",
            *(() if planned.camera is None else planned.camera.sentences),
            *(f"Warning: {sentence}" for sentence in planned.warnings),
            f"Written to {', '.join(map(str, files))}.",
        ]
    )


def _curve_lines(planned: "Plan") -> list[str]:
    """What the curve does not show, and how many poses the limit needs, where there is one."""
    lines, last, settings = [], planned.curve[-1], planned.stored.settings
    limit = settings.limit_mm
    if settings.criterion == "D" and last.rms > last.random_rms:
        lines.append(
            "Poses chosen by criterion D determine all unknowns of the robot, and need not lower the error of the "
            "tool's position; choose by criterion I for that."
        )
    if limit is not None and planned.needed is None:
        lines.append(f"To keep 95 % of the errors below {limit:g} mm needs more than {planned.poses} poses.")
    elif limit is not None:
        needed = f"with {planned.needed} poses" if planned.needed else "already, without more poses"
        lines.append(f"95 % of the errors are expected below {limit:g} mm {needed}.")
    return lines
