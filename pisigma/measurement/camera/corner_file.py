"""Files of corners, in which rows of other sensors may stand, as measurements."""

import os
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float64, Int64

from pisigma.files.errors import MeasurementError, nearest_choice
from pisigma.measurement.camera.board import Board
from pisigma.measurement.camera.board_pose import FEWEST_CORNERS
from pisigma.measurement.camera.camera import Camera
from pisigma.measurement.camera.camera_files import CameraFiles
from pisigma.measurement.camera.image_rows import Images, image_measurements
from pisigma.measurement.copies import without_copies
from pisigma.measurement.csv.columns import CORNERS, POSITION
from pisigma.measurement.csv.reading import fields_of, number_column, text_column
from pisigma.measurement.csv.table import Table, read_table
from pisigma.measurement.dataset import Measurements, join
from pisigma.measurement.fields import MeasuredFields
from pisigma.measurement.sensors.intrinsics import NOISE_COLUMN
from pisigma.robot.description import Robot

SAME_JOINTS = 1e-9
"""[rad or m] Joint values of one image differ by no more."""
SEVERAL = 8
"""Images of which some show corners beyond a quarter of what the camera sees."""
CONDITIONS = ("split", "payload", "temperature", "approach", "date")
"""What rows of corners may state beside joints and pixels, as any other rows."""
OF_IMAGES = (*CORNERS, "sigma_px", "camera", "board")
"""Columns that only rows of corners have."""

MeasurementFiles = str | os.PathLike[str] | Sequence[str | os.PathLike[str]]
CameraOrBoard = TypeVar("CameraOrBoard", Camera, Board)


def read_corners(path: str | os.PathLike[str], robot: Robot, cameras: CameraFiles) -> Measurements:
    """Read a CSV file of corners: `image`, `corner`, `u_px`, `v_px` and the joints (`q1_deg` and so on).

    Rows of one image have one name and the same joint values. `camera` and `board` name what an image was taken by
    and shows, where there are several; corners count by 1 / `sigma_px`². Rows without a corner are those of other
    sensors.

    Returns:
        One row an image, in the frame of the board with the camera as target (of a fixed camera the other way
        round), with the weights of `CornerSensor`; and the rows of other sensors.

    Raises:
        MeasurementError: a file cannot be used, or the corners of an image are not of its board; the message names
            the line.
    """
    table = read_table(path)
    if not set(CORNERS) & set(table.header):
        return Measurements.read_csv(path, robot)
    return corners_of(table, robot, cameras)


def corners_of(table: Table, robot: Robot, files: CameraFiles) -> Measurements:
    """Turn rows of a file of corners into measurements; see `read_corners`."""
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
        conditions = {name: getattr(stated.select(first), name) for name in CONDITIONS}
        measured.append(replace(solved, **conditions))
    joined = join([one for one in measured if one.rows])
    return joined.select(torch.tensor(joined.line).argsort(stable=True))


def read_rows(
    data: Measurements | MeasurementFiles, robot: Robot, cameras: CameraFiles | None = None
) -> Measurements:
    """Read measurements of any sensors from one file or several; what stands there twice counts once.

    Args:
        data: measurements, or files of them.
        robot: that was measured.
        cameras: what the pixels mean where files hold corners.

    Raises:
        MeasurementError: a file cannot be used, the files do not fit together, or cameras are stated and there are no
            corners.
    """

    def counted_once(rows: MeasuredFields) -> MeasuredFields:
        return without_copies(rows, robot)

    if isinstance(data, Measurements):
        return join([data], counted_once)
    paths = [data] if isinstance(data, str | os.PathLike) else list(data)
    if len({os.path.realpath(path) for path in paths}) < len(paths):
        raise MeasurementError(
            f"{', '.join(map(str, paths))}: a file is stated twice; state every file once."
        )
    if cameras is None:
        rows = [Measurements.read_csv(path, robot) for path in paths]
    else:
        rows = [read_corners(path, robot, cameras) for path in paths]
        if not any("corner" in one.kinds for one in rows):
            raise MeasurementError(
                f"{rows[0].source}: corners of images were wanted, as a camera is stated, but there is none of the "
                f"columns {', '.join(CORNERS)}; add a file of corners, or leave camera and board out."
            )
    return with_one_noise(join(rows, counted_once))


def with_one_noise(rows: Measurements) -> Measurements:
    """Return the rows with one noise of corners, as their weights say how cameras differ."""
    noise = rows.readings.get(NOISE_COLUMN)
    if not isinstance(noise, torch.Tensor):
        return rows
    mean = torch.where(noise.isnan(), noise, noise.square().nanmean().sqrt())
    return replace(rows, readings={**rows.readings, NOISE_COLUMN: mean})


def _by_name(
    load: Callable[[str], CameraOrBoard], paths: Sequence[str], what: str
) -> dict[str, CameraOrBoard]:
    """Load cameras or boards, by their names."""
    loaded: dict[str, CameraOrBoard] = {}
    for path in paths:
        one = load(path)
        if one.name in loaded:
            raise MeasurementError(
                f"{path}: another {what} is called '{one.name}', too; give each a `name` of its own in its file."
            )
        loaded[one.name] = one
    return loaded


