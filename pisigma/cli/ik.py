"""`pisigma ik`: corrected joint values for poses."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer

Pose = tuple[float, float, float, float, float, float]


def ik(
    model: Annotated[Path, typer.Argument(help="Model folder.")],
    pose: Annotated[Pose | None, typer.Option(help="X Y Z ROLL PITCH YAW of the tool in the base frame [mm, deg].")] = None,
    poses: Annotated[Path | None, typer.Option(help="CSV file of poses: x_mm,y_mm,z_mm,roll_deg,pitch_deg,yaw_deg or quaternions.")] = None,
    out: Annotated[Path | None, typer.Option(help="CSV file of joint values to write, with --poses.")] = None,
    branch: Annotated[str | None, typer.Option(help="Branch to take instead of the trained one.")] = None,
    all_branches: Annotated[bool, typer.Option(help="Print the solutions on all branches.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Print the joint values that really reach a pose, or write those of a file of poses.

    Exit status 2 when a pose is unreachable, singular or outside the joint limits; what was found is printed all the same.
    """
    if (pose is None) == (poses is None):
        raise typer.BadParameter("give either --pose or --poses", param_hint="'--pose' / '--poses'")
    if (poses is None) != (out is None):
        raise typer.BadParameter("--poses and --out go together", param_hint="'--out'")
    import torch

    from pisigma.cli.solutions import failure, print_solutions, solution_records, write_joints
    from pisigma.correction.corrected_ik import load
    from pisigma.measurement.pose_csv import read_poses
    from pisigma.se3 import transform_from_xyzrpy

    solver = load(model)
    if pose is not None:
        lengths, angles = torch.tensor(pose, dtype=torch.float64).split(3)
        T = transform_from_xyzrpy(torch.cat([lengths / 1e3, torch.deg2rad(angles)]))[None]
        places = [f"the pose {' '.join(f'{value:g}' for value in pose)}"]
    else:
        assert poses is not None
        wanted = read_poses(poses)
        T, places = wanted.T, [f"{poses}, line {line}" for line in wanted.line]
    if all_branches and pose is not None:
        solution = solver.all_branches(T).select(0)
        places = [f"{places[0]}, branch {name}" for name in solver.branches]
    else:
        solution = solver(T, branch=branch)
    robot = solver.model.robot
    result: dict[str, Any] = {}
    if out is not None:
        write_joints(solution, robot, out)
        result = {"file": str(out), "rows": len(places)}
    else:
        result = {"solutions": solution_records(solution, robot)}
    if as_json:
        typer.echo(json.dumps(result))
    elif out is not None:
        typer.echo(f"{len(places)} rows written to {out}.")
    else:
        print_solutions(solution, robot)
    problem = failure(solution, places, any_will_do=all_branches)
    if problem:
        typer.echo(f"pisigma: {problem}", err=True)
        raise typer.Exit(2)
