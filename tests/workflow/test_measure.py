"""Measuring sessions, from rows to the next action."""

import json
from dataclasses import replace
from math import isnan

import pytest
import torch
from testing.measured_plans import CHECKS, measured_plan, with_offset
from testing.models import no_type_checker
from testing.refusals import refused

from pisigma.files.errors import PlanningError
from pisigma.measurement.fields import UnusableRow
from pisigma.planning.plan_file import read_plan
from pisigma.planning.session import session_accuracy
from pisigma.workflow.measure import MeasuringSession
from pisigma.workflow.settings.measuring import MeasureSettings

PLAN = measured_plan("kiro3")


@pytest.fixture(scope="module")
def session():
    """A session after 18 rows, of which the 15th is wrong."""
    session = MeasuringSession(PLAN.stored, MeasureSettings(limit_mm=1e-3, least_gain_mm=0.0))
    rows = with_offset(PLAN.rows(18), 14, (0.003, -0.004, 0.0))
    session.add(rows.select(torch.arange(14)))
    (alarm,) = session.add(rows.select(torch.tensor([14])), [UnusableRow(20, "column 'q1_deg': empty")])[:1]
    assert alarm.line == 16
    assert session.state.advice.action == "repeat"
    session.add(rows.select(torch.arange(15, 18)))
    with no_type_checker():
        session.update()
    return session


def test_before_anything_is_measured():
    state = MeasuringSession(PLAN.stored).state
    assert state.next_pose is not None
    assert (state.next_pose.number, state.next_pose.largest_pose_number) == (1, 24)
    assert (len(state.remaining), state.accuracy, state.base) == (24, None, None)
    assert state.advice.action == "measure"
    json.dumps(state.to_json(), allow_nan=False)


def test_the_state_tells_used_rows_and_alarms(session):
    state = session.state
    assert len(state.rows.line) == 18
    assert state.rows.is_unused.tolist() == [row == 14 for row in range(18)]
    assert [alarm.line for alarm in state.alarms] == [16, 20]
    assert int(state.rows.is_test_row.sum()) == CHECKS - 1
    assert state.base.shape == (4, 4)
    assert abs(state.rows.error[~state.rows.is_unused]).max() < 3e-3
    assert state.rows.error[14].tolist() != [0, 0, 0]
    for span in state.coverage:
        assert span.lower < span.upper
        assert 0 < span.planned <= 1


def test_remaining_poses_are_replanned_with_the_same_number(session, tmp_path):
    assert session.replanned
    assert len(session.state.remaining) == 24 - 17
    session.write_remaining(tmp_path / "rest.csv")
    rest = read_plan(tmp_path / "rest.csv")
    assert len(rest.q) == 7
    assert int(rest.is_test_pose.sum()) == 1
    numbers = dict(zip(rest.numbers, rest.q, strict=True))
    assert len(numbers) == 7
    for (
        number,
        q,
    ) in numbers.items():  # a pose that was planned before keeps its number, a new one has a further one
        old = (PLAN.stored.q - q).abs().amax(1)
        assert (float(old.min()) < 1e-6) == (number <= 24)
        assert number > 24 or int(old.argmin()) == number - 1
    assert session.state.next_pose.number == rest.numbers[0]


def test_the_current_and_the_expected_accuracy(session):
    state = session.state
    point = state.accuracy
    assert point.poses == 15
    # the session started with all its rows, and also has the point before the last three
    assert [one.poses for one in state.reached_accuracy] == [12, 15]
    for lower, higher in (
        (point.predicted_rms, point.predicted_p95),
        (point.cross_validated_rms, point.cross_validated_p95),
        (point.checked_rms, point.checked_p95),
    ):
        assert 1e-6 < lower <= higher < 5e-3
    assert state.expected_accuracy[-1].poses == 15 + 6
    assert state.expected_accuracy[-1].predicted_rms < point.predicted_rms
    figures = json.loads(json.dumps(state.to_json(), allow_nan=False))
    assert figures["accuracy"]["predicted_rms_mm"] == point.predicted_rms * 1e3
    assert figures["rows_counting"] == 17


@pytest.mark.parametrize(("option", "value"), [("limit_mm", 0.0), ("least_gain_mm", -1.0), ("every", 0)])
def test_settings_out_of_range_are_refused(option, value):
    with refused(PlanningError, option=option, value=value):
        MeasureSettings(**{option: value})


def test_a_wrong_unit_is_reported_once_with_advice():
    session, rows = MeasuringSession(PLAN.stored), PLAN.rows(5)
    rows = replace(rows, position=rows.position * 1000)
    session.add(rows.select(torch.arange(4)))
    assert [(alarm.line, alarm.kind) for alarm in session.check_setup()] == [(1, "setup")]
    session.add(rows.select(torch.tensor([4])))
    assert session.update() == ()
    assert session.state.accuracy is None
    assert session.state.advice.action == "correct"


def test_rows_are_checked_together_as_one_by_one():
    rows = with_offset(PLAN.rows(18), 14, (0.003, -0.004, 0.0))
    together, single = MeasuringSession(PLAN.stored), MeasuringSession(PLAN.stored)
    alarms = together.add(rows)
    for row in range(rows.rows):
        single.add(rows.select(torch.tensor([row])))
    assert [alarm.line for alarm in alarms] == [rows.line[14]]
    assert together.state.rows.is_unused.tolist() == single.state.rows.is_unused.tolist()
    torch.testing.assert_close(*(torch.as_tensor(one.state.rows.error) for one in (together, single)))


def test_the_expected_accuracy_comes_first_and_the_cross_validation_while_idle():
    session = MeasuringSession(PLAN.stored, MeasureSettings(least_gain_mm=0.0))
    rows = PLAN.rows(18)
    session.add(rows.select(torch.arange(14)))
    with no_type_checker():
        session.next_step()()
    first = session.state
    assert first.accuracy.predicted_rms > 0
    assert isnan(first.accuracy.cross_validated_rms)
    assert first.expected_accuracy == ()
    with no_type_checker():
        session.next_step()()
        assert session.next_step() is None
        outdated = session.idle_step()
    assert session.state.expected_accuracy
    validate = session_accuracy.validate

    def while_a_row_comes(calibrator, rows_, folds, progress):
        session.add(rows.select(torch.tensor([14])))
        return validate(calibrator, rows_, folds, progress)

    with pytest.MonkeyPatch.context() as patch, no_type_checker():
        patch.setattr(session_accuracy, "validate", while_a_row_comes)
        outdated()
    assert isnan(session.state.accuracy.cross_validated_rms)
    with no_type_checker():
        session.check_setup()
        assert session.next_step() is None
        session.idle_step()()
    assert session.state.accuracy.cross_validated_rms > 0
    assert session.idle_step() is None
