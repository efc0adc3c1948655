"""Joint logs and lists of measurements: partners by name, order and time, and rows without."""

import pytest
from testing.closeness import assert_close

from pisigma.errors import MeasurementError
from pisigma.measurement.foreign.conversion import ConvertedRows
from pisigma.measurement.foreign.joining import join_rows, seconds_of


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
    assert [sentence.partition(":")[0] for sentence in joined.unmatched] == ["points", "log"]
    assert "line 4 (p9)" in joined.unmatched[0]
    assert joined.warnings == ("log: roll_deg are left out, as the measurements are those of points.",)
    assert joined.rows.cells["payload_kg"] == ("2", "1")
    assert "roll_deg" not in joined.rows.cells


def test_a_point_may_be_measured_several_times_but_stands_at_one_pose():
    measured = rows("points", point=("p1", "p1"), x_mm=("1", "2"))
    assert join_rows(measured, rows("log", point=("p1",), q1_deg=("10",)), "point").rows.cells["q1_deg"] == (
        "10",
        "10",
    )
    with pytest.raises(
        MeasurementError, match="log, line 3: the point 'p1' stands in line 2 at other joint values"
    ):
        join_rows(measured, rows("log", point=("p1", "p1"), q1_deg=("10", "11")), "point")


def test_order_wants_equally_many_rows():
    measured, joints = rows("points", x_mm=("1", "2")), rows("log", q1_deg=("10", "20"))
    assert join_rows(measured, joints, "order").rows.cells["q1_deg"] == ("10", "20")
    with pytest.raises(MeasurementError, match="2 rows and log 1"):
        join_rows(measured, rows("log", q1_deg=("10",)), "order")


def test_the_nearest_time_stamp_counts():
    measured = rows("points", time=("10:00:01.1", "10:00:02.0", "10:00:09"), x_mm=("1", "2", "3"))
    log = rows("log", time=("10:00:02.1", "10:00:01.0", "10:00:05"), q1_deg=("20", "10", "50"))
    joined = join_rows(measured, log, "time", 0.2)
    assert joined.rows.cells["q1_deg"] == ("10", "20")
    assert [("line 4" in sentence) for sentence in joined.unmatched] == [True, True]
    with pytest.raises(MeasurementError, match="the clocks and their zones"):
        join_rows(rows("points", time=("11:00:02.1",), x_mm=("1",)), log, "time", 0.2)


def test_joints_that_move_while_it_is_measured():
    measured = rows("points", time=("1.0",), x_mm=("1",))
    log = rows("log", time=("0.9", "1.1"), q1_deg=("10", "11"))
    assert "move by up to 1 (deg or mm) within 0.2 s" in join_rows(measured, log, "time", 0.2).warnings[0]


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("12.5", 12.5),
        ("10:31:02.5", 37862.5),
        ("10:31", 37860.0),
        ("2026-03-02T10:31:02.5Z", 1772447462.5),
        ("2026/03/02 10:31:02.5", 1772447462.5),
        ("02.03.2026 10:31:02.5", 1772447462.5),
    ],
)
def test_time_stamps(text: str, seconds: float):
    assert_close(seconds_of(text), seconds, atol=0.0)


def test_what_is_no_time_stamp():
    assert seconds_of("noon") is None
    assert seconds_of("nan") is None


@pytest.mark.parametrize(("by", "said"), [("point", "names of the points"), ("time", "time stamps")])
def test_what_rows_are_joined_by_has_to_be_there(by: str, said: str):
    with pytest.raises(MeasurementError, match=said):
        join_rows(rows("points", x_mm=("1",)), rows("log", q1_deg=("1",)), by)


def test_no_common_name():
    with pytest.raises(MeasurementError, match="'p1' and 'k1' for example"):
        join_rows(
            rows("points", point=("p1",), x_mm=("1",)), rows("log", point=("k1",), q1_deg=("1",)), "point"
        )
