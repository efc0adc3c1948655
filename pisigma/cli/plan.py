"""`pisigma plan`: which poses to measure, and the accuracy that they are expected to give."""

import inspect
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pisigma.cli.arguments import AsJson, complete_robot
from pisigma.cli.calibrate import Base, Tip
from pisigma.cli.camera_options import (
    FixedCamera,
    RepeatabilityDeg,
    RepeatabilityMm,
    refuse_without_camera,
)
from pisigma.cli.output import print_json, print_line, print_lines, print_table, progress_of

if TYPE_CHECKING:
    from pisigma.planning.plan_settings import PlanSettings
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
Count = Annotated[int, typer.Option(help="Poses to calibrate with.")]
Check = Annotated[int, typer.Option(help="Poses to measure besides, which judge the calibration (set test).")]
CellFile = Annotated[
    Path | None, typer.Option("--cell", help="What stands around the robot (YAML): see the documentation.")
]
Candidates = Annotated[int, typer.Option(help="Poses to draw, of which some are chosen.")]
CandidatesFrom = Annotated[
    Path | None, typer.Option(help="Choose from the joint values of this CSV file instead.")
]
Seed = Annotated[int, typer.Option(help="Seed of what is drawn.")]
Box = Annotated[
    str | None,
    typer.Option(
        metavar="X,Y,Z,X,Y,Z",
        help="Box of the reflector's positions: lowest and then highest x, y, z in the robot's base frame [mm].",
    ),
]
Task = Annotated[
    Path | None,
    typer.Option(
        help="CSV file of joint values or poses where the robot shall be accurate. [default: everywhere]"
    ),
]
Measured = Annotated[Path | None, typer.Option(help="Measurements that are there already (CSV).")]
SensorKind = Annotated[
    str, typer.Option("--sensor", help="What is measured: position, pose, distance, or corners by a camera.")
]
CameraFile = Annotated[
    Path | None, typer.Option("--camera", help="Of the sensor camera: its YAML (of pisigma, ROS or OpenCV).")
]
BoardFile = Annotated[
    Path | None, typer.Option("--board", help="Of the sensor camera: the board that it sees (YAML).")
]
SigmaPx = Annotated[float, typer.Option(help="Of a camera: standard deviation of u and v of a corner [px].")]
SigmaMm = Annotated[
    float | None,
    typer.Option(help="Standard deviation of a measured length [mm]. [default: of laser trackers]"),
]
CriterionName = Annotated[
    str, typer.Option("--criterion", help="I: the tool's position over the task; D: all unknowns.")
]
LimitMm = Annotated[
    float | None,
    typer.Option(
        help="Length below which 95 % of the tool's position errors stay [mm]: how many poses does it need?"
    ),
]
SpeedDegS = Annotated[float, typer.Option(help="Speed of every joint between the poses [deg/s].")]
SettlingS = Annotated[float, typer.Option(help="Time at every pose until it is measured [s].")]
Programs = Annotated[
    list[Path] | None,
    typer.Option(
        "--program",
        help="Program to write too: .script (URScript), .src (KUKA), .mod (ABB) or .ls (FANUC); may be repeated.",
    ),
]

OF_CAMERAS = ("fixed_camera", "sigma_px", "repeatability_mm", "repeatability_deg")
"""Options that say nothing without a camera."""


def plan(
    context: typer.Context,
    subject: Subject,
    out: Out,
    count: Count = 40,
    check: Check = 10,
    cell: CellFile = None,
    candidates: Candidates = 5000,
    candidates_from: CandidatesFrom = None,
    seed: Seed = 0,
    box: Box = None,
    task: Task = None,
    measured: Measured = None,
    sensor: SensorKind = "position",
    camera: CameraFile = None,
    board: BoardFile = None,
    fixed_camera: FixedCamera = False,
    sigma_px: SigmaPx = 0.3,
    repeatability_mm: RepeatabilityMm = 0.02,
    repeatability_deg: RepeatabilityDeg = 0.01,
    sigma_mm: SigmaMm = None,
    criterion: CriterionName = "I",
    limit_mm: LimitMm = None,
    speed_deg_s: SpeedDegS = 30.0,
    settling_s: SettlingS = 3.0,
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

    settings = _settings(context.params)
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


def _settings(options: Mapping[str, Any]) -> "PlanSettings":
    """Settings by the options of the command."""
    from pisigma.files.errors import PlanningError
    from pisigma.planning.camera_settings import CameraSettings
    from pisigma.planning.plan_settings import PlanSettings

    same = ("count", "check", "sensor", "criterion", "candidates", "seed", "sigma_mm", "limit_mm")
    stated = {name: options[name] for name in (*same, "speed_deg_s", "settling_s")}
    files = {name: options[name] for name in ("candidates_from", "task", "measured")}
    stated |= {name: None if file is None else str(file) for name, file in files.items()}
    if (options["camera"] is None) != (options["board"] is None):
        raise PlanningError(
            "--camera and --board were wanted together, with --sensor camera, got one of the two."
        )
    if options["camera"] is None:
        defaults = inspect.signature(plan).parameters
        refuse_without_camera(options, [defaults[name] for name in OF_CAMERAS])
    else:
        noise = (options[name] for name in ("sigma_px", "repeatability_mm", "repeatability_deg"))
        camera, board = str(options["camera"]), str(options["board"])
        stated["camera"] = CameraSettings(camera, board, options["fixed_camera"], *noise)
    return PlanSettings(box_mm=_box(options["box"]), **stated)


def _box(stated: str | None) -> Any:
    """Lowest and highest x, y, z [mm], from "X,Y,Z,X,Y,Z"."""
    from pisigma.files.errors import PlanningError

    try:
        box = None if stated is None else tuple(map(float, stated.split(",")))
    except ValueError:
        box = ()
    if box is not None and len(box) != 6:
        raise PlanningError(
            f"--box: six numbers such as -500,200,100,500,900,800 were wanted, got '{stated}'."
        )
    return box
