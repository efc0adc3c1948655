"""Files that grow while they are read."""

import os

import pytest
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import MeasurementError
from pisigma.measurement.growing_file import GrowingFile
from pisigma.robot.description import Robot

HEADER = "q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg,x_mm,y_mm,z_mm\n"
ROBOT = Robot.load("rb5")


def line(number, joint=1.0, x=None):
    return f"{number},{joint},2,3,4,5,{100 + number if x is None else x},200,300\n"


@pytest.fixture
def file(tmp_path):
    return tmp_path / "rows.csv"


def read(growing, is_complete=False):
    growth = growing.read(is_complete)
    rows = growth.rows
    return [] if rows is None else [round(value) for value in rows.q[:, 0].rad2deg().tolist()]


def test_rows_are_read_once_and_in_order(file):
    growing = GrowingFile(file, ROBOT)
    missing = growing.read().missing_part
    file.write_text(HEADER[:10])
    incomplete = growing.read().missing_part
    assert all(str(file) in waiting for waiting in (missing, incomplete))
    assert missing != incomplete
    file.write_text(HEADER)
    growth = growing.read()
    assert (growth.rows, growth.missing_part) == (None, "")
    for number in range(1, 4):
        with file.open("a") as out:
            out.write(line(number))
        assert read(growing) == [number]
        assert read(growing) == []


def test_incomplete_lines_are_not_read_yet(file):
    growing = GrowingFile(file, ROBOT)
    file.write_text(HEADER + line(1) + line(2)[:-4])
    assert read(growing) == [1]
    assert growing.read().missing_part
    with file.open("a") as out:
        out.write(line(2)[-4:])
    growth = growing.read()
    assert growth.missing_part == ""
    assert_close(growth.rows.position, [[0.102, 0.2, 0.3]], rtol=1e-12)
    assert growth.rows.line == (3,)


def test_the_last_line_of_a_complete_file_needs_no_line_break(file):
    file.write_text((HEADER + line(1) + line(2)).rstrip())
    assert read(GrowingFile(file, ROBOT), is_complete=True) == [1, 2]


@pytest.mark.parametrize("newline", ["\r\n", "\r"])
def test_other_ends_of_lines(file, newline):
    growing = GrowingFile(file, ROBOT)
    text = (HEADER + line(1) + line(2)).replace("\n", newline)
    rows = []
    for end in range(0, len(text) + 1, 7):
        file.write_bytes(text[:end].encode())
        rows += read(growing)
    file.write_bytes(text.encode())
    assert rows + read(growing) == [1, 2]


def test_a_truncated_file_loses_and_repeats_no_row(file):
    growing = GrowingFile(file, ROBOT)
    file.write_text(HEADER + line(1) + line(2))
    assert read(growing) == [1, 2]
    file.write_text(HEADER + line(1))
    (notice,) = growing.read().notices
    assert str(file) in notice
    assert " 2 rows " in notice
    file.write_text(HEADER + line(1) + line(2) + line(3))
    growth = growing.read()
    assert growth.notices == ()
    assert growth.rows.line == (4,)


def test_a_replaced_file_gives_only_its_new_rows(file, tmp_path):
    """For example as saved by a spreadsheet, with another order of columns and format of numbers."""
    growing = GrowingFile(file, ROBOT)
    file.write_text(HEADER + line(1) + line(2))
    assert read(growing) == [1, 2]
    other = tmp_path / "other.csv"
    other.write_text(
        "x_m,y_m,z_m,q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg\n0.103,0.2,0.3,3,1,2,3,4,5\n0.101,.2,.3,1.00,1,2,3,4,5\n"
    )
    os.replace(other, file)
    growth = growing.read()
    assert str(file) in growth.notices[0]
    assert growth.rows.line == (2,)


def test_an_invalid_row_is_reported_once_and_does_not_affect_the_others(file):
    growing = GrowingFile(file, ROBOT)
    file.write_text(HEADER + "1,1,2,3,4,5,,,\n")
    (bad,) = growing.read().left_out
    assert bad.line == 2
    assert (bad.fault.column, bad.fault.value) == (None, None)
    with file.open("a") as out:
        out.write("2,1,2,3,4,5,abc,200,300\n" + line(3) + line(3) + "4,1,2\n")
    growth = growing.read()
    assert [one.line for one in growth.left_out] == [3, 6]
    assert growth.rows.line == (4, 5)


def test_a_pair_is_read_when_both_rows_are_complete(file):
    growing = GrowingFile(file, ROBOT)
    header = HEADER.replace("x_mm,y_mm,z_mm", "distance_mm,pair")
    file.write_text(header + "1,1,2,3,4,5,50,a\n")
    assert growing.read().rows is None
    with file.open("a") as out:
        out.write("2,1,2,3,4,5,50,a\n")
    assert growing.read().rows.line == (2, 3)


def test_a_header_that_cannot_be_used_is_refused(file):
    file.write_text("q1_deg,force\n")
    with refused(MeasurementError, line=1, column="force"):
        GrowingFile(file, ROBOT).read()
    with refused(MeasurementError, file="none.csv"):
        GrowingFile(file.with_name("none.csv"), ROBOT).read(is_complete=True)
