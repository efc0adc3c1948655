"""Frames that begin in the middle of a file, where the instrument was moved."""

from collections.abc import Sequence
from dataclasses import replace

from pisigma.files.errors import MeasurementError
from pisigma.measurement.dataset import Measurements


def with_new_frames(measurements: Measurements, lines: Sequence[int]) -> Measurements:
    """Give the rows from some lines of their file on frames of their own.

    The rows of a frame "A" from line 50 on are in the frame "A from line 50"; of the nameless one, in "from line 50".

    Args:
        measurements: read from a file.
        lines: at which new frames begin, each up to the next one.

    Raises:
        MeasurementError: a line lies before the second or behind the last row, or rows that belong together (of a pair,
            a socket or an anchor) would be in two frames.
    """
    if not lines:
        return measurements
    if measurements.origin:
        raise MeasurementError(
            f"{measurements.source}: lines at which new frames begin are those of one file, but there are several; "
            "name the frames in a column 'frame'."
        )
    rows = sorted(measurements.line)
    for line in lines:
        if not rows[0] < line <= rows[-1]:
            raise MeasurementError(
                f"{measurements.source}: a new frame at line {line} was asked for, but the rows stand in the lines "
                f"{rows[0]} to {rows[-1]}; give a line behind the first one, as an editor counts them."
            )
    starts = [max((start for start in lines if start <= line), default=0) for line in measurements.line]
    names = [
        f"{name} from line {start}".lstrip() if start else name
        for name, start in zip(measurements.frame, starts, strict=True)
    ]
    return replace(measurements, frame=tuple(names))
