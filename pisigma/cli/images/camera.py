"""`pisigma camera`: the intrinsics of a camera by images of a board."""

from pathlib import Path
from typing import Annotated

import typer

from pisigma.cli.arguments import AsJson
from pisigma.cli.images.detect import BoardFile
from pisigma.cli.images.result import Page, check_outputs, write_result
from pisigma.cli.output import progress_of
from pisigma.cli.settings_options import takes_settings
from pisigma.workflow.settings.images import IntrinsicsSettings

Images = Annotated[list[Path], typer.Argument(help="Image files of one camera, or folders of them.")]


@takes_settings
def camera(
    images: Images,
    board: BoardFile,
    out: Annotated[Path, typer.Option(help="File of the camera to write (.yaml).")],
    settings: IntrinsicsSettings,
    page: Page = None,
    as_json: AsJson = False,
) -> None:
    """Calibrate the intrinsics of a camera by images of a board, with standard deviations.

    Take 20 images or more that fill the whole frame, most of them 20 to 40 deg oblique.
    """
    check_outputs(out, (".yaml", ".yml"), "a camera", page, [*images, board])
    from pisigma.workflow.images import calibrate_camera as workflow

    with progress_of("camera") as progress:
        calibrated = workflow.calibrate_camera(images, board, settings, progress)
    write_result(calibrated, out, page, as_json)
