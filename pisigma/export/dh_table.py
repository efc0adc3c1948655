"""DH + Hayati tables of a robot as CSV and YAML, in millimetres and degrees with all digits."""

import csv
import io

import numpy as np

from pisigma.robot.description import Robot
from pisigma.robot.row import DH_COLUMNS, FRAME_COLUMNS
from pisigma.robot.writing import robot_to_yaml

CONVENTION = (
    "A_i = RotZ(theta_i + direction q_i) Trans(a_i, 0, d_i) RotX(alpha_i) RotY(beta_i), a prismatic joint adds "
    "to d_i instead; T_base_tool = base A_1 ... A_n tool, where base and tool are "
    "Trans(x, y, z) RotZ(roll) RotY(pitch) RotX(yaw)."
)

_LENGTHS = {"d", "a", "x", "y", "z"}


def dh_yaml(robot: Robot, comments: tuple[str, ...] = ()) -> str:
    """The robot as a robot file, which `Robot.load` reads back, with sentences on top."""
    return head((CONVENTION, *comments)) + robot_to_yaml(robot)


def dh_csv(robot: Robot, comments: tuple[str, ...] = ()) -> str:
    """The robot as a table: base, one line a row, tool; cells that do not apply are empty.

    Lines at the top that begin with # hold the convention and the sentences given.
    """
    text = io.StringIO()
    limits = ("lower_deg", "upper_deg", "lower_mm", "upper_mm")
    parameters = [in_units(name) for name in (*DH_COLUMNS, *FRAME_COLUMNS)]
    columns = ("part", "name", "type", "direction", *limits, *parameters)
    writer = csv.DictWriter(text, columns, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerow({"part": "base", **cells(FRAME_COLUMNS, robot.base)})
    for row, values in zip(robot.rows, robot.dh, strict=True):
        line = {"part": "row", "name": row.name, "type": row.type, "direction": str(row.direction)}
        for side, limit in (("lower", row.lower), ("upper", row.upper)):
            if np.isfinite(limit):
                revolute = row.type == "revolute"
                line[f"{side}_deg" if revolute else f"{side}_mm"] = (
                    repr(float(np.rad2deg(limit))) if revolute else repr(float(limit * 1e3))
                )
        writer.writerow(line | cells(DH_COLUMNS, values))
    writer.writerow({"part": "tool", **cells(FRAME_COLUMNS, robot.tool)})
    return head((CONVENTION, *comments)) + text.getvalue()


def in_units(name: str) -> str:
    """The column of a parameter."""
    return f"{name}_mm" if name in _LENGTHS else f"{name}_deg"


def cells(names: tuple[str, ...], values: np.ndarray) -> dict[str, str]:
    """Parameters by column [mm, deg], with all digits."""
    return {in_units(name): repr(value) for name, value in file_values(names, values).items()}


def file_values(names: tuple[str, ...], values: np.ndarray) -> dict[str, float]:
    """Parameters by name [mm, deg]."""
    return {
        name: float(value * 1e3 if name in _LENGTHS else np.rad2deg(value))
        for name, value in zip(names, values, strict=True)
    }


def head(sentences: tuple[str, ...]) -> str:
    """Sentences as lines that begin with #."""
    return "".join(f"# {' '.join(sentence.split())}\n" for sentence in sentences)
