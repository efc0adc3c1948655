"""Output of the commands for images."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pisigma.cli.output import print_json
from pisigma.cli.screen import print_screen
from pisigma.reporting.result_text import sentence_block, table_block
from pisigma.reporting.verdict import Verdict, count_text

if TYPE_CHECKING:
    from pisigma.workflow.images.calibrate_camera import CameraCalibration
    from pisigma.workflow.images.detect import DetectedCorners

Page = Annotated[Path | None, typer.Option(help="HTML page to write, with the residuals of every image.")]


def check_outputs(
    out: Path, suffixes: tuple[str, ...], content_name: str, page: Path | None, inputs: Sequence[Path | None]
) -> None:
    """Make sure that both files may be written; see `check_output`."""
    from pisigma.files.output_file import check_output, check_page

    check_output(out, suffixes, content_name, inputs)
    if page is not None:
        check_page(page, [*inputs, out])


def write_result(
    result: "CameraCalibration | DetectedCorners",
    verdict: Verdict,
    out: Path,
    page: Path | None,
    as_json: bool,
    verbose: bool,
) -> None:
    """Write a result and its page, and print them."""
    if page is not None:
        result.save_page(page)
    result.save(out)
    if as_json:
        print_json({"file": str(out)} | result.to_json())
        return
    left_out = [f"image {name} is left out: {reason}." for name, reason in result.detection.left_out.items()]
    written = " and ".join(str(file) for file in (out, page) if file is not None)
    print_screen(
        verdict,
        [*result.warnings, *left_out],
        [table_block(title, *cells) for title, cells in result.tables],
        [sentence_block("remarks on the images", result.sentences)],
        [f"Written to {written}."],
        verbose,
    )


def trust_text(warning_count: int, text_without_warnings: str) -> str:
    """Return a sentence on whether to trust a result with a number of warnings."""
    return (
        f"with caution ({count_text(warning_count, 'warning')})." if warning_count else text_without_warnings
    )
