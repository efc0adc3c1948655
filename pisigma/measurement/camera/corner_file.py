"""Read files of corners, which may contain rows of other sensors, as measurements."""

import os
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float64, Int64

from pisigma.files.errors import MeasurementError, Phrase, Place, choice_remedy
from pisigma.measurement.camera.board import Board
from pisigma.measurement.camera.board_pose import MIN_CORNERS
from pisigma.measurement.camera.camera import Camera
from pisigma.measurement.camera.camera_files import CameraFiles
from pisigma.measurement.camera.image_rows import Images, image_measurements
from pisigma.measurement.copies import without_copies
from pisigma.measurement.csv.columns import CORNERS, POSITION
from pisigma.measurement.csv.reading import fields_of, number_column, text_column
from pisigma.measurement.csv.table import Table, read_table
from pisigma.measurement.dataset import Measurements, join
from pisigma.measurement.faults import Fault, RowPlace
from pisigma.measurement.fields import MeasuredFields
from pisigma.measurement.sensors.intrinsics import NOISE_COLUMN
from pisigma.robot.description import Robot

_SAME_JOINTS = 1e-9
"""Largest difference between the joint values in the rows of one image [rad or m]."""
_RESOLUTION_IMAGES = 8
"""Smallest number of images for the check that some show corners outside the upper left quarter of the field of
view."""
_CONDITIONS = ("split", "payload", "temperature", "approach", "torque", "date")
"""Fields that rows of corners may have in addition to joint values and pixels."""
_IMAGE_COLUMNS = (*CORNERS, "sigma_px", "camera", "board")
"""Columns that only rows of corners have."""

MeasurementFiles = str | os.PathLike[str] | Sequence[str | os.PathLike[str]]
CameraOrBoard = TypeVar("CameraOrBoard", Camera, Board)


def read_corners(path: str | os.PathLike[str], robot: Robot, cameras: CameraFiles) -> Measurements:
    """Read a CSV file of corners: `image`, `corner`, `u_px`, `v_px` and the joints (`q1_deg` and so on).

    The rows of one image have the same image name and joint values. With several cameras or boards, the columns
    `camera` and `board` name those of the image. Corners are weighted by 1 / `sigma_px`². Rows without a corner belong
    to other sensors.

    Returns:
        One row per image, in the frame of the board with the camera as target (the other way round for a fixed camera)
        and with the weights of `CornerSensor`; and the rows of other sensors.

    Raises:
        MeasurementError: a file cannot be used, or the corners of an image do not fit its board.
    """
    table = read_table(path)
    if not set(CORNERS) & set(table.header):
        return Measurements.read_csv(path, robot)
    return measurements_of_corners(table, robot, cameras)


def measurements_of_corners(table: Table, robot: Robot, files: CameraFiles) -> Measurements:
    """Convert rows of a file of corners to measurements; see `read_corners`."""
    cameras = _by_name(Camera.load, files.cameras, "camera")
    boards = _by_name(Board.load, files.boards, "board")
    is_corner = _are_corners(table)
    rows = Measurements.from_fields(fields_of(_without_corners(table, is_corner), robot))
    corners = _some(table, is_corner)
    of_camera, of_board = _stated(corners, "camera", cameras), _stated(corners, "board", boards)
    numbers = np.flatnonzero(is_corner)
    measured = [rows.select(torch.from_numpy(np.flatnonzero(~np.array(is_corner))))]
    for camera, board in dict.fromkeys(zip(of_camera, of_board, strict=True)):
        chosen = [pair == (camera, board) for pair in zip(of_camera, of_board, strict=True)]
        stated = rows.select(torch.from_numpy(numbers[chosen]))
        images, first = _images(_some(corners, chosen), stated, cameras[camera], boards[board])
        solved = image_measurements(
            images,
            cameras[camera],
            boards[board],
            files.is_fixed or cameras[camera].is_fixed,
            files.repeatability,
            files.intrinsics,
        )
        conditions = {name: getattr(stated.select(first), name) for name in _CONDITIONS}
        last = dict(zip(stated.image or (), stated.line, strict=True))
        measured.append(replace(solved, last_line=tuple(last[name] for name in images.names), **conditions))
    joined = join([one for one in measured if one.rows])
    return joined.select(torch.tensor(joined.line).argsort(stable=True))


