"""DH + Hayati tables of a robot as CSV, YAML and JSON, in millimetres and degrees at full precision."""

import csv
import io
import json
from collections.abc import Iterable, Mapping

import numpy as np

from pisigma.deployment.export.export_format import Exported, ExportFormat, ExportRequest, model_facts
from pisigma.deployment.export.geometry import check_geometry, chosen_geometry
from pisigma.robot.coupling_section import coupling_document
from pisigma.robot.description import Robot
from pisigma.robot.row import DH_COLUMNS, FRAME_COLUMNS, in_file_units
from pisigma.robot.writing import robot_document, robot_to_yaml

CONVENTION = (
    "A_i = RotZ(theta_i + direction q_i) Trans(a_i, 0, d_i) RotX(alpha_i) RotY(beta_i), a prismatic joint adds "
    "to d_i instead; T_base_tool = base A_1 ... A_n tool, where base and tool are "
    "Trans(x, y, z) RotZ(roll) RotY(pitch) RotX(yaw)."
)

TABLE_SUFFIXES: tuple[str, ...] = (".csv", ".yaml", ".yml")


def dh_yaml(robot: Robot, comments: tuple[str, ...] = ()) -> str:
    """Return a robot file, which `Robot.load` reads, with comments at the top."""
    return header_comment((CONVENTION, *comments)) + robot_to_yaml(robot)


def dh_json(robot: Robot, comments: tuple[str, ...] = ()) -> str:
    """Write the values of a robot file as JSON, with the convention and comments; keys end with the unit."""
    document = {"convention": CONVENTION, "remarks": list(comments), **robot_document(robot)}
    return json.dumps(document, indent=2) + "\n"


def dh_csv(robot: Robot, comments: tuple[str, ...] = ()) -> str:
    """Return the robot as a CSV table of base, one line per row, and tool; cells that do not apply are empty.

    Lines at the top that start with # state the convention and the comments.
    """
    limits = ("lower_deg", "upper_deg", "lower_mm", "upper_mm")
    parameters = (*in_file_units(DH_COLUMNS, robot.dh[0]), *in_file_units(FRAME_COLUMNS, robot.base))
    columns = ("part", "name", "type", "direction", *limits, *parameters)
    lines = [{"part": "base", **parameter_columns(FRAME_COLUMNS, robot.base)}]
    for row, values in zip(robot.rows, robot.dh, strict=True):
        line = {"part": "row", "name": row.name, "type": row.type, "direction": str(row.direction)}
        for side, limit in (("lower", row.lower), ("upper", row.upper)):
            if np.isfinite(limit):
                line[f"{side}_{row.file_unit}"] = repr(row.in_file_unit(limit))
        lines.append(line | parameter_columns(DH_COLUMNS, values))
    lines.append({"part": "tool", **parameter_columns(FRAME_COLUMNS, robot.tool)})
    return csv_table(columns, lines, (CONVENTION, *_coupling_sentences(robot), *comments))


def _coupling_sentences(robot: Robot) -> tuple[str, ...]:
    """Return a comment on the coupling of joints; the table itself contains only limits of the joints."""
    if robot.coupling is None:
        return ()
    stated = json.dumps(coupling_document(robot.coupling, robot.joints))
    return (
        f"q_i are joint values, which follow from the controller's values as in a robot file: coupling: {stated}",
    )


def csv_table(
    columns: Iterable[str], lines: Iterable[Mapping[str, object]], sentences: tuple[str, ...]
) -> str:
    """Return lines as CSV with comments at the top; missing cells of a line are empty."""
    text = io.StringIO()
    writer = csv.DictWriter(text, tuple(columns), restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    return header_comment(sentences) + text.getvalue()


def parameter_columns(names: tuple[str, ...], values: np.ndarray) -> dict[str, str]:
    """Return parameters by column [mm, deg], with full precision."""
    return {column: repr(value) for column, value in in_file_units(names, values).items()}


def header_comment(sentences: tuple[str, ...]) -> str:
    """Format sentences as lines that start with #."""
    return "".join(f"# {' '.join(sentence.split())}\n" for sentence in sentences)


def _write(request: ExportRequest) -> Exported:
    model = request.load()
    chosen = chosen_geometry(model, request.geometry)
    write = {".csv": dh_csv, ".json": dh_json}.get(request.out.suffix.lower(), dh_yaml)
    return Exported(
        write(chosen.robot, chosen.comments), model_facts(model) | {"geometry": chosen.name}, chosen.comments
    )


FORMAT = ExportFormat(
    "dh",
    "a DH table",
    (*TABLE_SUFFIXES, ".json"),
    _write,
    frozenset(("geometry",)),
    check_geometry,
    "kinematics",
)
