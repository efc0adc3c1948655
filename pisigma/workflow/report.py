"""Report on a calibration as one HTML file."""

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pisigma.files.conflicts import Input
from pisigma.files.errors import MeasurementError, Phrase
from pisigma.files.output_file import check_output, write_atomically
from pisigma.files.progress import Progress
from pisigma.lifetime.cell.acceptance import Acceptance
from pisigma.measurement.camera.camera_files import CameraFiles
from pisigma.measurement.camera.corner_file import MeasurementFiles, read_rows
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.exceeded_limits import limit_warnings
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.folder.model_folder import load_model
from pisigma.reporting.page.content import ReportContent, report_content
from pisigma.reporting.page.drawing import check_figures_writable, write_figures
from pisigma.reporting.page.figures import ReportFigures, draw_figures
from pisigma.reporting.page.page import render_page
from pisigma.validation.checks.wrong_rows import without_wrong_rows
from pisigma.validation.gate import check_rows
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.report.arm_in_images import ArmInImages, arm_in_images


@dataclass(frozen=True, eq=False)
class Report:
    """Result of `report`: text and figures of a report on a calibration.

    Attributes:
        content: numbers and sentences.
        figures: drawn figures.
        diagnostics: reasons why the rows must not be trusted; see `pisigma.validation.gate`.
        seconds: computing time [s].
        acceptance: statements for the acceptance of the robot of a cell; None if there is no cell.
    """

    content: ReportContent
    figures: ReportFigures
    diagnostics: tuple[Diagnostic, ...]
    seconds: float
    acceptance: Acceptance | None = None

    @property
    def verdict(self) -> str:
        """Return a sentence on accuracy, improvement over nominal, and place and cause of the largest errors."""
        return self.content.verdict.sentence

    def to_json(self) -> dict[str, Any]:
        """Return numbers and sentences as plain values, without individual rows."""
        diagnostics = [one.model_dump(by_alias=True) for one in self.diagnostics]
        accepted = {} if self.acceptance is None else {"acceptance": self.acceptance.to_json()}
        return self.content.to_json() | {"diagnostics": diagnostics, "seconds": self.seconds} | accepted

    def save(
        self, page: str | os.PathLike[str], figure_folder: str | os.PathLike[str] | None = None
    ) -> tuple[Path, ...]:
        """Write the HTML page and, if a folder is given, every figure as PNG and SVG.

        Args:
            page: file of the page (.html); replaced completely or not at all.
            figure_folder: folder of the figures, created if missing.

        Returns:
            The files of the figures.

        Raises:
            OutputError: a file cannot be written.
        """
        check_report_outputs(page, figure_folder)
        write_atomically(Path(page), render_page(self.content, self.figures, self.acceptance))
        return () if figure_folder is None else tuple(write_figures(self.figures.all, Path(figure_folder)))


def check_report_outputs(
    page: str | os.PathLike[str],
    figure_folder: str | os.PathLike[str] | None = None,
    inputs: Sequence[Input] = (),
) -> None:
    """Check that a report can be written, before it is computed.

    Args:
        page: file of the page.
        figure_folder: folder of the figures; None for no files of figures.
        inputs: files and folders that are read.

    Raises:
        OutputError: the page is not an .html file, or an output cannot be written or is inside an input or a model.
    """
    check_output(Path(page), (".html", ".htm"), "a report", inputs)
    if figure_folder is not None:
        check_figures_writable(Path(figure_folder), inputs)


def report(
    model: str | os.PathLike[str],
    data: MeasurementFiles | Measurements | None = None,
    progress: Progress = lambda what: None,
    cameras: CameraFiles | None = None,
    acceptance: Acceptance | None = None,
    images: Sequence[str | os.PathLike[str]] = (),
) -> Report:
    """Report on a calibration: accuracy, place and cause of the largest errors, and what to measure next.

    Args:
        model: folder of the model.
        data: rows on which the model is evaluated, or their file, in the frame in which the model was fitted; None for
            the held-out rows of the folder.
        progress: called with the current step.
        cameras: cameras and boards, for files of detected board corners.
        acceptance: statements of a cell that the report contains, see `pisigma.workflow.cell.acceptance`.
        images: image files, folders of them, or videos, from which the corners in `data` were detected; the nominal
            and the calibrated arm are drawn over them.

    Raises:
        ModelError: the folder cannot be used.
        MeasurementError: the model cannot be evaluated on the rows.
    """
    started, loaded = time.perf_counter(), load_model(model)
    progress("evaluating rows")
    rows: Measurements | None = None
    remarks: tuple[str, ...] = ()
    diagnostics: tuple[Diagnostic, ...] = ()
    if data is not None:
        rows, remarks = _filtered_rows(loaded, read_rows(data, loaded.robot, cameras))
        diagnostics = check_rows(rows, loaded).implausible_findings
    arm = _arm_in_images(loaded, rows, cameras, images) if images else None
    content = report_content(loaded, Path(model), rows, remarks, diagnostics, arm)
    progress("drawing")
    figures = draw_figures(content)
    if arm is not None:
        from pisigma.reporting.page.images import arm_pictures  # imports OpenCV

        figures = replace(figures, images=arm_pictures(arm))
    return Report(content, figures, diagnostics, time.perf_counter() - started, acceptance)


def _arm_in_images(
    model: CalibratedModel,
    rows: Measurements | None,
    cameras: CameraFiles | None,
    images: Sequence[str | os.PathLike[str]],
) -> ArmInImages:
    """Return the nominal and the calibrated arm in images.

    Raises:
        MeasurementError: there is no file of corners, or the images are not those of this file.
    """
    if rows is None or cameras is None:
        raise MeasurementError(
            expected="the file of corners of the images, with their cameras and boards",
            value=Phrase("images only"),
            option="--images",
            remedy="give the file of `pisigma detect`, --camera and --board",
        )
    from pisigma.measurement.camera.detection.detector import image_files  # imports OpenCV

    return arm_in_images(model, rows, cameras, image_files(images))


def _filtered_rows(model: CalibratedModel, rows: Measurements) -> tuple[Measurements, tuple[str, ...]]:
    """Return the rows except single wrong rows, unless the model was fitted to exactly these rows, and warnings."""
    remarks = limit_warnings(model.robot, rows)
    if model.provenance.data_sha256 == rows.content_hash():
        return rows, remarks
    right = without_wrong_rows([model], rows)
    return right.rows, (*right.warnings, *remarks)
