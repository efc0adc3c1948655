"""Read corners in a growing file, image by image, as measurements."""

import os
from dataclasses import replace

import torch

from pisigma.files.errors import MeasurementError
from pisigma.measurement.camera.camera_files import CameraFiles
from pisigma.measurement.camera.corner_file import measurements_of_corners
from pisigma.measurement.csv.table import Table
from pisigma.measurement.dataset import Measurements, join
from pisigma.measurement.faults import Fault
from pisigma.measurement.fields import MeasuredFields, UnusableRow
from pisigma.measurement.growing_file import GrowingFile
from pisigma.planning.plan_settings import PlanSettings
from pisigma.robot.description import Robot


def growing_file(path: str | os.PathLike[str], robot: Robot, settings: PlanSettings) -> GrowingFile:
    """Open the growing file of a plan's rows, or of corners in images if a camera measures."""
    camera = settings.camera
    return GrowingFile(path, robot, None if camera is None else ImageReader(camera.files, robot))


class ImageReader:
    """Reader of a file of corners that reads every image separately, so that a faulty image does not affect others.

    An image is complete when rows of another image follow, or at the end of the session.
    """

    def __init__(self, files: CameraFiles, robot: Robot) -> None:
        """Set up the reader.

        Args:
            files: files of the camera and its board.
            robot: robot that is measured.
        """
        self._files, self._robot = files, robot
        self._read: dict[str, Measurements | UnusableRow] = {}

    def __call__(self, table: Table, final: bool) -> MeasuredFields:
        """Return the poses of the complete images; images that cannot be used are left out."""
        images = list(_images(table))
        read = [self._once(image) for image in (images if final else images[:-1])]
        left_out = tuple(one for one in read if isinstance(one, UnusableRow))
        rows = [one for one in read if isinstance(one, Measurements)]
        if not rows:
            q = torch.zeros(0, self._robot.dof, dtype=torch.float64)
            return MeasuredFields({"q": q}, {}, (), table.source, left_out)
        return replace(join(rows).as_fields(), left_out=left_out)

    def _once(self, image: Table) -> Measurements | UnusableRow:
        key = repr((image.lines[0], image.records))
        if key not in self._read:
            try:
                self._read[key] = measurements_of_corners(image, self._robot, self._files)
            except MeasurementError as problem:
                self._read[key] = _left_out(problem, image)
        return self._read[key]


def _images(table: Table) -> list[Table]:
    """Yield the parts of a table by image; a row without an image is a separate part."""
    column = table.header.index("image") if "image" in table.header else len(table.header)
    groups: dict[str, list[int]] = {}
    for row, fields in enumerate(table.records):
        name = fields[column].strip() if column < len(fields) else ""
        groups.setdefault(name or f"line {table.lines[row]}", []).append(row)
    return [
        replace(
            table,
            records=[table.records[row] for row in rows],
            lines=tuple(table.lines[row] for row in rows),
            invalid_rows={
                number: table.invalid_rows[row]
                for number, row in enumerate(rows)
                if row in table.invalid_rows
            },
        )
        for rows in groups.values()
    ]


def _left_out(problem: MeasurementError, image: Table) -> UnusableRow:
    """Return the faulty row, or the first row of the image if the exception names none, with the reason."""
    line = problem.line or image.lines[0]
    if not problem.expected:
        return UnusableRow(line, str(problem).removesuffix("."))
    return UnusableRow.from_fault(
        line, Fault("", problem.column, problem.expected, problem.value, problem.remedy)
    )
