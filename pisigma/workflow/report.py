"""Report on a calibration as one HTML page."""

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pisigma.files.conflicts import Input
from pisigma.files.output_file import check_output, write_whole
from pisigma.files.progress import Progress
from pisigma.measurement.camera.camera_files import CameraFiles
from pisigma.measurement.camera.corner_file import MeasurementFiles, read_rows
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.joint_range import limit_warnings
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.folder.model_folder import load_model
from pisigma.reporting.page.content import ReportContent, report_content
from pisigma.reporting.page.figures import ReportFigures, check_figures, draw_figures, write_figures
from pisigma.reporting.page.page import render_page
from pisigma.validation.checks.rows.wrong_rows import without_wrong_rows
from pisigma.validation.gate import check_rows
from pisigma.validation.held_out.diagnostic import Diagnostic


@dataclass(frozen=True, eq=False)
class Report:
    """A report on a calibration: what it says, and its figures.

    Attributes:
        content: figures and sentences.
        figures: drawings of them.
        diagnostics: why nothing is to be concluded from the rows; see `pisigma.validation.gate`.
        seconds: that it took.
    """

    content: ReportContent
    figures: ReportFigures
    diagnostics: tuple[Diagnostic, ...]
    seconds: float

    @property
    def verdict(self) -> str:
        """How accurate the model is, how much better than nominal, where it is worst and what limits it."""
        return self.content.verdict.sentence

    def to_json(self) -> dict[str, Any]:
        """Return figures and sentences as plain values, without single rows."""
        diagnostics = [one.model_dump() for one in self.diagnostics]
        return self.content.to_json() | {"diagnostics": diagnostics, "seconds": self.seconds}

    def save(
        self, page: str | os.PathLike[str], figures: str | os.PathLike[str] | None = None
    ) -> tuple[Path, ...]:
        """Write the page, and every figure as PNG and SVG into a folder where one is named.

        Args:
            page: file of the page (.html); replaced whole or not at all.
            figures: folder, made where missing.

        Returns:
            The files of the figures.

        Raises:
            OutputError: a file cannot be written.
        """
        check_report_outputs(page, figures)
        write_whole(Path(page), render_page(self.content, self.figures))
        return () if figures is None else tuple(write_figures(self.figures.all, Path(figures)))


def check_report_outputs(
    page: str | os.PathLike[str],
    figures: str | os.PathLike[str] | None = None,
    inputs: Sequence[Input] = (),
) -> None:
    """Make sure that a report may be written: before the work, not after it.

    Args:
        page: file of the page.
        figures: folder of the figures, if they are wanted.
        inputs: files and folders that are read.

    Raises:
        OutputError: the page is no .html file, a file or folder cannot be written, or lies in an input or a model.
    """
    check_output(Path(page), (".html", ".htm"), "a report", inputs)
    if figures is not None:
        check_figures(Path(figures), inputs)


def report(
    model: str | os.PathLike[str],
    data: MeasurementFiles | Measurements | None = None,
    progress: Progress = lambda what: None,
    cameras: CameraFiles | None = None,
) -> Report:
    """Work out a report on a calibration: how accurate, where worst, what limits it, what to measure next.

    Args:
        model: folder of the model.
        data: rows to judge it on, or their file, in the frame that the model was fitted in. None: the held-out rows
            that the folder keeps.
        progress: called with what is being done.
        cameras: what the pixels mean where the rows are corners of boards in images.

    Raises:
        ModelError: the folder cannot be used.
        MeasurementError: the rows cannot be judged.
    """
    begin, loaded = time.perf_counter(), load_model(model)
    progress("judging rows")
    rows: Measurements | None = None
    remarks: tuple[str, ...] = ()
    diagnostics: tuple[Diagnostic, ...] = ()
    if data is not None:
        rows, remarks = _right_rows(loaded, read_rows(data, loaded.robot, cameras))
        diagnostics = check_rows(rows, loaded).implausible
    content = report_content(loaded, Path(model), rows, remarks, diagnostics)
    progress("drawing")
    figures = draw_figures(content)
    return Report(content, figures, diagnostics, time.perf_counter() - begin)


def _right_rows(model: CalibratedModel, rows: Measurements) -> tuple[Measurements, tuple[str, ...]]:
    """Rows without single ones that are wrong, unless the model was made of just these, and what to heed."""
    remarks = limit_warnings(model.robot, rows)
    if model.provenance.data_sha256 == rows.content_hash():
        return rows, remarks
    right = without_wrong_rows([model], rows)
    return right.rows, (*right.warnings, *remarks)
