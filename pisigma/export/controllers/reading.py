"""Controllers' own files read back as robots."""

from collections.abc import Callable
from pathlib import Path

from pisigma.errors import RobotError
from pisigma.export.controllers import staubli, universal_robots, ur_ros
from pisigma.export.controllers.offset_table import read_offsets
from pisigma.files.input_file import read_text
from pisigma.robot.description import Robot


def _read_yaml(text: str, source: str, nominal: Robot) -> Robot:
    kinematics = any(line.startswith("kinematics:") for line in text.splitlines())
    return (ur_ros.read_kinematics if kinematics else read_offsets)(text, source, nominal)


READERS: dict[str, Callable[[str, str, Robot], Robot]] = {
    ".conf": universal_robots.read_calibration,
    ".cfx": staubli.read_arm,
    ".csv": read_offsets,
    ".yaml": _read_yaml,
    ".yml": _read_yaml,
}
"""By the suffix of the file."""


def read_controller_file(path: Path, nominal: Robot) -> Robot:
    """The robot that a controller's own file makes of the nominal one.

    Files are Universal Robots' calibration.conf and the kinematics YAML of their ROS driver, Staubli's arm.cfx, and
    tables of joint offsets or counts that pisigma wrote. A file of xacro or URDF needs no nominal robot: load it with
    `Robot.load`.

    Args:
        path: the file.
        nominal: the robot as the controller has it without the file; names and limits are taken from it, and base and
            tool where the file has none.

    Raises:
        RobotError: the file cannot be read, is none of these, or does not fit the robot.
    """
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise RobotError(f"{path}: a file of a controller was wanted, which ends in {', '.join(READERS)}.")
    return reader(read_text(path, RobotError, "text"), str(path), nominal)
