"""`pisigma export`: a model in the forms that other programs read."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pisigma.cli.conditions import PayloadKg, TemperatureC, given_conditions

if TYPE_CHECKING:
    from pisigma.model.calibrated_model import CalibratedModel

_SUFFIXES = {
    "urdf": (".urdf",),
    "dh": (".csv", ".yaml", ".yml"),
    "offsets": (".csv", ".yaml", ".yml"),
    "targets": (".csv", ".script", ".src", ".mod", ".ls"),
    "onnx": (".onnx",),
}
_CONTENTS = {
    "urdf": "a URDF",
    "dh": "a DH table",
    "offsets": "a table of joint offsets",
    "targets": "a table or program of targets",
    "onnx": "an ONNX graph",
}


def export(
    model: Annotated[Path, typer.Argument(help="Model folder.")],
    out: Annotated[
        Path,
        typer.Option(
            help="File to write: .urdf; .csv or .yaml for dh and offsets; for targets .csv, .script (URScript), "
            ".src (KUKA), .mod (ABB) or .ls (FANUC); .onnx."
        ),
    ],
    form: Annotated[
        str,
        typer.Option(
            "--format",
            help="urdf: calibrated geometry; dh: its DH + Hayati table with base and tool; offsets: the best "
            "joint offsets alone, with the accuracy that this gives up; targets: corrected targets for --poses; "
            "onnx: the network alone.",
        ),
    ],
    like: Annotated[
        Path | None,
        typer.Option(
            help="With urdf: the URDF file that the robot was loaded from; its links, meshes and limits stay."
        ),
    ] = None,
    tip: Annotated[
        str | None, typer.Option(help="With --like: link that is the tool, as it was given then.")
    ] = None,
    poses: Annotated[
        Path | None,
        typer.Option(
            help="With targets: CSV file of poses, x_mm,y_mm,z_mm,roll_deg,pitch_deg,yaw_deg or qx,qy,qz,qw."
        ),
    ] = None,
    kind: Annotated[
        str | None,
        typer.Option(
            "--targets",
            help="What a program of targets tells the controller: joints (default), or cartesian, for a controller "
            "that computes with the robot as drawn. A .csv file holds both.",
        ),
    ] = None,
    branch: Annotated[
        str | None, typer.Option(help="With targets: branch to take instead of the trained one.")
    ] = None,
    config: Annotated[
        str | None,
        typer.Option(
            help="With .ls and --targets cartesian: the arm's configuration, such as 'N U T, 0, 0, 0'."
        ),
    ] = None,
    payload_kg: PayloadKg = None,
    temperature_c: TemperatureC = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Write a model for other programs, whole or not at all.

    Exit status 2 when a pose of --poses has no target, being unreachable, singular or outside the joint limits: its
    values are empty in a .csv file, and no program is written. Every program is slow and has to be tested.
    """
    from pisigma.cli.output import print_json
    from pisigma.errors import OutputError, nearest_choice

    if form not in _SUFFIXES:
        raise OutputError(f"--format '{form}' is unknown; {nearest_choice(form, _SUFFIXES)}")
    if like is not None and form != "urdf":
        raise OutputError(f"--like goes with --format urdf, not with {form}; leave it out.")
    if tip is not None and like is None:
        raise OutputError("--tip names a link of the file that --like gives; give both or none.")
    _check_target_options(form, poses, kind, branch, config)
    conditions = given_conditions(payload_kg, temperature_c)
    if conditions and form not in ("targets", "offsets"):
        raise OutputError(
            f"--{next(iter(conditions)).replace('_', '-')} goes with --format targets or offsets, not with {form}; "
            "leave it out."
        )
    from pisigma.export.output_file import check_output, write_whole
    from pisigma.model.folder.model_folder import load_model

    check_output(out, _SUFFIXES[form], _CONTENTS[form])
    if poses is not None:
        from pisigma.cli.export_targets import export_targets

        export_targets(model, out, poses, kind, branch, config, conditions, as_json)
        return
    loaded, as_csv = load_model(model), out.suffix.lower() == ".csv"
    if conditions:
        from pisigma.model.stated_conditions import under_stated_conditions

        loaded = under_stated_conditions(loaded, **conditions)
    content: str | bytes
    if form == "onnx":
        content, result = _onnx(loaded, model)
    else:
        content, result = _urdf(loaded, like, tip) if form == "urdf" else _table(loaded, form, as_csv)
    write_whole(out, content)
    if as_json:
        print_json({"file": str(out), "format": form, **result})
        return
    for remark in result["remarks"]:
        typer.echo(remark)
    what = _CONTENTS[form]
    typer.echo(f"{what[0].upper()}{what[1:]} written to {out}.")


def _check_target_options(form: str, poses: Path | None, *options: str | None) -> None:
    """Refuse options of targets without targets, and targets without poses."""
    from pisigma.errors import OutputError

    if form == "targets" and poses is None:
        raise OutputError("--format targets needs the poses to make them for; give them with --poses.")
    names = ("--poses", "--targets", "--branch", "--config")
    for name, value in zip(names, (poses, *options), strict=True):
        if form != "targets" and value is not None:
            raise OutputError(f"{name} goes with --format targets, not with {form}; leave it out.")


def _urdf(model: "CalibratedModel", like: Path | None, tip: str | None) -> tuple[str, dict[str, Any]]:
    """The text of the file, and what to tell about it."""
    from pisigma.export.geometry import calibrated_geometry, remarks

    robot, told = calibrated_geometry(model), remarks(model)
    if like is None:
        from pisigma.robot.writing import robot_to_urdf

        text = robot_to_urdf(robot, told)
    else:
        from pisigma.robot.writing import robot_into_urdf

        text = robot_into_urdf(robot, model.robot, like, tip, told)
    return text, {"robot": robot.name, "joints": robot.dof, "remarks": list(told)}


def _onnx(model: "CalibratedModel", folder: Path) -> tuple[bytes, dict[str, Any]]:
    """The content of the file, and what to tell about it."""
    import hashlib

    from pisigma.export.onnx_model import export_onnx, onnx_remarks

    content = export_onnx(model, hashlib.sha256((folder / "model.yaml").read_bytes()).hexdigest())
    return content, {
        "robot": model.robot.name,
        "joints": model.robot.dof,
        "remarks": list(onnx_remarks(model)),
    }


def _table(model: "CalibratedModel", form: str, as_csv: bool) -> tuple[str, dict[str, Any]]:
    """The text of the file, and what to tell about it."""
    from pisigma.export.geometry import calibrated_geometry, offset_remarks, remarks

    result: dict[str, Any] = {"robot": model.robot.name, "joints": model.robot.dof}
    if form == "dh":
        from pisigma.export.dh_table import dh_csv, dh_yaml

        robot, told = calibrated_geometry(model), remarks(model)
        return (dh_csv if as_csv else dh_yaml)(robot, told), result | {"remarks": list(told)}
    from pisigma.export.joint_offsets import fit_joint_offsets
    from pisigma.export.offsets_file import offset_sentences, offsets_csv, offsets_yaml

    offsets, told = fit_joint_offsets(model), offset_remarks(model)
    result |= {
        "off_the_whole_model": offsets.lost.in_file_units(),
        "robot_as_drawn": offsets.nominal.in_file_units(),
        "remarks": [*told, *offset_sentences(offsets)],
    }
    return (offsets_csv if as_csv else offsets_yaml)(offsets, told), result
