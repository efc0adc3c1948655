"""`--format targets --program`: an existing program with corrected targets, and what has changed."""

from collections import Counter
from collections.abc import Callable

from pisigma.deployment.export.export_format import Exported, ExportRequest
from pisigma.deployment.export.geometry import condition_remarks, frame_remarks
from pisigma.deployment.export.programs.languages import LANGUAGES
from pisigma.deployment.export.rewriting.correction import CorrectedProgram, ProgramCorrection
from pisigma.deployment.export.rewriting.fanuc import scan_fanuc
from pisigma.deployment.export.rewriting.frame_file import FrameFile
from pisigma.deployment.export.rewriting.krl import scan_krl, scan_krl_data
from pisigma.deployment.export.rewriting.rapid import scan_rapid
from pisigma.deployment.export.rewriting.scan import ScannedProgram
from pisigma.deployment.export.rewriting.urscript import scan_urscript
from pisigma.files.errors import OutputError
from pisigma.files.input_file import read_input
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.inverse.corrected_ik import load

SCANNERS: dict[str, Callable[[str, FrameFile], ScannedProgram]] = {
    ".script": scan_urscript,
    ".src": scan_krl,
    ".dat": scan_krl_data,
    ".mod": scan_rapid,
    ".ls": scan_fanuc,
}
"""By the suffix of the file."""

TOLERANCE_MM = 0.1
MOST_BYTES = 2**24
MOST_JOINTS = 6
TEST = (
    "TEST IT AT LOW SPEED FIRST: the poses are commanded to a controller that computes with the robot as drawn, with "
    "any accuracy option of its own off, and its origin and flange have to be those of the robot description. Targets "
    "given as joint values, outputs, waits and speeds are as they were; nothing was checked for collisions."
)


def check_rewriting(request: ExportRequest) -> None:
    """Refuse options that do not go with a program.

    Raises:
        OutputError: the program's language is not known or not that of the file to write, or an option does not fit.
    """
    assert request.program is not None
    suffix = request.program.suffix.lower()
    if suffix not in SCANNERS or request.out.suffix.lower() != suffix:
        raise OutputError(
            f"{request.program}: a program ends in {', '.join(SCANNERS)}, and --out ends as the program does."
        )
    for name, value in (("targets", request.targets), ("config", request.config)):
        if value is not None:
            raise OutputError(
                f"--{name} goes with --poses; a --program keeps its poses as poses. Leave it out."
            )
    if request.tolerance_mm is not None and not 0 < request.tolerance_mm < float("inf"):
        raise OutputError(f"--tolerance-mm {request.tolerance_mm:g}: a length above 0 was wanted.")


def rewrite_program(request: ExportRequest) -> Exported:
    """Rewrite what is understood of a program, show what has changed, and name what stays.

    Raises:
        OutputError: the program cannot be read, or holds no target whose frame and tool are stated.
    """
    assert request.program is not None
    # Letters beyond ASCII stand in comments only; in this encoding every byte comes back as it was.
    text = read_input(request.program, OutputError, MOST_BYTES).decode("latin-1")
    scanned = SCANNERS[request.program.suffix.lower()](text, FrameFile.read(request.frames))
    if not scanned.targets:
        named = (
            _listed([f"line {line}: {reason}" for line, reason in scanned.left])
            or "only joint values, if any"
        )
        raise OutputError(f"{request.program}: holds no pose that can be rewritten ({named}).")
    solver = load(request.model)
    if request.conditions:
        solver = solver.under(**request.conditions)
    if solver.model.robot.dof > MOST_JOINTS:
        raise OutputError(
            f"--program: expected a robot of at most {MOST_JOINTS} joints, got {solver.model.robot.dof}: the poses of "
            "a program do not say where the further joints are; export --poses with joint values instead."
        )
    tolerance = TOLERANCE_MM if request.tolerance_mm is None else request.tolerance_mm
    corrected = ProgramCorrection(solver, request.branch, tolerance / 1e3).correct(scanned)
    return _exported(request, solver.model, scanned, corrected, tolerance)


def _exported(
    request: ExportRequest,
    model: CalibratedModel,
    scanned: ScannedProgram,
    corrected: CorrectedProgram,
    tolerance_mm: float,
) -> Exported:
    """The new program, with what is to be said of it."""
    assert request.program is not None
    diff = corrected.diff(scanned.text, (str(request.program), str(request.out)))
    language = LANGUAGES.get(request.program.suffix.lower())
    reached = len(corrected.statuses) - len(corrected.unreached)
    shift = corrected.largest_shift * 1e3
    return Exported(
        content=corrected.text.encode("latin-1"),
        facts={
            "robot": model.robot.name,
            "program": str(request.program),
            "targets": len(corrected.statuses),
            "statuses": dict(Counter(status.name.lower() for _, status in corrected.statuses)),
            "unreached": [
                {"line": line, "status": status.name.lower()} for line, status in corrected.unreached
            ],
            "branches": list(corrected.branches),
            "way_points": corrected.way_points,
            "tolerance_mm": tolerance_mm,
            "largest_shift_mm": shift,
            "left_alone": [{"line": line, "reason": reason} for line, reason in corrected.left],
            "joint_lines": list(scanned.joint_lines),
            "diff": diff,
        },
        remarks=(*condition_remarks(model), *frame_remarks(model)),
        doubts=(
            TEST,
            *(language.cartesian_cautions if language else ()),
            *_in_doubt(corrected, str(request.program)),
        ),
        summary=f"Program with {reached} corrected targets (by {shift:.3f} mm at most) "
        f"and {corrected.way_points} way points",
        shortfall=_shortfall(corrected, str(request.program)),
        shown=diff,
    )


def _in_doubt(corrected: CorrectedProgram, source: str) -> tuple[str, ...]:
    """On which branches targets were corrected, and what was left alone."""
    said = [
        f"Targets are corrected for the branch {' and '.join(corrected.branches) or 'of the model'}. The program's "
        "configuration was not compared: where the arm stands otherwise, state --branch."
    ]
    if corrected.left:
        said.append(
            f"Left alone in {source}: {'; '.join(f'line {line}: {reason}' for line, reason in corrected.left)}."
        )
    return tuple(said)


def _shortfall(corrected: CorrectedProgram, source: str) -> str | None:
    if not corrected.unreached:
        return None
    line, status = corrected.unreached[0]
    others = _listed([f"line {n} {s.name.lower()}" for n, s in corrected.unreached[1:]])
    also = f" (Also: {others}.)" if others else ""
    return f"{source}, line {line}: {status.name.lower()}, so the line is as it was. {status.sentence}{also}"


def _listed(sentences: list[str], most: int = 10) -> str:
    more = [f"and {len(sentences) - most} more"] if len(sentences) > most else []
    return "; ".join([*sentences[:most], *more])
