"""`pisigma distill`: a calibrated model as a small network on nominal joint values."""

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pisigma.cli.arguments import AsJson, ModelFolder, Overwrite
from pisigma.cli.output import command_line, print_json, print_lines, print_table, progress_of
from pisigma.cli.settings_options import takes_settings
from pisigma.files.errors import PoseError, RecipeError
from pisigma.workflow.settings.distillation import DistillationSettings

if TYPE_CHECKING:
    from pisigma.workflow.distill import Distillation
    from pisigma.workflow.distilled_network import Size
    from pisigma.workflow.solved_poses import Region

Box = tuple[float, float, float, float, float, float]

Out = Annotated[Path, typer.Option(help="Model folder to write.")]
RegionMm = Annotated[
    Box | None,
    typer.Option(
        help="X_MIN X_MAX Y_MIN Y_MAX Z_MIN Z_MAX of the tool in the base frame [mm], with the orientations of the "
        "measured poses. [default: where the model was measured]"
    ),
]
Joints = Annotated[
    Path | None,
    typer.Option(
        help="CSV file with q1_deg and so on: the region lies between each of these rows and the rows near it, "
        "so that the rows have to fill it."
    ),
]
Orders = Annotated[
    str | None,
    typer.Option(help="Orders of the product units, such as 1,2,3. [default: several sizes are tried]"),
]
Harmonics = Annotated[
    int | None,
    typer.Option(
        help="With --orders: cycles a turn up to which the value of a joint is an input. [default: 1]"
    ),
]


@takes_settings
def distill(
    context: typer.Context,
    model: ModelFolder,
    out: Out,
    settings: DistillationSettings,
    region: RegionMm = None,
    joints: Joints = None,
    orders: Orders = None,
    harmonics: Harmonics = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Distil a calibrated model into a small network for controllers that can only add an offset.

    Its error against the full solution, on poses that were not fitted to, is printed and on its card.
    """
    from pisigma.files.output_folder import check_folder
    from pisigma.workflow import distill as workflow

    check_folder(out, overwrite, inputs=(model, joints))
    size = _size(orders, harmonics)
    settings = replace(settings, region=_region(model, region, joints), size=size)
    with progress_of("distillation") as progress:
        distillation = workflow.distill(model, settings, progress)
    distillation.save(out, command=command_line(context, ("out", "joints")), overwrite=overwrite)
    _print(distillation, out, as_json)


def _size(orders: str | None, harmonics: int | None) -> "Size | None":
    """The one size that was asked for."""
    from pisigma.workflow.distilled_network import Size

    if orders is None:
        if harmonics is not None:
            raise RecipeError("--harmonics goes with --orders; give both or none.")
        return None
    numbers = orders.split(",")
    if not all(number.strip().isdecimal() and 1 <= int(number) <= 20 for number in numbers):
        raise RecipeError(f"--orders '{orders}': whole numbers from 1 to 20 were wanted, such as 1,2,3.")
    if harmonics is not None and not 1 <= harmonics <= 500:
        raise RecipeError(f"--harmonics {harmonics}: a whole number from 1 to 500 was wanted.")
    return Size(tuple(int(number) for number in numbers), harmonics or 1)


def _region(model: Path, box: Box | None, joints: Path | None) -> "Region | None":
    """Where poses are to be drawn; None: where the model was measured."""
    from pisigma.measurement.csv.reading import read_joints
    from pisigma.model.folder.model_folder import load_model
    from pisigma.workflow.solved_poses import Region

    if box is None and joints is None:
        return None
    parent = load_model(model)
    q = parent.starts.double() if joints is None else read_joints(joints, parent.robot)
    if box is None:
        return Region(q)
    if not all(math.isfinite(value) for value in box) or any(box[i] > box[i + 1] for i in (0, 2, 4)):
        raise PoseError(
            f"--region {' '.join(f'{value:g}' for value in box)}: x_min x_max y_min y_max z_min z_max [mm] were "
            "wanted, each minimum not above its maximum."
        )
    x_min, x_max, y_min, y_max, z_min, z_max = (value / 1e3 for value in box)
    return Region(q, (x_min, x_max, y_min, y_max, z_min, z_max))


def _print(distillation: "Distillation", out: Path, as_json: bool) -> None:
    """Print how well the model follows the full solution."""
    from pisigma.reporting.distilled_card import correction_table, size_table
    from pisigma.reporting.tables import pose_rows

    if as_json:
        print_json({"model": str(out), **distillation.to_json()})
        return
    summary = distillation.summary
    title = f"tool under the full model, {summary.poses.held_out} held-out poses"
    print_table(title, *pose_rows(summary.held_out.models))
    print_lines(f"Warning: {sentence}" for sentence in summary.warnings)
    print_table("absolute joint corrections, and errors of the distilled ones", *correction_table(summary))
    print_table("sizes tried", *size_table(summary))
    print_lines(summary.limitations)
    print_lines([f"Model written to {out} in {distillation.seconds:.1f} s; read its README.md."])
