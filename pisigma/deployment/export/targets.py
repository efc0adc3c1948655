"""Corrected targets as a table in millimetres and degrees with full precision, or as a program."""

import csv
import io
import math
from collections import Counter

import numpy as np
import torch

from pisigma.deployment.export.dh_table import header_comment
from pisigma.deployment.export.export_format import Exported, ExportFormat, ExportRequest
from pisigma.deployment.export.programs.languages import LANGUAGES, cautions, check_program, program_text
from pisigma.deployment.export.programs.targets import Targets, targets_of
from pisigma.deployment.export.programs.text import millimetres_and_euler
from pisigma.deployment.export.rewriting.export import SCANNERS, check_rewriting, rewrite_program
from pisigma.files.errors import OutputError, Place, check_choice
from pisigma.measurement.csv.poses import read_poses
from pisigma.model.inverse.corrected_ik import load
from pisigma.planning.plan_file import joint_columns
from pisigma.robot.row import FRAME_COLUMNS, in_file_units

_KINDS = ("joints", "cartesian")
POSE_COLUMNS = tuple(in_file_units(FRAME_COLUMNS, np.zeros(6)))


def sentences(targets: Targets) -> tuple[str, ...]:
    """Return the comments at the top of the table."""
    frames = {
        part: ", ".join(
            f"{column} {value + 0.0:.9g}"
            for column, value in in_file_units(FRAME_COLUMNS, getattr(targets.robot, part)).items()
        )
        for part in ("base", "tool")
    }
    return (
        targets.title,
        "q: joint values to command, with the zeros and directions of the robot description.",
        "x to yaw: pose of the nominal robot at q, FK_nominal(q), to command to a controller that computes with the "
        "nominal robot, this base and this tool. Rotation = RotZ(roll) RotY(pitch) RotX(yaw).",
        f"Nominal robot: {targets.robot.name}; base: {frames['base']}; tool: {frames['tool']}.",
        "sigma: predicted standard deviation of the reached position; empty if it is not known.",
        *targets.remarks,
    )


def targets_csv(targets: Targets) -> str:
    """Return CSV with one row per pose; the values of a pose without a target are empty.

    Columns are line (in the file of poses), status, branch, the joint values to command, the nominal robot's pose at
    these joint values, and the predicted accuracy (1 sigma).
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("line", "status", "branch", *joint_columns(targets.robot), *POSE_COLUMNS, "sigma_mm"))
    turns = torch.tensor([axis.type == "revolute" for axis in targets.robot.axes])
    q = torch.where(turns, torch.rad2deg(targets.q), targets.q * 1e3)
    pose = millimetres_and_euler(targets.T)
    # The safe angle functions return finite angles for a matrix of NaN, so the gaps are taken from q.
    pose = torch.where(torch.isfinite(q).all(-1, keepdim=True), pose, torch.nan)
    values = torch.cat([q, pose, targets.deviation[:, None] * 1e3], -1).tolist()
    for line, status, branch, row in zip(targets.line, targets.status, targets.branch, values, strict=True):
        cells = ["" if math.isnan(value) else repr(value) for value in row]
        writer.writerow([line, status.name.lower(), branch, *cells])
    return header_comment(sentences(targets)) + text.getvalue()


def _check(request: ExportRequest) -> None:
    if request.poses is not None and request.program is not None:
        raise OutputError(
            "the option cannot be combined with --program", option="--poses", remedy="give only one of them"
        )
    if request.poses is None and request.program is None:
        raise OutputError(
            "--format targets needs poses", option="--poses", remedy="give --poses, or a --program with poses"
        )
    if request.program is not None:
        check_rewriting(request)
    elif request.out.suffix.lower() in set(SCANNERS) - set(LANGUAGES):
        raise OutputError(
            "files of this kind can be written only with --program",
            option="--out",
            value=request.out.suffix,
            at=Place(request.out),
            remedy="choose a .csv file or a program",
        )
    elif request.frames is not None or request.tolerance_mm is not None:
        option = "--frames" if request.frames is not None else "--tolerance-mm"
        raise OutputError("the option applies only to a --program", option=option, remedy="omit it")


def _check_options(request: ExportRequest) -> None:
    """Check that the options can be combined."""
    kind = request.targets
    if kind is not None:
        check_choice(OutputError, "--targets", kind, _KINDS)
    if request.is_csv:
        for name, value in (("--targets", kind), ("--config", request.config)):
            if value is not None:
                raise OutputError(
                    "the option applies only to programs, because a .csv file includes all targets",
                    option=name,
                    value=value,
                    remedy="omit it",
                )


def _write(request: ExportRequest) -> Exported:
    """Return the exported targets, with warnings."""
    if request.program is not None:
        return rewrite_program(request)
    _check_options(request)
    assert request.poses is not None  # checked in `_check`
    table, cartesian = request.is_csv, request.targets == "cartesian"
    solver = load(request.model)
    if request.conditions:
        solver = solver.under(**request.conditions)
    if not table:
        check_program(request.out, solver.model.robot, cartesian, request.config)
    wanted = read_poses(request.poses)
    solution = solver(wanted.T, branch=request.branch)
    targets = targets_of(solution, str(request.poses), wanted.line, accuracy=table)
    statuses = Counter(status.name.lower() for status in targets.status).most_common()
    return Exported(
        content=targets_csv(targets)
        if table
        else program_text(targets, request.out, cartesian, request.config),
        facts={
            "targets": "both" if table else request.targets or _KINDS[0],
            "robot": targets.robot.name,
            "rows": len(targets.line),
            "statuses": dict(statuses),
        },
        warnings=(
            *([targets.domain_warning] if targets.domain_warning else []),
            *(() if table else cautions(request.out, cartesian)),
        ),
        summary=f"Targets for {len(targets.line)} poses",
        details=": " + ", ".join(f"{count} {status}" for status, count in statuses),
        failure=targets.failure_sentence,
    )


FORMAT = ExportFormat(
    "targets",
    "a table or program of targets",
    (".csv", *SCANNERS),
    _write,
    frozenset(
        (
            "poses",
            "program",
            "frames",
            "tolerance_mm",
            "targets",
            "branch",
            "config",
            "payload_kg",
            "temperature_c",
        )
    ),
    _check,
    contains="joint_values",
)
