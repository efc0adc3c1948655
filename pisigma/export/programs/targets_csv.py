"""Corrected targets as a table for any robot, in millimetres and degrees with all digits."""

import csv
import io
import math

import torch

from pisigma.export.dh_table import file_values, head, in_units
from pisigma.export.programs.targets import Targets
from pisigma.export.programs.text import millimetres_and_euler
from pisigma.robot.row import FRAME_COLUMNS

POSE_COLUMNS = tuple(in_units(name) for name in FRAME_COLUMNS)


def joint_columns(targets: Targets) -> list[str]:
    """The names of the columns of joint values."""
    return [f"q{i}_{'deg' if turns else 'mm'}" for i, turns in enumerate(targets.robot.revolute, 1)]


def sentences(targets: Targets) -> tuple[str, ...]:
    """What stands on top of the table."""
    frames = {
        part: ", ".join(
            f"{in_units(name)} {value + 0.0:.9g}"
            for name, value in file_values(FRAME_COLUMNS, getattr(targets.robot, part)).items()
        )
        for part in ("base", "tool")
    }
    return (
        targets.title,
        "q: joint values to command, with the zeros and directions of the description of that robot.",
        "x to yaw: where the nominal robot stands at q, FK_nominal(q): what a controller that computes with "
        "the robot as drawn has to be told, on this base and with this tool. Rotation = RotZ(roll) RotY(pitch) "
        "RotX(yaw).",
        f"Nominal robot: {targets.robot.name} as drawn; base: {frames['base']}; tool: {frames['tool']}.",
        "sigma: predicted standard deviation of the position reached; empty where it is not known.",
        *targets.remarks,
    )


def targets_csv(targets: Targets) -> str:
    """One row a pose; the values of a pose without target are empty.

    Columns are line (in the file of poses), status, branch, the joint values to command, the pose that the
    nominal robot takes there, and the predicted accuracy (1 sigma).
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("line", "status", "branch", *joint_columns(targets), *POSE_COLUMNS, "sigma_mm"))
    turns = torch.tensor(targets.robot.revolute)
    q = torch.where(turns, torch.rad2deg(targets.q), targets.q * 1e3)
    pose = millimetres_and_euler(targets.T)
    # The angles of a matrix of NaN are finite where the functions are made safe, so the gaps come from q.
    pose = torch.where(torch.isfinite(q).all(-1, keepdim=True), pose, torch.nan)
    values = torch.cat([q, pose, targets.deviation[:, None] * 1e3], -1).tolist()
    for line, status, branch, row in zip(targets.line, targets.status, targets.branch, values, strict=True):
        cells = ["" if math.isnan(value) else repr(value) for value in row]
        writer.writerow([line, status.name.lower(), branch, *cells])
    return head(sentences(targets)) + text.getvalue()
