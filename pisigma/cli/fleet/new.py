"""`pisigma new`: create a cell, or the cells of a manifest or a model folder."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pisigma.cli.arguments import AsJson, complete_robot
from pisigma.cli.cell import print_next
from pisigma.cli.endings import NOT_ACCEPTED
from pisigma.cli.output import print_json, print_lines
from pisigma.cli.screen import print_screen

if TYPE_CHECKING:
    from pisigma.workflow.fleet.manifest import NewCells


def new(
    robot: Annotated[
        str,
        typer.Argument(
            metavar="[ROBOT]",
            help="Catalogue name or robot file (YAML or URDF); with --from, robot for manifest rows that do not "
            "state one.",
            autocompletion=complete_robot,
        ),
    ] = "",
    *,
    out: Annotated[Path, typer.Option(help="Cell to write; with a manifest, folder of cells to write.")],
    source: Annotated[
        Path | None,
        typer.Option(
            "--from",
            metavar="PATH",
            help="Model folder, manifest (CSV with the columns id, robot and data), or folder with the rows of every "
            "robot.",
        ),
    ] = None,
    sensor: Annotated[
        str, typer.Option(help="Sensor: tracker, camera, sockets, draw-wire or touch.")
    ] = "tracker",
    limit_mm: Annotated[
        float | None, typer.Option(help="Limit on the 95 % quantile of the position errors [mm].")
    ] = None,
    base: Annotated[str | None, typer.Option(help="Base link of a URDF file, to which poses refer.")] = None,
    tip: Annotated[str | None, typer.Option(help="Tool link of a URDF file.")] = None,
    camera: Annotated[list[Path] | None, typer.Option(help="Camera file (YAML); may be repeated.")] = None,
    board: Annotated[list[Path] | None, typer.Option(help="Board file (YAML); may be repeated.")] = None,
    fixed_camera: Annotated[
        bool,
        typer.Option("--fixed-camera", help="The camera is fixed and the board is on the flange."),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Create a cell: the folder of one robot on its mount, with its settings, sessions, models and history.

    With --from MODEL_FOLDER, create a cell that uses this model; with --from MANIFEST, create a cell for every robot,
    or add the new rows if the cell already exists. Exits with status 3 if a robot of the manifest cannot be used.
    """
    from pisigma.files.model_files import is_model
    from pisigma.measurement.camera.camera_files import CameraFiles
    from pisigma.workflow.cell.cell import Cell
    from pisigma.workflow.cell.new_cell import NewCell, cell_from_model
    from pisigma.workflow.fleet.manifest import new_cells

    cameras = None
    if camera or board:
        cameras = CameraFiles(tuple(map(str, camera or ())), tuple(map(str, board or ())), fixed_camera)
    cell = NewCell(robot, sensor, limit_mm, base, tip, cameras)
    if source is not None and not is_model(source):
        return _print_cells(new_cells(source, out, cell), out, as_json)
    if bool(robot) is (source is not None):
        raise typer.BadParameter("expected either ROBOT or --from MODEL_FOLDER")
    (cell if source is None else cell_from_model(source, cell)).write(out)
    status = Cell.open(out).status()
    if as_json:
        print_json({"cell": str(out), **status.to_json()})
        return
    print_lines([f"Cell written to {out}; its cell.yaml states every setting with its default."])
    print_next(status)


def _print_cells(made: "NewCells", out: Path, as_json: bool) -> None:
    """Print how many cells were created, and which robots were refused."""
    from pisigma.reporting.verdict import Verdict, count_text

    if as_json:
        print_json(made.to_json())
    else:
        refused = [f"{name}: {reason}" for name, reason in made.refused.items()]
        verdict = Verdict(
            f"{count_text(made.created, 'cell')} created, {count_text(made.sessions, 'file')} of rows added, in {out}.",
            f"no: {count_text(len(refused), 'robot')} refused."
            if refused
            else "yes: all robots have a cell.",
            f"`pisigma fleet run {out}`.",
            "Done",
        )
        print_screen(verdict, refused)
    if made.refused:
        raise typer.Exit(NOT_ACCEPTED)
