"""Corrected targets as a table in millimetres and degrees with full precision, as a program, or in an existing one."""

import csv
import io
import math
from collections import Counter
from collections.abc import Callable

import numpy as np
import torch

from pisigma.deployment.export.dh_table import header_comment
from pisigma.deployment.export.export_format import Exported, ExportFormat, ExportRequest
from pisigma.deployment.export.geometry import pose_remarks
from pisigma.deployment.export.programs.languages import LANGUAGES, cautions, check_program, program_text
from pisigma.deployment.export.programs.targets import Targets, targets_of
from pisigma.deployment.export.programs.text import millimetres_and_euler
from pisigma.deployment.export.rewriting.correction import CorrectedProgram, ProgramCorrection
from pisigma.deployment.export.rewriting.fanuc import scan_fanuc
from pisigma.deployment.export.rewriting.frame_file import FrameFile
from pisigma.deployment.export.rewriting.krl import scan_krl, scan_krl_data
from pisigma.deployment.export.rewriting.rapid import scan_rapid
from pisigma.deployment.export.rewriting.scan import ScannedProgram
from pisigma.deployment.export.rewriting.urscript import scan_urscript
from pisigma.files.errors import OutputError, Phrase, Place, check_choice
from pisigma.files.input_file import read_input
from pisigma.measurement.csv.poses import read_poses
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.inverse.loading import load
from pisigma.planning.plan_file import joint_columns
from pisigma.robot.row import FRAME_COLUMNS, in_file_units

_KINDS = ("joints", "cartesian")
POSE_COLUMNS = tuple(in_file_units(FRAME_COLUMNS, np.zeros(6)))
SCANNERS: dict[str, Callable[[str, FrameFile], ScannedProgram]] = {
    ".script": scan_urscript,
    ".src": scan_krl,
    ".dat": scan_krl_data,
    ".mod": scan_rapid,
    ".ls": scan_fanuc,
}
"""Scanners by the suffix of the file."""
_TOLERANCE_MM = 0.1
MAX_BYTES = 2**24
_MAX_JOINTS = 6
TEST = (
    "TEST IT AT LOW SPEED FIRST: the controller has to compute with the nominal robot, its accuracy options have to be "
    "off, and its origin and flange have to be those of the robot description. Targets given as joint values, outputs, "
    "waits and speeds are unchanged; nothing was checked for collisions."
)


def target_comments(targets: Targets) -> tuple[str, ...]:
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
        "sigma: predicted standard deviation of the reached position, sqrt(sx^2 + sy^2 + sz^2) of its coordinates; "
        "empty if it is not known.",
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
    pose = millimetres_and_euler(targets.T_nominal)
    # The safe angle functions return finite angles for a matrix of NaN, so the gaps are taken from q.
    pose = torch.where(torch.isfinite(q).all(-1, keepdim=True), pose, torch.nan)
    values = torch.cat([q, pose, targets.sigma[:, None] * 1e3], -1).tolist()
    for line, status, branch, row in zip(targets.line, targets.status, targets.branch, values, strict=True):
        cells = ["" if math.isnan(value) else repr(value) for value in row]
        writer.writerow([line, status.name.lower(), branch, *cells])
    return header_comment(target_comments(targets)) + text.getvalue()


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
        raise OutputError("the option applies only with --program", option=option, remedy="omit it")


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
        remarks=targets.remarks,
        warnings=(
            *([targets.domain_warning] if targets.domain_warning else []),
            *(() if table else cautions(request.out, cartesian)),
        ),
        sentence_start=f"Targets for {len(targets.line)} poses",
        sentence_end=": " + ", ".join(f"{count} {status}" for status, count in statuses),
        failure=targets.failure_sentence,
    )


def check_rewriting(request: ExportRequest) -> None:
    """Check the options for a program.

    Raises:
        OutputError: the program's language is unknown or differs from that of the output file, or an option is invalid.
    """
    assert request.program is not None
    suffix = request.program.suffix.lower()
    if suffix not in SCANNERS or request.out.suffix.lower() != suffix:
        raise OutputError(
            expected=f"a program ({', '.join(SCANNERS)}) and an --out file with the same suffix",
            value=Phrase(f"{suffix} and {request.out.suffix}"),
            at=Place(request.program),
            option="--program" if suffix not in SCANNERS else "--out",
        )
    for name, value in (("targets", request.targets), ("config", request.config)):
        if value is not None:
            raise OutputError(
                "the option applies only to --poses, because the poses of a program remain poses",
                option=f"--{name}",
                value=value,
                remedy="omit it",
            )
    if request.tolerance_mm is not None and not 0 < request.tolerance_mm < float("inf"):
        raise OutputError(expected="a length > 0 mm", value=request.tolerance_mm, option="--tolerance-mm")


