"""Reading of controller files as robots."""

from dataclasses import dataclass, replace
from pathlib import Path

from pisigma.deployment.export.approximation import Departure, departure_from_nominal
from pisigma.deployment.export.controllers import staubli, universal_robots, ur_ros
from pisigma.deployment.export.controllers.controller_file import (
    ControllerFile,
    Convention,
    Frames,
    with_frames,
)
from pisigma.deployment.export.controllers.offset_table import read_offsets
from pisigma.files.errors import Place, RobotError
from pisigma.files.input_file import read_text
from pisigma.robot.description import Robot

MAX_CHANGE = 5.0
"""Largest plausible mean distance [mm] between the tools of a calibrated and the nominal robot on the same base; the
largest in five published calibrations of Universal Robots arms is 4.2 mm."""

_LEVER = 0.1
"""Distance from the flange [m] of points to which the limit also applies, so that rotations of the flange count."""

_READERS: dict[str, ControllerFile | None] = {
    ".conf": universal_robots.FILE,
    ".cfx": staubli.FILE,
    ".csv": None,
    ".yaml": None,
    ".yml": None,
}
"""Kinds of manufacturers' files by suffix; None for tables of pisigma. The kinematics of a ROS driver are also YAML."""


@dataclass(frozen=True, eq=False)
class ControllerReading:
    """Result of reading a controller's file.

    Attributes:
        robot: nominal robot with the parameters of the file; its `source` names the file and the frames of its poses.
        change: distance between its tool and that of the nominal robot, in the same frame.
        frames: frames of the controller relative to frames of the nominal robot; None if they are equal.
        remarks: sentences on the description of the format, its tests, and the frames of poses.
    """

    robot: Robot
    change: Departure
    frames: Frames | None
    remarks: tuple[str, ...]


def read_controller_file(path: Path, nominal: Robot, max_change: float = MAX_CHANGE) -> ControllerReading:
    """Read a controller's file as a robot.

    Supported files are Universal Robots' calibration.conf, the kinematics YAML of their ROS driver, Staubli's arm.cfx,
    and tables of joint offsets or counts written by pisigma. Xacro and URDF files need no nominal robot; load them with
    `Robot.load`.

    Args:
        path: file to read.
        nominal: robot of the controller without the file, which provides names and limits, and base and tool if the
            file has none.
        max_change: largest accepted mean distance [mm] between the two tools in the same frame, and between points at
            `_LEVER` from them due to their rotations.

    Raises:
        RobotError: the file cannot be read, is of another kind, does not match the robot, or changes it by more than
            `max_change`.
    """
    suffix = path.suffix.lower()
    if suffix not in _READERS:
        raise RobotError(
            expected=f"a controller's file with the suffix {' or '.join(_READERS)}",
            value=suffix,
            at=Place(path),
        )
    text = read_text(path, RobotError, "text")
    kinematics = suffix != ".csv" and any(line.startswith("kinematics:") for line in text.splitlines())
    file = ur_ros.FILE if kinematics else _READERS[suffix]
    read = read_offsets if file is None or file.read is None else file.read
    robot = read(text, str(path), nominal)
    convention = file.convention(nominal) if file else Convention(nominal)
    # The base and tool of the file define the frames of its poses and are not treated as changes by the calibration.
    there = nominal.with_geometry(base=robot.base, tool=robot.tool)
    change = departure_from_nominal(robot, with_frames(convention.nominal, text) if file else there)
    if not max(change.mean_mm, _LEVER * change.mean_mrad) <= max_change:
        raise RobotError(
            f"expected a calibration that moves the tool by at most {max_change:g} mm and {max_change / _LEVER:g} mrad "
            f"on average, got {change.mean_mm:.4g} mm and {change.mean_mrad:.4g} mrad relative to robot "
            f"'{nominal.name}'",
            expected=f"a mean change of at most {max_change:g} mm",
            value=change.mean_mm,
            at=Place(path),
            remedy="check that --like is the robot of this file and that its units are radians and metres, or state "
            "--max-change-mm",
        )
    frames = convention.frames
    source = f"Read from {path.name} with the nominal robot '{nominal.name}'."
    source = f"{source} {frames.sentence}" if frames else source
    remarks = (
        (file.source, *convention.remarks)
        if file
        else ("Tables of offsets and counts are a format of pisigma.",)
    )
    return ControllerReading(replace(robot, source=source), change, frames, remarks)
