"""`pisigma robots`: the catalogue, and robots from files of controllers."""

from pathlib import Path
from typing import Annotated

import typer

from pisigma.cli.arguments import AsJson, complete_robot
from pisigma.cli.output import print_json, print_line, print_table
from pisigma.errors import OutputError

Read = Annotated[
    Path | None,
    typer.Option(
        help="File of a controller that holds a calibration: calibration.conf or the kinematics YAML of Universal "
        "Robots, a Staubli arm.cfx, or a table of joint offsets or counts."
    ),
]
Like = Annotated[
    str | None,
    typer.Option(
        help="With --read: the robot as the controller has it without the file.",
        autocompletion=complete_robot,
    ),
]
Out = Annotated[Path | None, typer.Option(help="With --read: the robot file (.yaml) to write.")]


def robots(read: Read = None, like: Like = None, out: Out = None, as_json: AsJson = False) -> None:
    """List the robots that come with pisigma, or turn a controller's own file into a robot file."""
    if read is None and like is None and out is None:
        _list(as_json)
    elif read is None or like is None or out is None:
        raise OutputError(
            "--read, --like and --out go together: the file, the nominal robot, and what to write."
        )
    else:
        _convert(read, like, out, as_json)


def _convert(read: Path, like: str, out: Path, as_json: bool) -> None:
    """Write the robot that a controller's file describes."""
    from pisigma.export.controllers.reading import read_controller_file
    from pisigma.export.dh_table import dh_yaml
    from pisigma.files.output_file import check_output, write_whole
    from pisigma.robot import Robot

    check_output(out, (".yaml", ".yml"), "a robot file", (read, Path(like)))
    robot = read_controller_file(read, Robot.load(like))
    write_whole(out, dh_yaml(robot, (f"Read from {read.name} with the nominal robot {robot.name}.",)))
    if as_json:
        print_json({"file": str(out), "robot": robot.name, "joints": robot.dof})
    else:
        print_line(f"Robot file written to {out}.")


def _list(as_json: bool) -> None:
    """Print the catalogue."""
    from pisigma.robot import Robot, catalogue

    known = [Robot.load(name) for name in catalogue()]
    if as_json:
        entries = [
            {
                "name": robot.name,
                "maker": robot.maker,
                "joints": [{"name": joint.name, "type": joint.type} for joint in robot.joints],
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
            str(robot.dof),
            "".join(joint.type[0].upper() for joint in robot.joints),
            f"{robot.reach * 1e3:.0f}",
            robot.maker,
        )
        for robot in known
    ]
    columns = ("name", "joints", "types", "reach [mm]", "maker")
    print_table("robots of the catalogue (R: revolute, P: prismatic joint)", columns, rows)
