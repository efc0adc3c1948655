"""Joint values of images from a log, joined by the names of the images or by time."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pisigma.files.errors import MeasurementError
from pisigma.measurement.csv.columns import find_column
from pisigma.measurement.csv.reading import number_column, text_column
from pisigma.measurement.csv.table import read_table
from pisigma.measurement.foreign.accounting import sentences
from pisigma.measurement.foreign.conversion import ConvertedRows
from pisigma.measurement.foreign.joining import JoinBy, join_rows

_NANOSECONDS = 1e15
"""Numbers above are no seconds of a clock, but nanoseconds, as ROS names its images."""


@dataclass(frozen=True)
class JoinedJoints:
    """Cells of a log of joint values by image.

    Attributes:
        columns: of the log that are kept, such as "q1_deg" and "payload_kg".
        cells: texts of these columns by the name of the image; images without a partner are missing.
        remarks: sentences on rows without a partner, and what else should be known.
    """

    columns: tuple[str, ...]
    cells: Mapping[str, tuple[str, ...]]
    remarks: tuple[str, ...]


def join_joints(names: Sequence[str], path: str | os.PathLike[str], within: float) -> JoinedJoints:
    """Give every image the joint values at which it was taken.

    Args:
        names: of the images, without the endings of their files; where the log has times, time stamps.
        path: CSV file with joint values (`q1_deg` and so on), and a column `image` (with ending or without) or `time`;
            its further columns are kept where measurement files have such.
        within: largest difference of time stamps [s].

    Raises:
        MeasurementError: the file cannot be used, or no image has a partner.
    """
    table = read_table(path)
    joints = [name for name in table.header if (column := find_column(name)) and column.joint]
    by: JoinBy = "point" if "image" in table.header else "time"
    if not joints or (by == "time" and "time" not in table.header):
        raise MeasurementError(
            f"{table.source}, line {table.header_line}: joint values (q1_deg and so on) and a column 'image' or 'time' "
            f"were wanted, got {', '.join(table.header)}."
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
    unread = [f"{table.source}: {', '.join(others)} are left out, as measurement files have no such columns."]
    values = zip(*(rows[name] for name in columns), strict=True)
    of_image = dict(zip(rows["point"], values, strict=True))
    remarks = (*sentences(joined.unmatched), *joined.warnings, *(unread if others else ()))
    return JoinedJoints(columns, of_image, remarks)


def _stamp(name: str) -> str:
    """A time stamp in the name of an image, in seconds where it is a number of nanoseconds."""
    try:
        return repr(int(name) * 1e-9) if int(name) > _NANOSECONDS else name
    except ValueError:
        return name
