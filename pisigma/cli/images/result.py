"""What the commands for images write and print."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pisigma.cli.output import print_json, print_lines, print_table

if TYPE_CHECKING:
    from pisigma.workflow.images.calibrate_camera import CameraCalibration
    from pisigma.workflow.images.detect import DetectedCorners

Page = Annotated[
    Path | None, typer.Option(help="HTML page to write: every image with the residuals of its corners.")
]


def check_outputs(
    out: Path, endings: tuple[str, ...], what: str, page: Path | None, inputs: Sequence[Path | None]
) -> None:
    """Make sure that both files may be written; see `check_output`."""
    from pisigma.files.output_file import check_output, check_page

    check_output(out, endings, what, inputs)
    if page is not None:
        check_page(page, [*inputs, out])


def write_result(
    result: "CameraCalibration | DetectedCorners", out: Path, page: Path | None, as_json: bool
) -> None:
    """Write a result and its page, and print what they hold."""
    if page is not None:
        result.save_page(page)
    result.save(out)
    if as_json:
        print_json({"file": str(out)} | result.to_json())
        return
    for title, table in result.tables:
        print_table(title, *table)
    print_lines([*result.sentences, *(f"Warning: {one}" for one in result.warnings)])
    print_lines(f"{file} is written." for file in (out, page) if file is not None)