def read_rows(
    data: Measurements | MeasurementFiles, robot: Robot, cameras: CameraFiles | None = None
) -> Measurements:
    """Read measurements of any sensors from one or several files, without duplicate rows.

    Args:
        data: measurements, or files of them.
        robot: the measured robot.
        cameras: cameras and boards of the files of corners.

    Raises:
        MeasurementError: a file cannot be used, the files do not fit together, or cameras are given but no file has
            corners.
    """

    def without_duplicates(rows: MeasuredFields) -> MeasuredFields:
        return without_copies(rows, robot)

    if isinstance(data, Measurements):
        return join([data], without_duplicates)
    paths = [data] if isinstance(data, str | os.PathLike) else list(data)
    if len({os.path.realpath(path) for path in paths}) < len(paths):
        raise MeasurementError(
            "the same file is given twice",
            option="data",
            value=", ".join(map(str, paths)),
            remedy="give every file once",
        )
    if cameras is None:
        rows = [Measurements.read_csv(path, robot) for path in paths]
    else:
        rows = [read_corners(path, robot, cameras) for path in paths]
        if not any("corner" in one.kinds for one in rows):
            raise MeasurementError(
                expected=f"corners of images for the given camera, with the columns {', '.join(CORNERS)}",
                at=Place(rows[0].source),
                remedy="add a file of corners, or omit camera and board",
            )
    return with_common_noise(join(rows, without_duplicates))


def with_common_noise(rows: Measurements) -> Measurements:
    """Return the rows with a common noise of all corners; the weights contain the differences between cameras."""
    noise = rows.readings.get(NOISE_COLUMN)
    if not isinstance(noise, torch.Tensor):
        return rows
    mean = torch.where(noise.isnan(), noise, noise.square().nanmean().sqrt())
    return replace(rows, readings={**rows.readings, NOISE_COLUMN: mean})


def _by_name(
    load: Callable[[str], CameraOrBoard], paths: Sequence[str], what: str
) -> dict[str, CameraOrBoard]:
    """Return cameras or boards, loaded from files, by name."""
    loaded: dict[str, CameraOrBoard] = {}
    for path in paths:
        one = load(path)
        if one.name in loaded:
            raise MeasurementError(
                f"another {what} has the same name '{one.name}'",
                at=Place(path, column="name"),
                value=one.name,
                remedy="give each a different 'name' in its file",
            )
        loaded[one.name] = one
    return loaded


def _stated(table: Table, column: str, choices: Collection[str]) -> list[str]:
    """Return the camera or board of every row; if there is only one, its name may be omitted."""
    several = len(choices) > 1
    names = [""] * len(table.records)
    if several or column in table.header:
        names = text_column(table, column)
    for row, name in enumerate(names):
        if name not in choices and (name or several):
            raise MeasurementError(
                expected=f"the name of a {column}",
                value=name,
                at=table.place_of(row, column),
                remedy=choice_remedy(name, choices),
            )
    return [name or next(iter(choices)) for name in names]


def _are_corners(table: Table) -> list[bool]:
    """Return the mask of the rows that contain a corner, which are the rows with an image.

    Raises:
        MeasurementError: a column is missing, a row is not valid CSV, or its number of fields differs from that of the
            header.
    """
    for row, fields in enumerate(table.records):
        if row in table.invalid_rows:
            fault = Fault(f"the row is not valid CSV: {table.invalid_rows[row]}", remedy="check the quotes")
            raise fault.error(table.place_of(row))
        if len(fields) != len(table.header):
            raise MeasurementError(
                expected=f"{len(table.header)} fields as in the header",
                value=len(fields),
                at=table.place_of(row),
                remedy="complete the row",
            )
    named, *_ = (text_column(table, name) for name in ("image", *CORNERS))
    return [bool(name) for name in named]


def _some(table: Table, chosen: Sequence[bool]) -> Table:
    """Return the chosen rows of a table."""
    rows = np.flatnonzero(chosen).tolist()
    records, lines = [table.records[row] for row in rows], tuple(table.lines[row] for row in rows)
    return replace(table, records=records, lines=lines, invalid_rows={})


def _without_corners(table: Table, is_corner: Sequence[bool]) -> Table:
    """Return the table as a measurement file, so that joint values and conditions are read and checked in the same way.

    Rows of corners contain the row number instead of the position, which is not known yet.
    """
    unit = "m" if "x_m" in table.header else "mm"
    position = tuple(f"{axis}_{unit}" for axis in POSITION)
    left = [number for number, name in enumerate(table.header) if name not in (*_IMAGE_COLUMNS, *position)]
    index = {name: number for number, name in enumerate(table.header)}
    records = []
    for row, fields in enumerate(table.records):
        measured = [fields[index[name]] if name in index else "" for name in position]
        records.append(
            [fields[number] for number in left] + ([f"{row}e-3", "0", "0"] if is_corner[row] else measured)
        )
    return replace(table, header=(*(table.header[number] for number in left), *position), records=records)


