"""`pisigma camera`: the intrinsics of a camera from images of a board."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pisigma.cli.arguments import AsJson, Verbose
from pisigma.cli.images.detect import BoardFile
from pisigma.cli.images.result import Page, check_outputs, trust_text, write_result
from pisigma.cli.progress import progress_of
from pisigma.cli.settings_options import takes_settings
from pisigma.reporting.verdict import Verdict, rounded_text
from pisigma.workflow.settings.images import IntrinsicsSettings

if TYPE_CHECKING:
    from pisigma.workflow.images.calibrate_camera import CameraCalibration

Images = Annotated[list[Path], typer.Argument(help="Image files of one camera, folders of them, or videos.")]


@takes_settings
def camera(
    images: Images,
    board: BoardFile,
    out: Annotated[Path, typer.Option(help="Camera file to write (.yaml).")],
    settings: IntrinsicsSettings,
    page: Page = None,
    verbose: Verbose = False,
    as_json: AsJson = False,
) -> None:
    """Calibrate the intrinsics of a camera from images of a board, with standard deviations.

    Take 20 images or more in which the board covers all parts of the frame, most of them tilted by 20 to 40 deg.
    """
    check_outputs(out, (".yaml", ".yml"), "a camera", page, [*images, board])
    from pisigma.workflow.images import calibrate_camera as workflow

    with progress_of("camera") as progress:
        calibrated = workflow.calibrate_camera(images, board, settings, progress)
    write_result(calibrated, _verdict(calibrated, out), out, page, as_json, verbose)


def _verdict(calibrated: "CameraCalibration", out: Path) -> Verdict:
    """Return the verdict on the intrinsics of a camera."""
    detection, covered = calibrated.detection, calibrated.calibration.covered_cells.mean()
    _, fx, sigma, _ = calibrated.parameters[0]
    return Verdict(
        f"corners fit to {rounded_text(detection.rms)} px RMS of u and v in {len(detection.boards)} of "
        f"{len(detection.images)} images; focal length {fx:.5g} +- {sigma:.2g} px.",
        trust_text(
            len(calibrated.warnings), f"yes: corners cover {100 * covered:.0f} % of the cells of the image."
        ),
        (
            "take the images that the warnings ask for"
            if calibrated.warnings
            else "detect corners of robot poses"
        )
        + f", then run `pisigma detect IMAGES --camera {out} --board BOARD --joints JOINTS.csv --out CORNERS.csv`.",
    )