def rewrite_program(request: ExportRequest) -> Exported:
    """Return a program with corrected targets, where the targets are understood, and a report of the changes.

    Raises:
        OutputError: the program cannot be read, or has no target whose frame and tool are stated.
    """
    assert request.program is not None
    # Characters beyond ASCII occur only in comments; this encoding preserves every byte.
    text = read_input(request.program, OutputError, MAX_BYTES).decode("latin-1")
    scanned = SCANNERS[request.program.suffix.lower()](text, FrameFile.read(request.frames))
    if not scanned.targets:
        named = (
            _listed([f"line {line}: {reason}" for line, reason in scanned.unchanged_lines])
            or "it contains no poses, or only joint values"
        )
        raise OutputError(
            f"the program has no pose that can be rewritten: {named}",
            at=Place(request.program),
            value=len(scanned.unchanged_lines),
        )
    solver = load(request.model)
    if request.conditions:
        solver = solver.under(**request.conditions)
    if solver.model.robot.dof > _MAX_JOINTS:
        raise OutputError(
            f"expected a robot with at most {_MAX_JOINTS} joints, got {solver.model.robot.dof}, because the poses of a "
            "program do not determine further joints",
            expected=f"at most {_MAX_JOINTS} joints",
            value=solver.model.robot.dof,
            option="--program",
            remedy="export --poses with joint values instead",
        )
    tolerance = _TOLERANCE_MM if request.tolerance_mm is None else request.tolerance_mm
    corrected = ProgramCorrection(solver, request.branch, tolerance / 1e3).correct_program(scanned)
    return _exported(request, solver.model, scanned, corrected, tolerance)


def _exported(
    request: ExportRequest,
    model: CalibratedModel,
    scanned: ScannedProgram,
    corrected: CorrectedProgram,
    tolerance_mm: float,
) -> Exported:
    """Return the result with the new program, facts and warnings."""
    assert request.program is not None
    diff = corrected.diff(scanned.text, (str(request.program), str(request.out)))
    language = LANGUAGES.get(request.program.suffix.lower())
    reached = len(corrected.statuses) - len(corrected.unreached_lines)
    shift = corrected.largest_shift * 1e3
    return Exported(
        content=corrected.text.encode("latin-1"),
        facts={
            "robot": model.robot.name,
            "program": str(request.program),
            "targets": len(corrected.statuses),
            "statuses": dict(Counter(status.name.lower() for _, status in corrected.statuses)),
            "unreached": [
                {"line": line, "status": status.name.lower()} for line, status in corrected.unreached_lines
            ],
            "branches": list(corrected.branches),
            "way_points": corrected.waypoint_count,
            "tolerance_mm": tolerance_mm,
            "largest_shift_mm": shift,
            "left_alone": [{"line": line, "reason": reason} for line, reason in corrected.unchanged_lines],
            "joint_lines": list(scanned.joint_lines),
            "diff": diff,
        },
        remarks=pose_remarks(model),
        warnings=(
            TEST,
            *(language.cartesian_cautions if language else ()),
            *_warnings(corrected, str(request.program)),
        ),
        sentence_start=f"Program with {reached} corrected targets (by {shift:.3f} mm at most) "
        f"and {corrected.waypoint_count} waypoints",
        missed_limit=_shortfall(corrected, str(request.program)),
        leading_text=diff,
    )


def _warnings(corrected: CorrectedProgram, source: str) -> tuple[str, ...]:
    """Return warnings about branches of targets, and about targets that were not changed."""
    sentences = [
        f"Targets are corrected for the branch {' and '.join(corrected.branches) or 'of the model'}. The program's "
        "configuration was not checked: if the arm is in another configuration, use --branch."
    ]
    if corrected.unchanged_lines:
        unchanged = "; ".join(f"line {line}: {reason}" for line, reason in corrected.unchanged_lines)
        sentences.append(f"Left unchanged in {source}: {unchanged}.")
    return tuple(sentences)


def _shortfall(corrected: CorrectedProgram, source: str) -> str | None:
    if not corrected.unreached_lines:
        return None
    line, status = corrected.unreached_lines[0]
    others = _listed([f"line {n} {s.name.lower()}" for n, s in corrected.unreached_lines[1:]])
    also = f" (Also: {others}.)" if others else ""
    return f"{source}, line {line}: {status.name.lower()}, so the line is unchanged. {status.sentence}{also}"


def _listed(sentences: list[str], most: int = 10) -> str:
    more = [f"and {len(sentences) - most} more"] if len(sentences) > most else []
    return "; ".join([*sentences[:most], *more])


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
