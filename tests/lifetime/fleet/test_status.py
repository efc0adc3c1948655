"""Status of a fleet."""

import datetime

from pisigma.lifetime.fleet.record import RobotRecord, SessionRecord
from pisigma.lifetime.fleet.status import FleetStatus
from pisigma.reporting.lifetime_tables import not_compared, robot_table, state_table

TODAY = datetime.date(2026, 11, 22)


def session(date, verdict, rms=None, **more):
    return SessionRecord(
        session=date, date=date, file="x.csv", rows=10, verdict=verdict, sentence=f"It is {verdict}.", rms_mm=rms,
        **more,
    )  # fmt: skip


STATUS = FleetStatus.from_records(
    [
        RobotRecord(
            "moved", "", (session("2026-01-01", "calibrated", 0.1), session("2026-11-01", "moved", 0.9))
        ),
        RobotRecord("fine", "", (session("2026-11-01", "calibrated", 0.05),)),
        RobotRecord("old", "", (session("2025-11-01", "calibrated", 0.2),)),
        RobotRecord("bad", "", (session("2026-01-01", "refused"),)),
        RobotRecord("pays", "", (session("2026-11-01", "unchanged", 0.3, recalibrate=True),)),
    ],
    TODAY,
    180,
    ["fine", "killed"],
)


def test_every_robot_has_its_state():
    states = {one.robot: one.state for one in STATUS.robots}
    assert states == {
        "bad": "refused",
        "fine": "fine",
        "killed": "missing",
        "moved": "drifting",
        "old": "overdue",
        "pays": "drifting",
    }
    assert STATUS.action


def test_robots_are_sorted_by_error():
    assert [one.robot for one in STATUS.robots_by_error] == ["moved", "pays", "old", "fine"]


def test_json_lists_the_robots_by_state():
    figures = STATUS.to_json()
    assert figures["drifting"] == ["moved", "pays"]
    assert figures["overdue"] == [{"robot": "old", "days": 386}]
    assert figures["refused"] == [{"robot": "bad", "reason": "It is refused."}]


def test_tables_have_all_robots():
    counts = {"refused": "1", "missing": "1", "drifting": "2", "overdue": "1", "fine": "1"}
    assert dict(state_table(STATUS).rows) == counts
    rows = {row[0]: row[1:] for row in robot_table(STATUS.robots).rows}
    assert rows["moved"] == ("2026-11-01", "10", "moved", "0.900", "21", "drifting")
    assert rows["bad"] == ("2026-01-01", "", "", "", "", "refused")


def test_a_moved_joint_counts_as_drift_after_a_recalibration():
    sessions = session("2026-01-01", "calibrated"), session("2026-11-01", "recalibrated", 0.1, moved=True)
    status = FleetStatus.from_records([RobotRecord("r", "", sessions)], TODAY, 180)
    assert status.robots[0].state == "drifting"
    assert status.robots[0].compared


def test_separately_calibrated_sessions_do_not_show_drift():
    sessions = session("2026-01-01", "calibrated"), session("2026-11-01", "calibrated")
    status = FleetStatus.from_records([RobotRecord(name, "", sessions) for name in "ab"], TODAY, 180)
    assert status.to_json()["not_compared"] == ["a", "b"]
    assert not_compared(status).startswith("2 robots")
    assert not_compared(STATUS) == ""


def test_the_error_of_a_cross_validation_counts():
    figures = RobotRecord("r", "", (session("2026-11-01", "calibrated", 0.04, held_out_rms_mm=0.11),))
    assert robot_table(FleetStatus.from_records([figures], TODAY, 180).robots).rows[0][4] == "0.110"


def test_an_impossible_date_is_reported_and_ignored():
    record = RobotRecord("slip", "", (session("2206-01-01", "calibrated", 0.1),))
    seen = FleetStatus.from_records([record], TODAY, 180)
    assert seen.robots[0].days is None
    assert "2206-01-01" in seen.to_json()["warnings"][0]
    assert seen.to_json()["overdue"] == []
    assert not STATUS.warnings
