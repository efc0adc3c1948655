"""Frames that start at lines of a file."""

import pytest
import torch
from testing.refusals import refused

from pisigma.files.errors import MeasurementError
from pisigma.measurement.dataset import Measurements, with_new_frames


def rows(frame: tuple[str, ...], line: tuple[int, ...] = (2, 3, 5, 6)) -> Measurements:
    q = torch.arange(4, dtype=torch.float64)[:, None]
    return Measurements(q=q, position=q.repeat(1, 3), frame=frame, line=line, source="a.csv")


def test_rows_from_a_line_get_new_frames() -> None:
    data = rows(("", "", "", "A"))
    assert with_new_frames(data, []) is data
    assert with_new_frames(data, [6, 3]).frame == ("", "from line 3", "from line 3", "A from line 6")
    assert with_new_frames(data, [4]).frame == ("", "", "from line 4", "A from line 4")


@pytest.mark.parametrize("line", [2, 7, -1])
def test_lines_without_rows_before_or_after_are_refused(line: int) -> None:
    with refused(MeasurementError, file="a.csv", option="lines", value=line):
        with_new_frames(rows(("",) * 4), [line])


def test_rows_in_memory_have_no_lines() -> None:
    with refused(MeasurementError, option="lines", value=3):
        with_new_frames(rows(("",) * 4, (0,) * 4), [3])
