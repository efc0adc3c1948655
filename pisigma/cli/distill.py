"""`pisigma distill`: a calibrated model as a small network on nominal joint values."""

import hashlib
import shlex
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from pisigma.model.calibrated_model import CalibratedModel
    from pisigma.workflow.distilled_sizes import Size
    from pisigma.workflow.solved_poses import Region

Box = tuple[float, float, float, float, float, float]


def distill(
    model: Annotated[Path, typer.Argument(help="Model folder that `pisigma calibrate` wrote.")],
    out: Annotated[Path, typer.Option(help="Model folder to write.")],
    region: Annotated[
        Box | None,
        typer.Option(
            help="X_MIN X_MAX Y_MIN Y_MAX Z_MIN Z_MAX of the tool in the base frame [mm], with the orientations of the "
            "measured poses; else the region is where the model was measured."
        ),
    ] = None,
    joints: Annotated[
        Path | None,
        typer.Option(
            help="CSV file with q1_deg and so on: the region lies between each of these rows and the rows near it "
            "instead, so that the rows have to fill it."
        ),
    ] = None,
    poses: Annotated[int, typer.Option(help="Poses to fit to.")] = 5000,
    orders: Annotated[
        str | None,
        typer.Option(help="Orders of the product units, such as 1,2,3; else several sizes are tried."),
    ] = None,
    harmonics: Annotated[
        int | None,
        typer.Option(help="With --orders: cycles a turn up to which a joint's own value is an input [1]."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Of poses and starts.")] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Distil a calibrated model into a small network for controllers that can only add an offset.

    Its error against the full solution, on poses that it never saw, is printed and on its card.
    """
    started = time.perf_counter()
    from pisigma.cli.output import print_json
    from pisigma.cli.progress import progress_of
    from pisigma.model.folder.model_folder import load_model, save_model
    from pisigma.model.folder.staging import check_replaceable, staged_folder
    from pisigma.reporting.distilled_card import write_distilled_card
    from pisigma.reporting.distilled_report import report_distillation
    from pisigma.workflow.distillation import DistillationSettings
    from pisigma.workflow.distillation import distill as distil

    check_replaceable(out)
    parent = load_model(model)
    settings = DistillationSettings(poses=poses, size=_size(orders, harmonics), seed=_sound(seed))
    where = _region(parent, region, joints)
    sha256 = hashlib.sha256((model / "model.yaml").read_bytes()).hexdigest()
    with progress_of("distillation") as tell:
        found = distil(out.resolve().name, parent, where, settings, sha256, tell)
    report = report_distillation(found)
    options = {"region": region, "joints": joints, "poses": poses, "orders": orders, "harmonics": harmonics}
    command = _command(model, out, options | {"seed": seed})
    with staged_folder(out) as scratch:
        save_model(replace(found.model, metrics=report), scratch)
        write_distilled_card(found, command, report, scratch)
    finished = {"model": str(out), "seconds": round(time.perf_counter() - started, 3), **report}
    if as_json:
        print_json(finished)
    else:
        _print(finished)


def _size(orders: str | None, harmonics: int | None) -> "Size | None":
    """The one size that was asked for."""
    from pisigma.errors import RecipeError
    from pisigma.workflow.distilled_sizes import Size

    if orders is None:
        if harmonics is not None:
            raise RecipeError("--harmonics goes with --orders; give both or none.")
        return None
    parts = orders.split(",")
    if not all(part.strip().isdecimal() and 1 <= int(part) <= 20 for part in parts):
        raise RecipeError(f"--orders '{orders}': whole numbers from 1 to 20 were wanted, such as 1,2,3.")
    if harmonics is not None and not 1 <= harmonics <= 500:
        raise RecipeError(f"--harmonics {harmonics}: a whole number from 1 to 500 was wanted.")
    return Size(tuple(int(part) for part in parts), harmonics or 1)


def _sound(seed: int) -> int:
    from pisigma.errors import RecipeError

    if not 0 <= seed < 2**63:
        raise RecipeError(f"--seed {seed}: a whole number from 0 to 2^63 - 1 was wanted.")
    return seed


def _region(parent: "CalibratedModel", box: Box | None, joints: Path | None) -> "Region | None":
    """Where poses are to be drawn; None: where the model was measured."""
    import math

    from pisigma.errors import PoseError
    from pisigma.workflow.solved_poses import Region

    if box is None and joints is None:
        return None
    q = parent.starts.double()
    if joints is not None:
        from pisigma.measurement.csv.reading import read_joints

        q = read_joints(joints, parent.robot)
    if box is None:
        return Region(q)
    if not all(math.isfinite(value) for value in box) or any(box[i] > box[i + 1] for i in (0, 2, 4)):
        raise PoseError(
            f"--region {' '.join(f'{value:g}' for value in box)}: x_min x_max y_min y_max z_min z_max [mm] were "
            "wanted, each minimum not above its maximum."
        )
    x_min, x_max, y_min, y_max, z_min, z_max = (value / 1e3 for value in box)
    return Region(q, (x_min, x_max, y_min, y_max, z_min, z_max))


def _command(model: Path, out: Path, options: dict[str, Any]) -> str:
    """The command line that does the same, with the names of files only."""
    words = ["pisigma", "distill", model.resolve().name, "--out", out.name]
    for name, value in options.items():
        if isinstance(value, tuple):
            words += [f"--{name}", *(f"{bound:g}" for bound in value)]
        elif value is not None:
            words += [f"--{name}", value.name if isinstance(value, Path) else str(value)]
    return shlex.join(words)


def _print(result: dict[str, Any]) -> None:
    from pisigma.cli.output import print_table
    from pisigma.reporting.distilled_card import joint_rows, size_rows
    from pisigma.reporting.tables import pose_rows

    print_table("sizes tried", *size_rows(result["sizes"]))
    title = f"tool under the full model, {result['poses']['held_out']} held-out poses"
    print_table(title, *pose_rows(result["held_out"]))
    print_table("absolute joint corrections, and errors of the distilled ones", *joint_rows(result["joints"]))
    for sentence in result["gives_up"]:
        typer.echo(sentence)
    for sentence in result["doubts"]:
        typer.echo(f"Warning: {sentence}")
    typer.echo(f"Model written to {result['model']} in {result['seconds']:.1f} s; read its README.md.")
