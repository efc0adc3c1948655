"""`pisigma robots`: the catalogue, robots from files of controllers, and poses for checking a robot description."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pisigma.cli.arguments import AsJson, complete_robot
from pisigma.cli.output import print_json, print_line, print_lines, print_table
from pisigma.files.errors import OutputError

if TYPE_CHECKING:
    from pisigma.robot.chains import PendantPose
    from pisigma.robot.description import Robot

Read = Annotated[
    Path | None,
    typer.Option(
        help="Read a controller's calibration: calibration.conf or kinematics YAML of Universal Robots, Staubli "
        "arm.cfx, or a table of joint offsets or encoder counts."
    ),
]
Like = Annotated[
    str | None,
    typer.Option(
        help="With --read, the nominal robot to which the file applies.",
        autocompletion=complete_robot,
    ),
]
Out = Annotated[Path | None, typer.Option(help="With --read, robot file (.yaml) to write.")]

MaxChange = Annotated[
    float | None,
    typer.Option(
        "--max-change-mm",
        help="With --read, refuse a file that moves the tool by more than this on average [mm]. [default: 5]",
        min=0.0,
    ),
]
Check = Annotated[
    str | None,
    typer.Option(
        help="Print the tool pose of a robot (name, YAML or URDF) with all axes at 0 and with each at 90 deg, for "
        "comparison with the teach pendant.",
        autocompletion=complete_robot,
    ),
]


def robots(
    read: Read = None,
    like: Like = None,
    out: Out = None,
    max_change_mm: MaxChange = None,
    check: Check = None,
    base: Annotated[str | None, typer.Option(help="Base link of a URDF file.")] = None,
    tip: Annotated[str | None, typer.Option(help="Tool link of a URDF file.")] = None,
    as_json: AsJson = False,
) -> None:
    """List the robots that come with pisigma, read a controller's own file, or check a robot description."""
    if check is not None:
        _check(check, base, tip, as_json)
    elif read is None and like is None and out is None and max_change_mm is None:
        _list(as_json)
    elif read is None or like is None or out is None:
        raise OutputError(
            expected="--read (the file), --like (the nominal robot) and --out (what to write) together",
            option="--read",
        )
    else:
        from pisigma.robot import Robot

        _convert(read, like, Robot.load(like, base, tip), out, max_change_mm, as_json)


def _convert(
    read: Path, like: str, nominal: "Robot", out: Path, max_change_mm: float | None, as_json: bool
) -> None:
    """Write the robot of a controller's file; `like` names the nominal one."""
    from pisigma.deployment.export.controllers.controller_file import MAX_CHANGE, read_controller_file
    from pisigma.deployment.export.dh_table import dh_yaml
    from pisigma.files.output_file import check_output, write_atomically

    check_output(out, (".yaml", ".yml"), "a robot file", (read, Path(like)))
    reading = read_controller_file(read, nominal, MAX_CHANGE if max_change_mm is None else max_change_mm)
    robot, change = reading.robot, reading.deviation_from_nominal
    write_atomically(out, dh_yaml(robot, (robot.source, *reading.remarks)))
    if as_json:
        print_json(
            {
                "file": str(out),
                "robot": robot.name,
                "joints": robot.dof,
                "change": asdict(change),
                "frames": reading.frames.to_json() if reading.frames else None,
                "remarks": reading.remarks,
                "warnings": [],
            }
        )
        return
    print_line(f"Robot file written to {out}.")
    print_lines(
        [
            f"Its tool differs from that of the nominal robot by {change.mean_mm:.3g} mm and {change.mean_mrad:.3g} "
            f"mrad on average, by {change.max_mm:.3g} mm at most.",
            *reading.remarks,
        ]
    )


def _list(as_json: bool) -> None:
    """Print the catalogue."""
    from pisigma.robot import Robot, catalogue

    known = [Robot.load(name) for name in catalogue()]
    if as_json:
        entries = [
            {
                "name": robot.name,
                "maker": robot.maker,
                "joints": [{"name": joint.name, "type": joint.type} for joint in robot.axes],
                "reach_mm": robot.reach * 1e3,
                "source": robot.source,
            }
            for robot in known
        ]
        print_json({"robots": entries})
        return
    rows = [
        (
            robot.name,
            str(len(robot.axes)),
            "".join(joint.type[0].upper() for joint in robot.axes),
            f"{robot.reach * 1e3:.0f}",
            robot.maker,
        )
        for robot in known
    ]
    columns = ("name", "joints", "types", "reach [mm]", "maker")
    print_table("robots of the catalogue (R: revolute, P: prismatic joint)", columns, rows)


def _check(robot: str, base: str | None, tip: str | None, as_json: bool) -> None:
    """Print the poses of the tool according to a description."""
    from pisigma.robot.chains import pendant_poses
    from pisigma.robot.description import Robot
    from pisigma.robot.kinematics.closed_form import closed_form_solver

    poses = pendant_poses(robot, base, tip)
    form = closed_form_solver(Robot.load(robot, base, tip))
    if as_json:
        closed = None if form is None else {"name": form.name, "branches": list(form.branches)}
        print_json({"robot": robot, "closed_form": closed, "poses": [pose.to_json() for pose in poses]})
        return
    rows = [_pendant_row(pose) for pose in poses]
    columns = ("axis", "at", "x [mm]", "y [mm]", "z [mm]", "roll [deg]", "pitch [deg]", "yaw [deg]", "limits")
    print_table(
        f"tool of {Path(robot).stem} in its base frame, one axis moved, all others at 0", columns, rows
    )
    print_lines(
        [
            "Move the robot to these values, with the tool and frame of the description, and compare the poses "
            "with those on the teach pendant; the rotation is RotZ(roll) RotY(pitch) RotX(yaw). If the first "
            "difference appears when an axis is moved, check its row and the following ones, its direction and "
            "its coupling.",
            "The nominal inverse kinematics is solved numerically."
            if form is None
            else f"The nominal inverse kinematics has the closed form {form.name} with {len(form.branches)} branches.",
        ]
    )


def _pendant_row(pose: "PendantPose") -> tuple[str, ...]:
    """Return the table cells of a pose."""
    at = f"{pose.axis_value_in_file_unit:g} {pose.axis.file_unit}" if pose.axis else "0"
    numbers = (f"{value + 0.0:.2f}" for value in pose.tool_in_file_units.values())
    return (
        pose.axis.name if pose.axis else "-",
        at,
        *numbers,
        "inside" if pose.is_within_limits else "outside",
    )