def _images(
    table: Table, rows: Measurements, camera: Camera, board: Board
) -> tuple[Images, Int64[torch.Tensor, " images"]]:
    """Group the corners of one camera and one board by image.

    Returns:
        The images, and the row number of the first corner of each.
    """
    number, u, v = (number_column(table, name) for name in CORNERS)
    pixels = np.stack([u, v], -1)
    sigma = number_column(table, "sigma_px") if "sigma_px" in table.header else np.ones(len(u))
    _check_corners(table, number, pixels, sigma, camera, board)
    of_image: dict[str, list[int]] = {}
    for row, name in enumerate(rows.image or ()):
        of_image.setdefault(name, []).append(row)
    for name, chosen in of_image.items():
        _check_image(table, name, chosen, rows.q, number)
    if len(of_image) >= _RESOLUTION_IMAGES:
        _check_resolution(table, pixels, camera)
    first = torch.tensor([chosen[0] for chosen in of_image.values()])
    images = Images(
        source=table.source,
        names=tuple(of_image),
        q=rows.q[first],
        lines=tuple(table.lines[row] for row in first.tolist()),
        corner_numbers=tuple(number[chosen].astype(int) for chosen in of_image.values()),
        pixels=tuple(pixels[chosen] for chosen in of_image.values()),
        sigma=tuple(sigma[chosen] for chosen in of_image.values()),
    )
    return images, first


def _check_corners(
    table: Table,
    number: Float64[np.ndarray, " rows"],
    pixels: Float64[np.ndarray, "rows 2"],
    sigma: Float64[np.ndarray, " rows"],
    camera: Camera,
    board: Board,
) -> None:
    """Refuse corners that the board lacks, pixels outside the image, and standard deviations of 0 or less.

    Raises:
        MeasurementError: a corner, a pixel or a standard deviation is not valid.
    """
    corners, size = len(board.corners), np.array([camera.width, camera.height])
    for row, corner in enumerate(number):
        if corner != round(corner) or not 0 <= corner < corners:
            raise MeasurementError(
                expected=f"a whole number from 0 to {corners - 1} for the {corners} corners of board '{board.name}'",
                value=float(corner),
                at=table.place_of(row, "corner"),
                remedy="check the board's rows and columns",
            )
        if not sigma[row] > 0:
            raise MeasurementError(
                expected="a standard deviation > 0",
                value=float(sigma[row]),
                at=table.place_of(row, "sigma_px"),
            )
        if (pixels[row] < -1).any() or (pixels[row] > size).any():
            raise MeasurementError(
                expected=f"a corner within the {camera.width} x {camera.height} px of camera '{camera.name}'",
                value=Phrase(f"u = {pixels[row, 0]:g}, v = {pixels[row, 1]:g} px"),
                at=table.place_of(row),
                remedy=_RESOLUTION_REMEDY,
            )


_RESOLUTION_REMEDY = "give the camera's intrinsics at the resolution of the images"


def _check_resolution(table: Table, pixels: Float64[np.ndarray, "rows 2"], camera: Camera) -> None:
    """Refuse images if none of them shows a corner outside the upper left quarter of the field of view.

    Raises:
        MeasurementError: the images of a camera show corners only in the upper left quarter.
    """
    if (pixels.max(0) < np.array([camera.width, camera.height]) / 2).all():
        raise MeasurementError(
            expected=f"corners across the {camera.width} x {camera.height} px of camera '{camera.name}'",
            value=Phrase(f"corners within {pixels[:, 0].max():.0f} x {pixels[:, 1].max():.0f} px"),
            at=Place(table.source),
            remedy=_RESOLUTION_REMEDY,
        )


def _check_image(
    table: Table,
    name: str,
    rows: list[int],
    q: Float64[torch.Tensor, "rows dof"],
    number: Float64[np.ndarray, " rows"],
) -> None:
    """Refuse an image with invalid corners.

    Raises:
        MeasurementError: the image has too few corners, a duplicate corner, or different joint values.
    """
    at = RowPlace(table.source, table.lines[rows[0]], image=name)
    if len(rows) < MIN_CORNERS:
        raise MeasurementError(
            expected=f"{MIN_CORNERS} or more corners", value=len(rows), at=at, remedy="remove the image"
        )
    if len(set(number[rows])) < len(rows):
        raise MeasurementError(
            "a corner appears twice",
            at=replace(at, column="corner"),
            remedy="give every image a different name",
        )
    if float((q[rows] - q[rows[0]]).abs().max()) > _SAME_JOINTS:
        raise MeasurementError(
            "the rows of the image have different joint values",
            at=replace(at, column="image"),
            value=name,
            remedy="give every image a different name, and all of its rows the joint values at which it was taken",
        )
