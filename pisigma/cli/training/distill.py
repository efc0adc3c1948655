"""`pisigma distill`: a calibrated model as a small network on nominal joint values."""

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pisigma.cli.arguments import AsJson, ModelOrCell, Overwrite, Verbose
from pisigma.cli.cell import cell_at, output_in_cell
from pisigma.cli.output import command_line, print_json
from pisigma.cli.progress import progress_of
from pisigma.cli.screen import print_screen
from pisigma.cli.settings_options import takes_settings
from pisigma.files.errors import PoseError, RecipeError
from pisigma.reporting.result_text import sentence_block, table_block
from pisigma.reporting.verdict import Verdict, count_text, rms_text
from pisigma.workflow.settings.distillation import DistillationSettings

if TYPE_CHECKING:
    from pisigma.workflow.distill import Distillation
    from pisigma.workflow.distilled_network import NetworkSize
    from pisigma.workflow.solved_poses import Region

Box = tuple[float, float, float, float, float, float]

Out = Annotated[Path | None, typer.Option(help="Model folder to write. [default: in exports/ of a cell]")]
RegionMm = Annotated[
    Box | None,
    typer.Option(
        help="Region of the tool in the frame of the measurements, X_MIN X_MAX Y_MIN Y_MAX Z_MIN Z_MAX [mm]. [default: "
        "region of the measurements of the model]"
    ),
]
Joints = Annotated[
    Path | None,
    typer.Option(help="CSV file of joint values (q1_deg and so on) that cover the region."),
]
Orders = Annotated[
    str | None,
    typer.Option(help="Orders of the product units, such as 1,2,3. [default: best of several]"),
]
Harmonics = Annotated[
    int | None,
    typer.Option(help="With --orders, number of harmonics of every joint value used as inputs. [default: 1]"),
]


@takes_settings
def distill(
    context: typer.Context,
    model: ModelOrCell,
    out: Out = None,
    *,
    settings: DistillationSettings,
    region: RegionMm = None,
    joints: Joints = None,
    orders: Orders = None,
    harmonics: Harmonics = None,
    overwrite: Overwrite = False,
    verbose: Verbose = False,
    as_json: AsJson = False,
) -> None:
    """Distil a calibrated model into a small network for controllers that can only add an offset.

    Prints its error relative to the full solution at held-out poses.
    """
    from pisigma.files.output_folder import check_folder
    from pisigma.lifetime.cell.layout import EXPORTS, model_folder
    from pisigma.workflow import distill as workflow

    if out is None:
        out = output_in_cell(cell_at(model), EXPORTS, "")
    model = model_folder(model)
    check_folder(out, overwrite, inputs=(model, joints))
    size = _size(orders, harmonics)
    settings = replace(settings, region=_region(model, region, joints), size=size)
    with progress_of("distillation") as progress:
        distillation = workflow.distill(model, settings, progress)
    distillation.save(out, command=command_line(context, ("out", "joints")), overwrite=overwrite)
    _print(distillation, out, as_json, verbose)


def _size(orders: str | None, harmonics: int | None) -> "NetworkSize | None":
    """Return the size of the network that the options state; None to choose the best of several."""
    from pisigma.workflow.distilled_network import NetworkSize

    if orders is None:
        if harmonics is not None:
            raise RecipeError(
                "the option requires --orders", option="--harmonics", remedy="give both or neither"
            )
        return None
    numbers = orders.split(",")
    if not all(number.strip().isdecimal() and 1 <= int(number) <= 20 for number in numbers):
        raise RecipeError(
            expected="whole numbers from 1 to 20, such as 1,2,3", value=orders, option="--orders"
        )
    if harmonics is not None and not 1 <= harmonics <= 500:
        raise RecipeError(expected="a whole number from 1 to 500", value=harmonics, option="--harmonics")
    return NetworkSize(tuple(int(number) for number in numbers), harmonics or 1)


def _region(model: Path, box: Box | None, joints: Path | None) -> "Region | None":
    """Return the region in which poses are drawn; None for the region in which the model was measured."""
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
            expected="x_min x_max y_min y_max z_min z_max [mm] with every minimum <= its maximum",
            value=" ".join(f"{value:g}" for value in box),
            option="--region",
        )
    x_min, x_max, y_min, y_max, z_min, z_max = (value / 1e3 for value in box)
    return Region(q, (x_min, x_max, y_min, y_max, z_min, z_max))


def _print(distillation: "Distillation", out: Path, as_json: bool, verbose: bool) -> None:
    """Print how well the model follows the full solution."""
    from pisigma.reporting.derived_cards import correction_table, size_table
    from pisigma.reporting.tables import pose_rows

    if as_json:
        print_json({"model": str(out), **distillation.to_json()})
        return
    summary = distillation.summary
    errors, count = summary.held_out, summary.poses.held_out
    cautions = f"with caution ({count_text(len(summary.warnings), 'warning')})" if summary.warnings else "yes"
    verdict = Verdict(
        f"{rms_text(errors.distilled, count)} RMS from the full model at {count} held-out poses; nominal "
        f"{rms_text(errors.nominal, count)}.",
        f"{cautions}, in the region of the poses only; the errors of {summary.parent.name} add to these.",
        f"export it: `pisigma export {out} --format onnx --out MODEL.onnx`.",
    )
    head, rows = pose_rows(errors.models)
    blocks = [
        table_block(f"errors of the tool relative to the full model, {count} held-out poses", head, rows)
    ]
    details = [
        table_block(
            "absolute joint corrections, and errors of the distilled ones", *correction_table(summary)
        ),
        table_block("sizes tried", *size_table(summary)),
        sentence_block("limitations", summary.limitations),
    ]
    closing = [f"Model written to {out} in {distillation.seconds:.1f} s; its README.md has all figures."]
    print_screen(verdict, summary.warnings, blocks, details, closing, verbose)
