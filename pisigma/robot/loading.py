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


def load_robot(robot: str | os.PathLike[str]) -> Robot:
    """Load a robot by catalogue name or from a YAML file. See `Robot.load`."""
    name = os.fspath(robot)
    if name in catalogue():
        text = (resources.files("pisigma.robot") / "catalogue" / f"{name}.yaml").read_text(encoding="utf-8")
        return parse_yaml(text, RobotDocument, RobotError, source=f"catalogue/{name}.yaml").to_robot()
    if Path(name).suffix.lower() in (".yaml", ".yml"):
        return read_yaml(name, RobotDocument, RobotError).to_robot()
    raise UnknownRobotError(
        f"'{name}' is no robot of the catalogue and no .yaml file: {nearest_choice(name, catalogue())}"
    )
