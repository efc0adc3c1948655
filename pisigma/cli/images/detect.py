"""`pisigma detect`: corners of a board in images, as a file for `pisigma calibrate`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pisigma.cli.arguments import AsJson, Verbose
from pisigma.cli.images.result import Page, check_outputs, trust_text, write_result
from pisigma.cli.output import print_json, print_lines
from pisigma.cli.progress import progress_of
from pisigma.cli.settings_options import takes_settings
from pisigma.reporting.verdict import Verdict, rounded
from pisigma.workflow.settings.images import DetectionSettings

if TYPE_CHECKING:
    from pisigma.workflow.images.detect import DetectedCorners

Images = Annotated[
    list[Path] | None,
    typer.Argument(help="Image files, folders of them, or videos with a stop at every pose."),
]
BoardFile = Annotated[Path, typer.Option(help="File of the board in the images (YAML).")]
CameraFile = Annotated[Path | None, typer.Option(help="File of the camera that took the images (YAML).")]
Out = Annotated[Path | None, typer.Option(help="Corner file to write (.csv).")]
Print = Annotated[
    Path | None,
    typer.Option("--print", help="Only write a page for printing the board at true size (.pdf)."),
]
Joints = Annotated[
    Path | None,
    typer.Option(
        help="Joint values (CSV) with a column 'image', or 'time' if images are named by time stamps."
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
    verbose: Verbose = False,
    as_json: AsJson = False,
) -> None:
    """Detect the corners of a board in images, to a fraction of a pixel.

    Excludes blurred images and images without a complete board, and prints their names.
    """
    if sheet is not None:
        _print_board(board, sheet, as_json)
        return
    if not images or camera is None or out is None:
        raise typer.BadParameter("expected IMAGES, --camera and --out, or --print to draw the board")
    check_outputs(out, (".csv",), "a file of corners", page, [*images, board, camera, joints])
    from pisigma.workflow.images import detect as workflow

    with progress_of("detect") as progress:
        detected = workflow.detect(images, board, camera, joints, settings, progress)
    write_result(detected, _verdict(detected, out, camera, board), out, page, as_json, verbose)


def _verdict(detected: "DetectedCorners", out: Path, camera: Path, board: Path) -> Verdict:
    """Return the verdict on the corners of a board."""
    detection = detected.detection
    warnings = len(detected.warnings) + len(detection.left_out)
    joints = "" if detected.joints else "add the joint values, then "
    return Verdict(
        f"corners fit to {rounded(detection.rms)} px RMS of u and v in {len(detection.boards)} of "
        f"{len(detection.images)} images.",
        trust_text(warnings, "yes: every image shows the board."),
        f"{joints}run `pisigma calibrate ROBOT {out} --camera {camera} --board {board} --out DIR`.",
    )


def _print_board(board: Path, sheet: Path, as_json: bool) -> None:
    """Write a board as a PDF."""
    from pisigma.files.output_file import check_output, write_atomically
    from pisigma.measurement.camera.board import Board
    from pisigma.reporting.board_sheet import board_pdf

    check_output(sheet, (".pdf",), "a board to print", [board])
    paper, content = board_pdf(Board.load(board))
    write_atomically(sheet, content)
    if as_json:
        print_json({"file": str(sheet), "paper": paper})
    else:
        print_lines(
            [
                f"Board written to {sheet}; print it on {paper} at 100 %, measure the line below the board, and "
                f"state its length in {board} (ruler_mm) if it is not 100 mm."
            ]
        )
