"""`pisigma ik`: corrected joint values for poses."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pisigma.cli.arguments import AsJson, ModelOrCell, PayloadKg, TemperatureC
from pisigma.cli.endings import exit_with_error
from pisigma.cli.output import print_json, print_line, print_lines
from pisigma.cli.progress import progress_of
from pisigma.cli.screen import print_result
from pisigma.reporting.result_text import merge_alike_warnings

if TYPE_CHECKING:
    from pisigma.model.inverse.corrected_ik import CorrectedIK

Pose = tuple[float, float, float, float, float, float]

IgnoreAxes = Annotated[
    str | None,
    typer.Option(
        help="Axes of the tool to ignore: x, y, z, roll, pitch, yaw (about the tool's x, y, z) or none, separated by "
        "commas. [default: depends on the number of joints]"
    ),
]
ToleranceMm = Annotated[
    str | None, typer.Option(help="Tolerance along the axes of the tool [mm], one number or three.")
]
ToleranceDeg = Annotated[
    str | None, typer.Option(help="Tolerance about the axes of the tool [deg], one number or three.")
]
Target = Annotated[str | None, typer.Option(help="Target of the poses. [default: the first]")]
Frame = Annotated[str | None, typer.Option(help="Frame of the poses. [default: the first]")]
ElbowDeg = Annotated[float | None, typer.Option(help="Elbow angle of a seven-joint arm [deg].")]


def ik(
    model: ModelOrCell,
    pose: Annotated[
        Pose | None,
        typer.Option(
            help="X Y Z ROLL PITCH YAW of a measured target in a frame of the measurements [mm, deg]."
        ),
    ] = None,
    poses: Annotated[
        Path | None,
        typer.Option(
            help="CSV file of poses: x_mm,y_mm,z_mm with roll_deg,pitch_deg,yaw_deg or qx,qy,qz,qw."
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="CSV file of joint values to write, with --poses.")] = None,
    branch: Annotated[str | None, typer.Option(help="Branch to use instead of the default.")] = None,
    all_branches: Annotated[
        bool, typer.Option("--all-branches", help="With --pose, print all branches.")
    ] = False,
    accuracy: Annotated[
        bool,
        typer.Option(
            "--accuracy",
            help="With --poses, also predict the standard deviation of the tool's position, sqrt(sx^2 + sy^2 + sz^2); "
            "slow for hybrid models.",
        ),
    ] = False,
    path: Annotated[
        bool,
        typer.Option(
            "--path",
            help="Treat the rows of --poses as a path and stay on one branch as long as possible.",
        ),
    ] = False,
    ignore_axes: IgnoreAxes = None,
    tolerance_mm: ToleranceMm = None,
    tolerance_deg: ToleranceDeg = None,
    elbow_deg: ElbowDeg = None,
    target: Target = None,
    frame: Frame = None,
    payload_kg: PayloadKg = None,
    temperature_c: TemperatureC = None,
    as_json: AsJson = False,
) -> None:
    """Compute the corrected joint values that reach a pose, or every pose of a file.

    Exits with status 2 if a pose is unreachable, singular or outside the joint limits, or if a row of the file is not
    a pose; the other solutions are still printed or written.
    """
    _check_options(pose, poses, out, branch, all_branches)
    for name, given in (("--accuracy", accuracy), ("--path", path)):
        if given and poses is None:
            raise typer.BadParameter("the option applies only to --poses", param_hint=f"'{name}'")
    from pisigma.files.output_file import check_output
    from pisigma.lifetime.cell.controller import checked_model_folder
    from pisigma.model.inverse.loading import load

    if out is not None:
        check_output(out, inputs=(model, poses))
    folder, warnings = checked_model_folder(model, "ik")
    for sentence in warnings:
        print_line(f"pisigma: {sentence}", to_stderr=True)
    solver = load(folder)
    stated = {"payload_kg": payload_kg, "temperature_c": temperature_c}
    if conditions := {name: value for name, value in stated.items() if value is not None}:
        solver = solver.under(**conditions)
    if target is not None or frame is not None:
        solver = solver.for_target(target, frame=frame)
    solver = _for_task(solver, ignore_axes, tolerance_mm, tolerance_deg, elbow_deg)
    if poses is not None and out is not None:
        _write_file(solver, poses, out, branch, accuracy, path, as_json)
    elif pose is not None:
        _print_pose(solver, pose, branch, all_branches, as_json)


def _for_task(
    solver: "CorrectedIK", ignore: str | None, mm: str | None, deg: str | None, elbow_deg: float | None
) -> "CorrectedIK":
    """Return the solver with the ignored axes, the tolerances and the elbow angle that the options state."""
    return solver.for_task(
        None if ignore is None else [name for name in _words(ignore) if name != "none"],
        _numbers("--tolerance-mm", mm),
        _numbers("--tolerance-deg", deg),
        None if elbow_deg is None else math.radians(elbow_deg),
    )


def _words(text: str) -> list[str]:
    return [word.strip() for word in text.split(",") if word.strip()]


def _numbers(option: str, text: str | None) -> list[float] | None:
    """Return the numbers of an option; None if the option is not given."""
    try:
        return None if text is None else [float(word) for word in _words(text)]
    except ValueError:
        raise typer.BadParameter(
            f"expected one number or three with commas, got '{text}'", param_hint=f"'{option}'"
        ) from None


def _print_pose(
    solver: "CorrectedIK", pose: Pose, branch: str | None, all_branches: bool, as_json: bool
) -> None:
    """Print the solutions of one pose."""
    import numpy as np

    from pisigma.reporting.solution_text import failure_sentence, solution_records, solution_text
    from pisigma.workflow.load import pose_from_mm_and_deg

    T, places = pose_from_mm_and_deg(pose), [f"the pose {' '.join(f'{value:g}' for value in pose)}"]
    if all_branches:
        solution = solver.all_branches(T).select(0)
        if not solver.closed_form:  # only solutions, without padding
            solution = solution.select(slice(0, max(1, int(np.isfinite(solution.q).all(-1).sum()))))
        names = (solver.branches[branch] for branch in solution.branch.tolist())
        places = [f"{places[0]}, branch {name}" for name in names]
    else:
        solution = solver(T, branch=branch)
    if as_json:
        print_json({"solutions": solution_records(solution, solver), "warnings": solver.warnings})
    else:
        print_result(solution_text(solution, solver), elsewhere="--json")
    if problem := failure_sentence(solution, places, one_suffices=all_branches):
        exit_with_error(problem)


def _write_file(
    solver: "CorrectedIK",
    poses: Path,
    out: Path,
    branch: str | None,
    accuracy: bool,
    path: bool,
    as_json: bool,
) -> None:
    """Write the joint values of a file of poses, of any length."""
    from pisigma.cli.ik.joint_file import write_joint_file

    with progress_of("ik") as tell:
        outcome = write_joint_file(solver, poses, out, branch, tell, accuracy, path)
    if as_json:
        print_json({"file": str(out), **outcome.to_json(path), "warnings": solver.warnings})
    else:
        switches = [f"{poses}, line {line}: {switch.sentence}" for line, switch in outcome.switches]
        counts = ", ".join(f"{count} {status}" for status, count in outcome.statuses.most_common())
        warnings = (f"Warning: {sentence}" for sentence in solver.warnings)
        print_lines(
            [*merge_alike_warnings(switches), *warnings, f"{outcome.rows} rows written to {out}: {counts}."]
        )
    if problem := outcome.problem(poses):
        exit_with_error(problem)


def _check_options(
    pose: Pose | None, poses: Path | None, out: Path | None, branch: str | None, all_branches: bool
) -> None:
    """Refuse options that exclude each other."""
    if (pose is None) == (poses is None):
        raise typer.BadParameter("expected either --pose or --poses", param_hint="'--pose' / '--poses'")
    if (poses is None) != (out is None):
        raise typer.BadParameter("expected --poses and --out together", param_hint="'--out'")
    if all_branches and (pose is None or branch is not None):
        raise typer.BadParameter(
            "the option requires --pose and cannot be combined with --branch", param_hint="'--all-branches'"
        )
