"""Reading of controller files, and of the tables of joint offsets that `pisigma export` writes, as robots."""

import csv
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pisigma.deployment.export.approximation import Departure, departure_from_nominal, joint_offsets
from pisigma.deployment.export.controllers import staubli, universal_robots, ur_ros
from pisigma.deployment.export.controllers.controller_file import (
    ControllerFile,
    Convention,
    Frames,
    with_frames,
)
from pisigma.deployment.export.joint_offsets import joints_by_axes
from pisigma.files.errors import Phrase, Place, RobotError
from pisigma.files.input_file import read_text
from pisigma.files.yaml_file import parse_plain_yaml
from pisigma.robot.description import Robot
from pisigma.robot.robot_file import FrameSection
from pisigma.robot.row import Row

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
        deviation_from_nominal: distance between its tool and that of the nominal robot, in the same frame.
        frames: frames of the controller relative to frames of the nominal robot; None if they are equal.
        remarks: sentences on the description of the format, its tests, and the frames of poses.
    """

    robot: Robot
    deviation_from_nominal: Departure
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


def read_offsets(text: str, source: str, nominal: Robot) -> Robot:
    """Apply a table of joint offsets to the nominal robot, with base and tool of the table.

    The table is CSV or YAML as written by `--format offsets`, or CSV with counts, which then determine the offsets.

    Raises:
        RobotError: an entry is missing or not a number, or the joints differ from the joints of the robot.
    """
    entries = _csv_entries(text) if text.lstrip("# ").find("part,") >= 0 else _yaml_entries(text, source)
    joints = {str(entry.get("name")): entry for entry in entries if entry.get("part") == "joint"}
    if set(joints) != {axis.name for axis in nominal.axes}:
        names = ", ".join(axis.name for axis in nominal.axes)
        raise RobotError(
            expected=f"offsets of the joints {names}",
            value=Phrase(", ".join(joints) or "none"),
            at=Place(source),
        )
    offsets = np.array([_offset(axis, joints[axis.name], source) for axis in nominal.axes])
    dh = nominal.dh.copy()
    dh.reshape(-1)[list(joint_offsets(nominal))] += joints_by_axes(nominal) @ offsets
    frames = {
        str(entry["part"]): _frame(entry, source)
        for entry in entries
        if entry.get("part") in ("base", "tool")
    }
    return nominal.with_geometry(dh=dh, base=frames.get("base"), tool=frames.get("tool"))


def _csv_entries(text: str) -> list[Mapping[str, object]]:
    lines = (line for line in text.splitlines() if not line.startswith("#"))
    return [dict(line) for line in csv.DictReader(lines)]


def _yaml_entries(text: str, source: str) -> list[Mapping[str, object]]:
    content = parse_plain_yaml(text, RobotError, source)
    joints = content.get("joints") if isinstance(content, dict) else None
    if not isinstance(joints, list) or not all(isinstance(joint, dict) for joint in joints):
        raise RobotError(
            expected="a table of joint offsets as written by --format offsets",
            at=Place(source, column="joints"),
        )
    frames = [
        {"part": part, **content[part]} for part in ("base", "tool") if isinstance(content.get(part), dict)
    ]
    return [*({"part": "joint", **joint} for joint in joints), *frames]


def _offset(axis: Row, entry: Mapping[str, object], source: str) -> float:
    """Return the offset [rad or m], from the counts if there are some."""
    turn, millimetre = 2 * np.pi, 1e-3
    if entry.get("new_count"):
        present, new, per_turn = (
            _number(entry, column, source) for column in ("present_count", "new_count", "counts_per_turn")
        )
        return (present - new) / per_turn * (turn if axis.type == "revolute" else millimetre)
    value = _number(entry, f"offset_{axis.file_unit}", source)
    return float(np.deg2rad(value)) if axis.type == "revolute" else value * millimetre


def _frame(entry: Mapping[str, object], source: str) -> np.ndarray:
    columns = FrameSection.model_fields
    return FrameSection(**{column: _number(entry, column, source) for column in columns}).to_si()


def _number(entry: Mapping[str, object], column: str, source: str) -> float:
    try:
        value = float(str(entry.get(column)))
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise RobotError(
            f"expected a finite number for {entry.get('name', entry.get('part'))}, got {entry.get(column)!r}",
            expected="a finite number",
            value=entry.get(column),
            at=Place(source, column=column),
        )
    return value
