"""Joining of joint logs and lists of measurements by name, order and time, and rows without a partner."""

from dataclasses import replace

import pytest
from testing.refusals import refused

from pisigma.files.errors import MeasurementError
from pisigma.measurement.foreign.accounting import left_out_sentences
from pisigma.measurement.foreign.conversion import ConvertedRows
from pisigma.measurement.foreign.joining import join_rows


def rows(source: str, **cells: tuple[str, ...]) -> ConvertedRows:
    return ConvertedRows(source, tuple(range(2, 2 + len(next(iter(cells.values()))))), cells)


def test_names_differ_in_groups_case_and_zeros():
    measured = rows("points", point=("A::B::P01", "a::p2", "p9"), x_mm=("1", "2", "3"))
    joints = rows(
        "log",
        point=("p2", "P1", "p3"),
        q1_deg=("20", "10", "30"),
        roll_deg=("7", "8", "9"),
        payload_kg=("1", "2", "3"),
    )
    joined = join_rows(measured, joints, "point")
    assert joined.rows.cells["q1_deg"] == ("10", "20")
    assert joined.rows.cells["x_mm"] == ("1", "2")
    assert joined.rows.lines == (2, 3)
    assert [(row.file, row.line, row.point) for row in joined.unmatched_rows] == [
        ("points", 4, "p9"),
        ("log", 4, "p3"),
    ]
    assert "line 4 (p9)" in left_out_sentences(joined.unmatched_rows)[0]
    (warning,) = joined.warnings
    assert warning.startswith("log: roll_deg ")
    assert joined.rows.cells["payload_kg"] == ("2", "1")
    assert "roll_deg" not in joined.rows.cells


def test_a_point_may_be_measured_several_times_but_has_one_pose():
    measured = rows("points", point=("p1", "p1"), x_mm=("1", "2"))
    assert join_rows(measured, rows("log", point=("p1",), q1_deg=("10",)), "point").rows.cells["q1_deg"] == (
        "10",
        "10",
    )
    with refused(MeasurementError, file="log", line=3, value="p1") as caught:
        join_rows(measured, rows("log", point=("p1", "p1"), q1_deg=("10", "11")), "point")
    assert "line 2" in str(caught.value)


def test_joining_by_order_requires_as_many_rows():
    measured, joints = rows("points", x_mm=("1", "2")), rows("log", q1_deg=("10", "20"))
    assert join_rows(measured, joints, "order").rows.cells["q1_deg"] == ("10", "20")
    with refused(MeasurementError, file="log", value=1):
        join_rows(measured, rows("log", q1_deg=("10",)), "order")


def test_the_nearest_time_stamp_is_joined():
    measured = rows("points", time=("10:00:01.1", "10:00:02.0", "10:00:09"), x_mm=("1", "2", "3"))
    log = rows("log", time=("10:00:02.1", "10:00:01.0", "10:00:05"), q1_deg=("20", "10", "50"))
    joined = join_rows(measured, log, "time", 0.2)
    assert joined.rows.cells["q1_deg"] == ("10", "20")
    assert [(row.file, row.line) for row in joined.unmatched_rows] == [("points", 4), ("log", 4)]
    with refused(MeasurementError, file="points and log", expected="time stamps within 0.2 s of each other"):
        join_rows(rows("points", time=("11:00:02.1",), x_mm=("1",)), log, "time", 0.2)


def test_recordings_whose_times_restart_are_refused_if_they_overlap():
    measured = rows("points", time=("1.0", "2.0"), x_mm=("1", "2"))
    log = rows("log", time=("1.0", "2.0", "3.0", "1.1", "2.1"), q1_deg=("1", "2", "3", "4", "5"))
    for first, second in (
        (measured, log),
        (replace(log, cells={"x_mm": log.cells["q1_deg"]} | log.cells), log),
    ):
        with refused(MeasurementError, file="log", line=5):
            join_rows(first, second, "time", max_time_difference=0.2)
    later = rows("log", time=("5.0", "6.0", "1.0", "2.0"), q1_deg=("5", "6", "1", "2"))
    assert join_rows(measured, later, "time").rows.cells["q1_deg"] == ("1", "2")


