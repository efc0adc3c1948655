"""Following a growing file."""

import time
from contextlib import nullcontext
from types import SimpleNamespace

import pytest
from testing.measured_plans import header, measured_plan, row_lines
from testing.models import no_type_checker
from testing.refusals import refused

from pisigma.files.errors import MeasurementError, OutputError
from pisigma.measurement.growing_file import GrowingFile
from pisigma.workflow.follow import follow, remaining_poses_file
from pisigma.workflow.measure import MeasuringSession
from pisigma.workflow.settings.measuring import MeasureSettings

PLAN = measured_plan("kiro3", poses=9)
ROBOT = PLAN.stored.arm.robot


def session(every=1000):
    return MeasuringSession(PLAN.stored, MeasureSettings(least_gain_mm=0.0, every=every, replan=False))


def test_rows_are_checked_as_they_are_measured_until_the_plan_is_done(tmp_path, monkeypatch):
    file = tmp_path / "rows.csv"
    lines = [header(ROBOT), *row_lines(ROBOT, PLAN.rows(9))]

    def measure_one(seconds: float) -> None:
        with file.open("a") as out:
            out.write(lines.pop(0) if lines else "")
        time.sleep(seconds)

    monkeypatch.setattr("pisigma.workflow.follow.time", SimpleNamespace(sleep=measure_one))
    monkeypatch.setattr(MeasuringSession, "in_background", lambda session: nullcontext())
    seen, waited, arrived = [], [], []
    with no_type_checker():
        for step in follow(
            session(), GrowingFile(file, ROBOT), on_new_rows=lambda rows: arrived.extend(rows.line)
        ):
            waited.append(step.growth.missing_part)
            seen += [] if step.growth.rows is None else step.growth.rows.line
            assert arrived == seen
    assert waited[1]
    assert not waited[-1]
    assert seen == list(range(2, 11))
    assert step.state.is_finished


def test_the_accuracy_is_computed_in_the_background(tmp_path):
    file = tmp_path / "rows.csv"
    file.write_text(header(ROBOT) + "".join(row_lines(ROBOT, PLAN.rows(9))))
    with no_type_checker():
        *_, last = follow(session(every=3), GrowingFile(file, ROBOT))
    assert last.state.accuracy.poses == 9


def test_a_stop_does_not_wait_for_the_calculation(tmp_path):
    file = tmp_path / "rows.csv"
    file.write_text(header(ROBOT) + "".join(row_lines(ROBOT, PLAN.rows(9))))
    following, stopped = session(every=3), []

    def stop() -> None:
        if following._worked_out:  # a calibration has begun
            stopped.append(time.monotonic())
            raise InterruptedError

    with no_type_checker(), pytest.raises(InterruptedError):
        list(follow(following, GrowingFile(file, ROBOT), before_read=stop))
    assert time.monotonic() - stopped[0] < 1
    assert following.state.accuracy is None


def test_a_missing_file_ends_the_session(tmp_path):
    with refused(MeasurementError, file="rows.csv"):
        list(follow(session(), GrowingFile(tmp_path / "rows.csv", ROBOT), once=True))


def test_remaining_poses_are_never_written_over_inputs(tmp_path):
    plan, rows = tmp_path / "poses.csv", tmp_path / "rows.csv"
    plan.write_text("")
    assert remaining_poses_file(plan, rows, None) == tmp_path / "poses.rest.csv"
    assert remaining_poses_file(tmp_path / "poses.plan.yaml", rows, None) == tmp_path / "poses.rest.csv"
    for taken in (plan, tmp_path / "poses.plan.yaml"):
        with pytest.raises(OutputError):
            remaining_poses_file(plan, rows, taken)
