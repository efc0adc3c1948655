"""`pisigma export`: a model in the formats of other programs."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pisigma.cli.arguments import AsJson, ModelOrCell, PayloadKg, TemperatureC, complete_export
from pisigma.cli.cell import cell_at, output_in_cell
from pisigma.cli.endings import NOT_ACCEPTED, exit_with_error
from pisigma.cli.output import print_json, print_line, print_lines
from pisigma.deployment.export.registry import BUILT_IN

if TYPE_CHECKING:
    from pisigma.deployment.export.export_format import Exported

Out = Annotated[
    Path | None,
    typer.Option(
        help="File to write, with the suffix of the format: .urdf, .csv, .yaml, .conf, .cfx, .xacro, .onnx, "
        ".script (URScript), .src (KUKA), .mod (ABB) or .ls (FANUC); for library a folder. "
        "[default: in exports/ of a cell]"
    ),
]
Form = Annotated[
    str,
    typer.Option(
        "--format",
        help="; ".join(f"{name}: {meaning}" for name, (_, meaning) in BUILT_IN.items()) + ".",
        autocompletion=complete_export,
    ),
]
Like = Annotated[
    Path | None,
    typer.Option(
        help="File to update: a URDF file for urdf, mjcf and xacro (default: file of the robot), an MJCF model for "
        "mjcf, or the controller's file for ur-calibration, staubli and rsi."
    ),
]
Tip = Annotated[str | None, typer.Option(help="With --like, tool link that was used to load the robot.")]
Geometry = Annotated[
    str | None,
    typer.Option(
        help="With --format urdf, mjcf or dh, geometry to write: geometric (from the geometric calibration, default) "
        "or hybrid (fitted together with the joint correction, for use with --format onnx)."
    ),
]
Poses = Annotated[
    Path | None,
    typer.Option(
        help="With --format targets, CSV file of poses: x_mm,y_mm,z_mm with roll_deg,pitch_deg,yaw_deg or qx,qy,qz,qw."
    ),
]
TargetKind = Annotated[
    str | None,
    typer.Option(
        help="Targets of a program: joints (default), or cartesian for a controller that computes with the nominal "
        "robot."
    ),
]
Branch = Annotated[
    str | None, typer.Option(help="With --format targets, branch to use instead of the default.")
]
Config = Annotated[
    str | None,
    typer.Option(
        help="With .ls and --targets cartesian, configuration of the arm, such as 'N U T, 0, 0, 0'."
    ),
]
Program = Annotated[
    Path | None,
    typer.Option(
        help="With --format targets, existing program (.script, .src or .dat, .mod, .ls) whose pose targets are "
        "corrected."
    ),
]
Frames = Annotated[
    Path | None,
    typer.Option(help="With --program, YAML file of the frames and tools that the program does not define."),
]
ToleranceMm = Annotated[
    float | None,
    typer.Option(
        help="With --program, largest distance of the tool from a straight line between waypoints [mm]. [default: 0.1]"
    ),
]
CountsPerTurn = Annotated[
    str | None,
    typer.Option(
        help="With --format epson or fanuc-mastering, encoder counts per turn of each joint (including the gear "
        "ratio), or per mm of a prismatic joint, such as 8388608,8388608,524288,1048576."
    ),
]
PresentCounts = Annotated[
    str | None,
    typer.Option(help="With --format epson or fanuc-mastering, current encoder counts of the controller."),
]


def export(
    model: ModelOrCell,
    out: Out = None,
    *,
    form: Form,
    like: Like = None,
    tip: Tip = None,
    geometry: Geometry = None,
    poses: Poses = None,
    targets: TargetKind = None,
    branch: Branch = None,
    config: Config = None,
    program: Program = None,
    frames: Frames = None,
    tolerance_mm: ToleranceMm = None,
    counts_per_turn: CountsPerTurn = None,
    present_counts: PresentCounts = None,
    payload_kg: PayloadKg = None,
    temperature_c: TemperatureC = None,
    as_json: AsJson = False,
) -> None:
    """Export a model for other programs.

    Exits with status 2 if a pose of --poses is unreachable, singular or outside the joint limits: its values are empty
    in a .csv file, and no program is written. With --program, the lines of such poses remain unchanged, and the exit
    status is 3. Test every program at low speed.
    """
    from pisigma.deployment.export.export_format import ExportRequest
    from pisigma.deployment.export.registry import export_format, export_model
    from pisigma.lifetime.cell.layout import EXPORTS
    from pisigma.workflow.cell.exports import export_from_cell

    cell, kind = cell_at(model), export_format(form)
    if out is None:
        suffix = program.suffix if program else "".join(kind.suffixes[:1])
        out = output_in_cell(cell, EXPORTS, suffix)
    request = ExportRequest(
        model=model,
        out=out,
        like=like,
        tip=tip,
        geometry=geometry,
        poses=poses,
        targets=targets,
        branch=branch,
        config=config,
        program=program,
        frames=frames,
        tolerance_mm=tolerance_mm,
        counts_per_turn=counts_per_turn,
        present_counts=present_counts,
        payload_kg=payload_kg,
        temperature_c=temperature_c,
    )
    exported = export_model(form, request) if cell is None else export_from_cell(cell, form, request)
    _print(exported, form, out, kind.title, as_json)


def _print(exported: "Exported", form: str, out: Path, title: str, as_json: bool) -> None:
    """Print what was written, and warnings on stderr."""
    for sentence in exported.warnings:
        print_line(f"pisigma: {sentence}", to_stderr=True)
    if as_json:
        remarks = [*exported.remarks, *exported.warnings]
        print_json({"file": str(out), "format": form, **exported.facts, "remarks": remarks})
    else:
        for line in exported.leading_text.splitlines():
            print_line(line)
        print_lines(
            [
                *exported.remarks,
                f"{exported.sentence_start or title} written to {out}{exported.sentence_end}.",
            ]
        )
    if exported.failure:
        exit_with_error(exported.failure)
    if exported.missed_limit:
        exit_with_error(exported.missed_limit, NOT_ACCEPTED)