def test_joints_that_move_during_a_measurement():
    measured = rows("points", time=("1.0",), x_mm=("1",))
    log = rows("log", time=("0.9", "1.1"), q1_deg=("10", "11"))
    (warning,) = join_rows(measured, log, "time", 0.2).warnings
    assert all(number in warning for number in (" 1 (deg or mm)", " 0.2 s"))


def test_names_of_points_that_contradict_the_order_or_the_time_are_refused():
    measured = rows("points", point=("p1", "p2"), time=("1", "2"), x_mm=("1", "2"))
    log = rows("log", point=("p2", "P1"), time=("1", "2"), q1_deg=("20", "10"))
    for by in ("order", "time"):
        with refused(MeasurementError, file="points", line=2, value="p1") as caught:
            join_rows(measured, log, by)
        assert "'p2'" in str(caught.value)
        assert "line 3" in str(caught.value)
    same = rows("log", point=("P01", "p2"), time=("1", "2"), q1_deg=("10", "20"))
    others = rows("log", point=("1", "2"), time=("1", "2"), q1_deg=("10", "20"))
    for one in (same, others):
        assert join_rows(measured, one, "order").rows.cells["q1_deg"] == ("10", "20")


@pytest.mark.parametrize(
    ("ours", "theirs"),
    [
        (("13/03/2026 10:00:01", "02/03/2026 10:00:02"), ("2026-03-13 10:00:01", "2026-03-02 10:00:02")),
        (
            ("03/13/2026 10:00:01 PM", "03/02/2026 12:00:02 AM"),
            ("2026-03-13 22:00:01", "2026-03-02 00:00:02"),
        ),
        (("02/03/2026 10:00:01", "02/03/2026 10:00:02"), ("02/03/2026 10:00:01", "02/03/2026 10:00:02")),
        (("10:00:01 AM", "1:00:02 p.m."), ("10:00:01", "13:00:02")),
    ],
)
def test_time_stamps_of_other_countries(ours: tuple[str, str], theirs: tuple[str, str]):
    log = rows("log", time=theirs[::-1], q1_deg=("20", "10"))
    assert join_rows(rows("points", time=ours, x_mm=("1", "2")), log, "time").rows.cells["q1_deg"] == (
        "10",
        "20",
    )


def test_a_day_that_may_be_a_month_is_refused_with_its_line():
    log = rows("log", time=("2026-03-02 10:00:01", "2026-03-04 10:00:02"), q1_deg=("10", "20"))
    measured = rows("points", time=("02/03/2026 10:00:01", "04/03/2026 10:00:02"), x_mm=("1", "2"))
    with refused(MeasurementError, file="points", line=2, value="02/03/2026 10:00:01"):
        join_rows(measured, log, "time")


def test_a_column_of_dates_belongs_to_the_clock():
    measured = rows("points", time=("10:00:01",) * 2, date=("2026-03-02", "2026-03-03"), x_mm=("1", "2"))
    log = rows("log", time=("2026-03-03 10:00:01", "2026-03-02 10:00:01"), q1_deg=("20", "10"))
    assert join_rows(measured, log, "time").rows.cells["q1_deg"] == ("10", "20")


@pytest.mark.parametrize("by", ["point", "time"])
def test_the_column_to_join_by_is_required(by: str):
    with refused(MeasurementError, file="points", value="none") as caught:
        join_rows(rows("points", x_mm=("1",)), rows("log", q1_deg=("1",)), by)
    assert f"HEADING={by}" in caught.value.remedy


def test_no_common_name():
    with refused(MeasurementError, file="points and log", value="p1 and k1"):
        join_rows(
            rows("points", point=("p1",), x_mm=("1",)), rows("log", point=("k1",), q1_deg=("1",)), "point"
        )


def test_without_common_names_numbers_are_compared():
    def joined(*names: str):
        log = rows("log", point=names, q1_deg=("10", "20", "30"))
        return join_rows(rows("points", point=("P1", "P2", "P3"), x_mm=("1", "2", "3")), log, "order")

    assert not joined("Pose 01", "Pose 02", "Pose 03").warnings
    with refused(MeasurementError, file="points", line=2, value="P1") as caught:
        joined("2", "3", "1")
    assert "line 4" in str(caught.value)
    for names in (("0", "1", "2"), ("a", "b", "c"), ("A1", "B1", "C1")):
        (warning,) = joined(*names).warnings
        assert warning.startswith("points, line 2: ")
        assert f"'{names[0]}' (log, line 2)" in warning
