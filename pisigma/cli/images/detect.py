"""`pisigma detect`: corners of a board in images, as a file for `pisigma calibrate`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pisigma.cli.arguments import AsJson, Verbose
from pisigma.cli.images.result import Page, check_outputs, trust_text, write_result
from pisigma.cli.output import print_json, print_lines
from pisigma.cli.progress import progress_of
from pisigma.cli.settings_options import takes_settings
from pisigma.reporting.verdict import Verdict, rounded_text
from pisigma.workflow.settings.images import DetectionSettings

if TYPE_CHECKING:
    from collections.abc import Mapping

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
RobotOfBoard = Annotated[
    str | None,
    typer.Option("--robot", help="Robot for which --print states how large the squares have to be."),
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
    robot: RobotOfBoard = None,
    verbose: Verbose = False,
    as_json: AsJson = False,
) -> None:
    """Detect the corners of a board in images, to a fraction of a pixel.

    Excludes blurred images and images without a complete board, and prints their names.
    """
    if sheet is not None:
        _print_board(board, sheet, robot, camera, as_json)
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
        f"corners fit to {rounded_text(detection.rms)} px RMS of u and v in {len(detection.boards)} of "
        f"{len(detection.images)} images.",
        trust_text(warnings, "yes: every image shows the board."),
        f"{joints}run `pisigma calibrate ROBOT {out} --camera {camera} --board {board} --out DIR`.",
    )


_HEIGHT_PX = 1080
"""Height of the images of a camera that is not stated [px], as in the usual videos of phones."""


def _print_board(board: Path, sheet: Path, robot: str | None, camera: Path | None, as_json: bool) -> None:
    """Write a board as a PDF, and state how large its squares have to be for a robot and a fixed camera."""
    from pisigma.files.output_file import check_output, write_atomically
    from pisigma.measurement.camera.board import Board, smallest_square
    from pisigma.measurement.camera.camera import Camera
    from pisigma.reporting.board_sheet import board_pdf
    from pisigma.robot import Robot

    check_output(sheet, (".pdf",), "a board to print", [board])
    printed = Board.load(board)
    paper, content = board_pdf(printed)
    size: dict[str, float] = {}
    if robot is not None:
        arm, seen = Robot.load(robot), None if camera is None else Camera.load(camera)
        height = _HEIGHT_PX if seen is None else min(seen.width, seen.height)
        size = {
            "image_height_px": height,
            "smallest_square_mm": smallest_square(arm.reach, height) * 1e3,
            "square_mm": printed.square * 1e3,
        }
    write_atomically(sheet, content)
    if as_json:
        print_json({"file": str(sheet), "paper": paper, **size})
    else:
        print_lines(
            [
                f"Board written to {sheet}; print it on {paper} at 100 %, measure the line below the board, and "
                f"state its length in {board} (ruler_mm) if it is not 100 mm.",
                *([_size_text(robot, size)] if robot is not None else []),
            ]
        )


def _size_text(robot: str, size: "Mapping[str, float]") -> str:
    """Return a sentence on the size of the squares."""
    least, square = size["smallest_square_mm"], size["square_mm"]
    advice = (
        "" if square >= least else "; print a larger board, move the camera closer, or record more pixels"
    )
    return (
        f"A fixed camera whose image of {size['image_height_px']:g} px covers the workspace of {robot} resolves "
        f"squares of {least:.0f} mm or more; those of this board are {square:.0f} mm wide{advice}."
    )
