"""Join a log of joint values and images by name, by the number of the stop in a video, or by time."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pisigma.files.errors import MeasurementError, Phrase, Place
from pisigma.measurement.csv.columns import find_column
from pisigma.measurement.csv.reading import number_column, text_column
from pisigma.measurement.csv.table import read_table
from pisigma.measurement.foreign.accounting import sentences
from pisigma.measurement.foreign.conversion import ConvertedRows
from pisigma.measurement.foreign.joining import JoinBy, join_rows

_NANOSECONDS = 1e15
"""Number above which a time is in nanoseconds, as in ROS's names of images, not in seconds."""


@dataclass(frozen=True)
class JoinedJoints:
    """Cells of a log of joint values by image.

    Attributes:
        columns: columns of the log that are kept, such as "q1_deg" and "payload_kg".
        cells: texts of these columns by image name; images without a partner are omitted.
        remarks: sentences about rows without a partner, and warnings.
    """

    columns: tuple[str, ...]
    cells: Mapping[str, tuple[str, ...]]
    remarks: tuple[str, ...]


def names_images(path: str | os.PathLike[str]) -> bool:
    """Return whether a log of joint values names the images; otherwise it contains times.

    Raises:
        MeasurementError: the file cannot be read.
    """
    return "image" in read_table(path).header


def join_joint_values(
    names: Sequence[str], path: str | os.PathLike[str], within: float, stops: int = 0
) -> JoinedJoints:
    """Return the joint values at which every image was taken.

    Args:
        names: names of the images without file extensions; they must be time stamps if the log has times.
        path: CSV file with joint values (`q1_deg` and so on) and a column `image` (with or without extension) or
            `time`; further columns are kept if they are columns of measurement files.
        within: largest difference of time stamps [s].
        stops: number of images that are numbered stops in a video, which must equal the number of rows of the file; 0
            if there is no video.

    Raises:
        MeasurementError: the file cannot be used, no image has a partner, or the number of stops differs from the
            number of rows.
    """
    table = read_table(path)
    joints = [name for name in table.header if (column := find_column(name)) and column.joint]
    by: JoinBy = "point" if "image" in table.header else "time"
    if not joints or (by == "time" and "time" not in table.header):
        raise MeasurementError(
            expected="joint values (q1_deg and so on) and a column image or time",
            value=Phrase(", ".join(table.header)),
            at=table.header_place,
        )
    if by == "point" and stops not in (0, len(table.lines)):
        raise MeasurementError(
            "the stops in the video cannot be paired with the joint values",
            expected=f"{len(table.lines)} stops in the video, one per row",
            value=stops,
            at=Place(path),
            remedy="let the arm rest for a second at every pose and nowhere else, or log joint values with times",
        )
    for name in joints:
        number_column(table, name)
    cells = {name: tuple(text_column(table, name)) for name in table.header}
    if by == "point":
        cells["point"] = tuple(os.path.splitext(os.path.basename(name))[0] for name in cells.pop("image"))
        cells.pop("time", None)
    images = {"point": tuple(names)} | ({"time": tuple(map(_stamp, names))} if by == "time" else {})
    measured = ConvertedRows("the images", tuple(range(1, len(names) + 1)), images)
    joined = join_rows(measured, ConvertedRows(table.source, table.lines, cells), by, within)
    rows = joined.rows.cells
    columns = tuple(name for name in rows if find_column(name))
    others = [name for name in rows if name not in (*columns, *images)]
    unread = [
        f"{table.source}: {', '.join(others)} are left out, because they are not columns of measurement files."
    ]
    values = zip(*(rows[name] for name in columns), strict=True)
    of_image = dict(zip(rows["point"], values, strict=True))
    remarks = (*sentences(joined.unmatched), *joined.warnings, *(unread if others else ()))
    return JoinedJoints(columns, of_image, remarks)


def _stamp(name: str) -> str:
    """Return the time stamp in the name of an image as text, with nanoseconds converted to seconds."""
    try:
        return repr(int(name) * 1e-9) if int(name) > _NANOSECONDS else name
    except ValueError:
        return name
