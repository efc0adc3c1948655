"""Reading of the tables of joint offsets that `pisigma export` writes."""

import csv
from collections.abc import Mapping

import numpy as np

from pisigma.deployment.export.approximation import joint_offsets
from pisigma.deployment.export.joint_offsets import joints_by_axes
from pisigma.files.errors import Phrase, Place, RobotError
from pisigma.files.yaml_file import plain_content
from pisigma.robot.description import Robot
from pisigma.robot.robot_file import FrameSection
from pisigma.robot.row import Row


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
    content = plain_content(text, RobotError, source)
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
