"""`pisigma detect`: corners of a board in images, as a file for `pisigma calibrate`."""

from pathlib import Path
from typing import Annotated

import typer

from pisigma.cli.arguments import AsJson
from pisigma.cli.endings import fail
from pisigma.cli.images.result import Page, check_outputs, write_result
from pisigma.cli.output import print_json, print_lines, progress_of
from pisigma.cli.settings_options import takes_settings
from pisigma.workflow.settings.images import DetectionSettings

Images = Annotated[list[Path] | None, typer.Argument(help="Image files, or folders of them.")]
BoardFile = Annotated[Path, typer.Option(help="Board (YAML) that the images show.")]
CameraFile = Annotated[Path | None, typer.Option(help="Camera (YAML) that took the images.")]
Out = Annotated[Path | None, typer.Option(help="File of corners to write (.csv).")]
Print = Annotated[
    Path | None,
    typer.Option("--print", help="Draw the board at its true size instead, to be printed (.pdf)."),
]
Joints = Annotated[
    Path | None,
    typer.Option(
        help="Joint values (CSV) with a column 'image', or 'time' where images are named by their time."
    ),
]


@takes_settings
def detect(
    board: BoardFile,
    settings: DetectionSettings,
    images: Images = None,
    camera: CameraFile = None,
    out: Out = None,
    joints: Joints = None,
    page: Page = None,
    sheet: Print = None,
    as_json: AsJson = False,
) -> None:
    """Find the corners of a board in images, to sub-pixel.

    Images without a whole board and blurred ones are named and left out.
    """
    if sheet is not None:
        _print_board(board, sheet, as_json)
        return
    if not images or camera is None or out is None:
        fail("IMAGES, --camera, and --out were wanted; state them, or --print to draw the board.")
    check_outputs(out, (".csv",), "a file of corners", page, [*images, board, camera, joints])
    from pisigma.workflow.images import detect as workflow

    with progress_of("detect") as progress:
        detected = workflow.detect(images, board, camera, joints, settings, progress)
    write_result(detected, out, page, as_json)


def _print_board(board: Path, sheet: Path, as_json: bool) -> None:
    """Write a board as a PDF."""
    from pisigma.files.output_file import check_output, write_whole
    from pisigma.measurement.camera.board import Board
    from pisigma.reporting.board_sheet import board_pdf

    check_output(sheet, (".pdf",), "a board to print", [board])
    paper, content = board_pdf(Board.load(board))
    write_whole(sheet, content)
    if as_json:
        print_json({"file": str(sheet), "paper": paper})
    else:
        print_lines([f"Board written to {sheet}; print it on {paper} at 100 % and check the ruler."])
