"""Finding a robot: in the catalogue or in a file."""

import os
from importlib import resources
from pathlib import Path

from pisigma.errors import RobotError, UnknownRobotError, nearest_choice
from pisigma.robot.description import Robot
from pisigma.robot.robot_file import RobotDocument
from pisigma.yaml_file import parse_yaml, read_yaml


def catalogue() -> tuple[str, ...]:
    """Names of the robots that come with pisigma, sorted."""
    folder = resources.files("pisigma.robot") / "catalogue"
    return tuple(
        sorted(entry.name.removesuffix(".yaml") for entry in folder.iterdir() if entry.name.endswith(".yaml"))
    )


def load_robot(robot: str | os.PathLike[str], base: str | None = None, tip: str | None = None) -> Robot:
    """Load a robot by catalogue name, from a YAML or from a URDF file. See `Robot.load`."""
    name = os.fspath(robot)
    suffix = Path(name).suffix.lower()
    if suffix == ".urdf" and name not in catalogue():
        from pisigma.robot.urdf_rows import load_urdf

        return load_urdf(name, base, tip)
    for option, link in (("base", base), ("tip", tip)):
        if link is not None:
            raise RobotError(
                f"{option}='{link}' names a link of a URDF file, but '{name}' is none; leave it out or give a "
                ".urdf file."
            )
    if name in catalogue():
        text = (resources.files("pisigma.robot") / "catalogue" / f"{name}.yaml").read_text(encoding="utf-8")
        return parse_yaml(text, RobotDocument, RobotError, source=f"catalogue/{name}.yaml").to_robot()
    if suffix in (".yaml", ".yml"):
        return read_yaml(name, RobotDocument, RobotError).to_robot()
    if suffix == ".xacro":
        raise RobotError(f"{name}: is xacro, which is not read; expand it first (`xacro FILE > robot.urdf`).")
    raise UnknownRobotError(
        f"'{name}' is no robot of the catalogue and no .yaml or .urdf file: {nearest_choice(name, catalogue())}"
    )
