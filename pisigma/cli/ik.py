"""`pisigma ik`: corrected joint values for poses."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from torch import Tensor

Pose = tuple[float, float, float, float, float, float]


def ik(
    model: Annotated[Path, typer.Argument(help="Model folder.")],
    pose: Annotated[
        Pose | None, typer.Option(help="X Y Z ROLL PITCH YAW of the tool in the base frame [mm, deg].")
    ] = None,
    poses: Annotated[
        Path | None,
        typer.Option(help="CSV file of poses: x_mm,y_mm,z_mm,roll_deg,pitch_deg,yaw_deg or qx,qy,qz,qw."),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="CSV file of joint values to write, with --poses.")] = None,
    branch: Annotated[str | None, typer.Option(help="Branch to take instead of the trained one.")] = None,
    all_branches: Annotated[
        bool, typer.Option("--all-branches", help="Print the solutions on all branches of --pose.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Print the joint values that really reach a pose, or write those of a file of poses.

    Exit status 2 when a pose is unreachable, singular or outside the joint limits; what was found is given
    all the same.
    """
    _check_options(pose, poses, out, branch, all_branches)
    from pisigma.cli.output import fail, print_json
    from pisigma.cli.solutions import count_statuses, failure, print_solutions, solution_records, write_joints
    from pisigma.correction.corrected_ik import load

    solver = load(model)
    robot = solver.model.robot
    T, places = _wanted(pose, poses)
    if all_branches:
        solution = solver.all_branches(T).select(0)
        places = [f"{places[0]}, branch {name}" for name in solver.branches]
    else:
        solution = solver(T, branch=branch)
    if out is not None:
        write_joints(solution, robot, out)
        result: dict[str, Any] = {
            "file": str(out),
            "rows": len(places),
            "statuses": count_statuses(solution),
        }
    else:
        result = {"solutions": solution_records(solution, robot)}
    if as_json:
        print_json(result)
    elif out is not None:
        found = ", ".join(f"{count} {status}" for status, count in result["statuses"].items())
        typer.echo(f"{len(places)} rows written to {out}: {found}.")
    else:
        print_solutions(solution, robot)
    if problem := failure(solution, places, any_will_do=all_branches):
        fail(problem)


def _check_options(
    pose: Pose | None, poses: Path | None, out: Path | None, branch: str | None, all_branches: bool
) -> None:
    """Refuse options that do not go together."""
    if (pose is None) == (poses is None):
        raise typer.BadParameter("give either --pose or --poses", param_hint="'--pose' / '--poses'")
    if (poses is None) != (out is None):
        raise typer.BadParameter("--poses and --out go together", param_hint="'--out'")
    if all_branches and (pose is None or branch is not None):
        raise typer.BadParameter("it goes with --pose and without --branch", param_hint="'--all-branches'")


def _wanted(pose: Pose | None, poses: Path | None) -> "tuple[Tensor, list[str]]":
    """The wanted poses T_base_tool, and what to call each of them."""
    import torch

    from pisigma.measurement.pose_csv import read_poses
    from pisigma.se3 import transform_from_xyzrpy

    if pose is None:
        assert poses is not None
        wanted = read_poses(poses)
        return wanted.T, [f"{poses}, line {line}" for line in wanted.line]
    values = torch.tensor(pose, dtype=torch.float64)
    T = transform_from_xyzrpy(torch.cat([values[:3] / 1e3, torch.deg2rad(values[3:])]))
    return T[None], [f"the pose {' '.join(f'{value:g}' for value in pose)}"]