def _stated(table: Table, column: str, choices: Collection[str]) -> list[str]:
    """Return which camera or board every row is of; with one choice its name may be left out."""
    several = len(choices) > 1
    names = [""] * len(table.records)
    if several or column in table.header:
        names = text_column(table, column)
    for line, name in zip(table.lines, names, strict=True):
        if name not in choices and (name or several):
            raise MeasurementError(
                f"{table.source}, line {line}, column '{column}': the name of a {column} was wanted, got '{name}'; "
                f"{nearest_choice(name, choices)}"
            )
    return [name or next(iter(choices)) for name in names]


def _are_corners(table: Table) -> list[bool]:
    """Return which rows hold a corner: those with an image.

    Raises:
        MeasurementError: a column is missing, or a row is no valid CSV or has not as many fields as the header.
    """
    for row, (line, fields) in enumerate(zip(table.lines, table.records, strict=True)):
        if row in table.broken or len(fields) != len(table.header):
            problem = table.broken.get(row, f"{len(fields)} fields, but the header has {len(table.header)}")
            raise MeasurementError(f"{table.source}, line {line}: {problem}; complete the row.")
    named, *_ = (text_column(table, name) for name in ("image", *CORNERS))
    return [bool(name) for name in named]


def _some(table: Table, chosen: Sequence[bool]) -> Table:
    """Return some of the rows."""
    rows = np.flatnonzero(chosen).tolist()
    records, lines = [table.records[row] for row in rows], tuple(table.lines[row] for row in rows)
    return replace(table, records=records, lines=lines, broken={})


def _without_corners(table: Table, is_corner: Sequence[bool]) -> Table:
    """Return the table as a file of measurements, so that joints and conditions are read and checked as there.

    The rows of corners hold their number in place of a position that is not known yet.
    """
    unit = "m" if "x_m" in table.header else "mm"
    position = tuple(f"{axis}_{unit}" for axis in POSITION)
    left = [number for number, name in enumerate(table.header) if name not in (*OF_IMAGES, *position)]
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
    """Put the corners of one image together, for one camera and one board.

    Returns:
        The images, and the number of the first row of each.
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
    if len(of_image) >= SEVERAL:
        _check_resolution(table, pixels, camera)
    first = torch.tensor([chosen[0] for chosen in of_image.values()])
    images = Images(
        source=table.source,
        names=tuple(of_image),
        q=rows.q[first],
        lines=tuple(table.lines[row] for row in first.tolist()),
        corners=tuple(number[chosen].astype(int) for chosen in of_image.values()),
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
    """Refuse corners that the board does not have or the camera cannot have taken, and deviations that are none.

    Raises:
        MeasurementError: see above; the message names line and column.
    """
    corners, size = len(board.corners), np.array([camera.width, camera.height])
    for row, (line, corner) in enumerate(zip(table.lines, number, strict=True)):
        if corner != round(corner) or not 0 <= corner < corners:
            raise MeasurementError(
                f"{table.source}, line {line}, column 'corner': a whole number from 0 to {corners - 1} was wanted, as "
                f"board '{board.name}' has {corners} corners, got {corner:g}; check the board's rows and columns."
            )
        if not sigma[row] > 0:
            raise MeasurementError(
                f"{table.source}, line {line}, column 'sigma_px': a standard deviation above 0 was wanted, got "
                f"{sigma[row]:g}."
            )
        if (pixels[row] < -1).any() or (pixels[row] > size).any():
            raise MeasurementError(
                f"{table.source}, line {line}: the corner at u = {pixels[row, 0]:g}, v = {pixels[row, 1]:g} px is "
                f"outside of the {camera.width} x {camera.height} px of camera '{camera.name}'; state the camera with "
                "the intrinsics at the resolution of the images."
            )


def _check_resolution(table: Table, pixels: Float64[np.ndarray, "rows 2"], camera: Camera) -> None:
    """Refuse images of which none shows a corner beyond a quarter of what the camera sees.

    Raises:
        MeasurementError: see above.
    """
    if (pixels.max(0) < np.array([camera.width, camera.height]) / 2).all():
        raise MeasurementError(
            f"{table.source}: all corners lie within {pixels[:, 0].max():.0f} x {pixels[:, 1].max():.0f} px, a quarter "
            f"of the {camera.width} x {camera.height} px of camera '{camera.name}'; state the camera with the "
            "intrinsics at the resolution of the images."
        )


def _check_image(
    table: Table,
    name: str,
    rows: list[int],
    q: Float64[torch.Tensor, "rows dof"],
    number: Float64[np.ndarray, " rows"],
) -> None:
    """Refuse an image that cannot be one.

    Raises:
        MeasurementError: it has too few corners, one twice, or two vectors of joint values.
    """
    where = f"{table.source}, line {table.lines[rows[0]]}: image '{name}'"
    if len(rows) < FEWEST_CORNERS:
        raise MeasurementError(
            f"{where} has {len(rows)} corners, but {FEWEST_CORNERS} or more were wanted; remove the image."
        )
    if len(set(number[rows])) < len(rows):
        raise MeasurementError(f"{where} has a corner twice; give every image a name of its own.")
    if float((q[rows] - q[rows[0]]).abs().max()) > SAME_JOINTS:
        raise MeasurementError(
            f"{where} has rows of different joint values; give every image a name of its own, and all of its rows the "
            "joint values at which it was taken."
        )
