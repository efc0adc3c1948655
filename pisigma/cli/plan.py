"""`pisigma plan`: choose poses to measure, with the accuracy to expect."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pisigma.cli.arguments import AsJson, Verbose, complete_robot
from pisigma.cli.calibrate import Base, Tip
from pisigma.cli.cell import cell_at, next_step_lines, refuse_with_cell, report_overrides
from pisigma.cli.output import print_json
from pisigma.cli.progress import progress_of
from pisigma.cli.screen import print_result
from pisigma.cli.settings_options import StatedSettings, takes_settings
from pisigma.planning.plan_settings import PlanSettings

if TYPE_CHECKING:
    from pisigma.workflow.cell.cell import Cell as OpenedCell

RobotOrModel = Annotated[
    str,
    typer.Argument(
        metavar="ROBOT|MODEL|CELL",
        help="Catalogue name, robot file (YAML or URDF), model folder of a robot to measure again, or cell.",
        autocompletion=complete_robot,
    ),
]
Out = Annotated[
    Path | None, typer.Option(help="CSV file of poses to write, together with a .plan.yaml file.")
]
SurroundingsFile = Annotated[
    Path | None,
    typer.Option("--surroundings", help="Obstacles around the robot and limits of its motion (YAML)."),
]
Programs = Annotated[
    list[Path] | None,
    typer.Option(
        "--program",
        help="Also write a robot program: .script (URScript), .src (KUKA), .mod (ABB) or .ls (FANUC).",
    ),
]


@takes_settings
def plan(
    subject: RobotOrModel,
    *,
    out: Out = None,
    settings: StatedSettings[PlanSettings],
    surroundings: SurroundingsFile = None,
    program: Programs = None,
    base: Base = None,
    tip: Tip = None,
    verbose: Verbose = False,
    as_json: AsJson = False,
) -> None:
    """Plan which poses to measure for an accurate calibration with few of them.

    Prints the expected accuracy against the number of poses, and writes the poses in the order of measurement. Add the
    measured columns and pass the file to `pisigma calibrate`.
    """
    from pisigma.planning.plan_file import yaml_of
    from pisigma.planning.subject import RobotOrModel as PlanningSubject
    from pisigma.workflow import plan as workflow
    from pisigma.workflow.result_texts import plan_text

    if (opened := cell_at(subject)) is not None:
        refuse_with_cell(__out=out, __surroundings=surroundings, __base=base, __tip=tip)
        return _plan_cell(opened, settings, program or [], verbose, as_json)
    if out is None:
        raise typer.BadParameter("expected a CSV file", param_hint="'--out'")
    chosen = settings.build()
    planned_for, programs = PlanningSubject.load(subject, base, tip), program or []
    workflow.check_plan_outputs(out, programs, chosen, planned_for.robot, (subject, surroundings))
    with progress_of("plan") as progress:
        planned = workflow.plan(planned_for, chosen, surroundings, progress)
    planned.save(out, programs)
    if as_json:
        print_json({"file": str(out), **planned.to_json()})
    else:
        print_result(plan_text(planned, [out, yaml_of(out), *programs]), verbose)


def _plan_cell(
    cell: "OpenedCell",
    settings: StatedSettings[PlanSettings],
    programs: list[Path],
    verbose: bool,
    as_json: bool,
) -> None:
    """Plan for a cell, and store the plan there."""
    from pisigma.planning.plan_file import yaml_of
    from pisigma.workflow.result_texts import plan_text

    with progress_of("plan") as progress:
        planned, out = cell.plan(progress, programs, **report_overrides(cell, "plan", settings))
    if as_json:
        print_json({"file": str(out), **planned.to_json(), "next": cell.status().step.to_json()})
    else:
        text = plan_text(planned, [out, yaml_of(out), *programs])
        print_result(text, verbose, next_step_lines(cell.status()))
