"""Controllers' own files read back as robots."""

from dataclasses import dataclass, replace
from pathlib import Path

from pisigma.deployment.export.controllers import staubli, universal_robots, ur_ros
from pisigma.deployment.export.controllers.controller_file import (
    ControllerFile,
    Convention,
    Frames,
    with_frames,
)
from pisigma.deployment.export.controllers.offset_table import read_offsets
from pisigma.deployment.export.projection import Departure, departure_from_drawn
from pisigma.files.errors import RobotError
from pisigma.files.input_file import read_text
from pisigma.robot.description import Robot

MAX_CHANGE = 5.0
"""Mean distance [mm] of the tool from that of the nominal robot, on the same base, that a calibration makes at most: of
five published ones of Universal Robots 4.2 mm is the largest."""

LEVER = 0.1
"""[m] So far from the flange the distance holds, too: a turned flange moves no other point."""

READERS: dict[str, ControllerFile | None] = {
    ".conf": universal_robots.FILE,
    ".cfx": staubli.FILE,
    ".csv": None,
    ".yaml": None,
    ".yml": None,
}
"""By the suffix of the file, which is of a maker or, where it is None, a table of pisigma; the kinematics of a ROS
driver are YAML too."""


@dataclass(frozen=True, eq=False)
class ControllerReading:
    """What a controller's own file says.

    Attributes:
        robot: as the file makes it of the nominal one; its `source` names the file and the frames of its poses.
        change: how far its tool is from that of the nominal robot, in the same frame.
        frames: how the controller's frames lie to those of the nominal robot; None where they are the same.
        remarks: where the kind of file is described, what it was tried against, and in which frames poses are.
    """

    robot: Robot
    change: Departure
    frames: Frames | None
    remarks: tuple[str, ...]


def read_controller_file(path: Path, nominal: Robot, max_change: float = MAX_CHANGE) -> ControllerReading:
    """The robot that a controller's own file makes of the nominal one.

    Files are Universal Robots' calibration.conf and the kinematics YAML of their ROS driver, Staubli's arm.cfx, and
    tables of joint offsets or counts that pisigma wrote. A file of xacro or URDF needs no nominal robot: load it with
    `Robot.load`.

    Args:
        path: the file.
        nominal: the robot as the controller has it without the file; names and limits are taken from it, and base and
            tool where the file has none.
        max_change: mean distance [mm] of the two tools, and of points `LEVER` from them by their rotations, in the same
            frame, above which the file is refused.

    Raises:
        RobotError: the file cannot be read, is none of these, does not fit the robot, or changes it by more than
            `max_change`.
    """
    suffix = path.suffix.lower()
    if suffix not in READERS:
        raise RobotError(f"{path}: a file of a controller was wanted, which ends in {', '.join(READERS)}.")
    text = read_text(path, RobotError, "text")
    kinematics = suffix != ".csv" and any(line.startswith("kinematics:") for line in text.splitlines())
    file = ur_ros.FILE if kinematics else READERS[suffix]
    read = read_offsets if file is None or file.read is None else file.read
    robot = read(text, str(path), nominal)
    convention = file.convention(nominal) if file else Convention(nominal)
    # Base and tool that the file states belong to the poses, not to the calibration, which moves base and tool, too.
    there = nominal.with_geometry(base=robot.base, tool=robot.tool)
    change = departure_from_drawn(robot, with_frames(convention.nominal, text) if file else there)
    if not max(change.mean_mm, LEVER * change.mean_mrad) <= max_change:
        raise RobotError(
            f"{path}: expected a calibration that moves the tool by {max_change:g} mm and {max_change / LEVER:g} mrad "
            f"in the mean at most, got {change.mean_mm:.4g} mm and {change.mean_mrad:.4g} mrad against robot "
            f"'{nominal.name}'; check that --like is the robot of this file and that its units are radians and metres, "
            "or state --max-change-mm."
        )
    frames = convention.frames
    source = f"Read from {path.name} with the nominal robot '{nominal.name}'."
    source = f"{source} {frames.said}" if frames else source
    remarks = (
        (file.source, *convention.remarks) if file else ("Tables of offsets and counts are pisigma's own.",)
    )
    return ControllerReading(replace(robot, source=source), change, frames, remarks)
