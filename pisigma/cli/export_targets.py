"""`pisigma export --format targets`: corrected targets as a table or as a program."""

from collections import Counter
from pathlib import Path

import typer

from pisigma.cli.output import fail, print_json
from pisigma.errors import OutputError, nearest_choice
from pisigma.export.output_file import write_whole
from pisigma.export.programs.languages import check_program, program_text, warnings
from pisigma.export.programs.targets import targets_of
from pisigma.export.programs.targets_csv import targets_csv
from pisigma.inverse.corrected_ik import load
from pisigma.measurement.csv.poses import read_poses

KINDS = ("joints", "cartesian")


def export_targets(
    model: Path,
    out: Path,
    poses: Path,
    kind: str | None,
    branch: str | None,
    config: str | None,
    conditions: dict[str, float],
    as_json: bool,
) -> None:
    """Write corrected targets, and say what about them is in doubt.

    Raises:
        PisigmaError: a file, an option or the robot does not do; for a program also a pose without target.
    """
    table, cartesian = out.suffix.lower() == ".csv", kind == "cartesian"
    _check_options(out, poses, kind, config)
    solver = load(model)
    if conditions:
        solver = solver.under(**conditions)
    if not table:
        check_program(out, solver.model.robot, cartesian, config)
    wanted = read_poses(poses)
    targets = targets_of(solver.torch(wanted.T, branch=branch), str(poses), wanted.line, accuracy=table)
    write_whole(out, targets_csv(targets) if table else program_text(targets, out, cartesian, config))
    said = [*([targets.doubt] if targets.doubt else []), *([] if table else warnings(out, cartesian))]
    for sentence in said:
        typer.echo(f"pisigma: {sentence}", err=True)
    statuses = dict(Counter(status.name.lower() for status in targets.status).most_common())
    if as_json:
        told = {"robot": targets.robot.name, "rows": len(targets.line), "statuses": statuses}
        written = "both" if table else kind or KINDS[0]
        print_json({"file": str(out), "format": "targets", "targets": written, **told, "remarks": said})
    else:
        found = ", ".join(f"{count} {status}" for status, count in statuses.items())
        typer.echo(f"Targets for {len(targets.line)} poses written to {out}: {found}.")
    if targets.failure:
        fail(targets.failure)


def _check_options(out: Path, poses: Path, kind: str | None, config: str | None) -> None:
    """Refuse options that do not go together."""
    if out.exists() and poses.exists() and out.samefile(poses):
        raise OutputError(f"{out}: is the file of poses itself; choose another --out.")
    if kind is not None and kind not in KINDS:
        raise OutputError(f"--targets '{kind}' is unknown; {nearest_choice(kind, KINDS)}")
    if out.suffix.lower() == ".csv":
        for name, value in (("--targets", kind), ("--config", config)):
            if value is not None:
                raise OutputError(f"{name} goes with a program; a .csv file holds all targets. Leave it out.")
