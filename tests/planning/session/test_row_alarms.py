"""Alarms on rows that cannot be right."""

import torch
from testing.measured_plans import NOISE, measured_plan, with_offset

from pisigma.measurement.dataset import Measurements, join
from pisigma.measurement.fields import UnusableRow
from pisigma.planning.session.row_alarms import (
    contradiction_alarm,
    stale_reading_alarms,
    unplanned_joint_alarms,
    unreadable_alarm,
)
from pisigma.planning.session.row_judgement import judge_rows

PLAN = measured_plan()
ROBOT = PLAN.stored.arm.robot
NAMES = [f"pose {number} of the plan" for number in range(1, 25)]


def test_an_unreadable_row_has_to_be_measured_again():
    alarm = unreadable_alarm(
        UnusableRow(7, "column 'x_mm': 'abc' is not a finite number; write one such as -12.5")
    )
    assert alarm.line == 7
    assert "'abc'" in alarm.sentence
    assert (alarm.kind, alarm.repeat, alarm.row_is_used) == ("unreadable", True, False)


def test_a_frozen_sensor_and_a_row_written_twice():
    rows = PLAN.rows(4)
    frozen = Measurements(q=PLAN.stored.q[4:5], position=rows.position[2:3], line=(6,))
    (alarm,) = stale_reading_alarms(join([rows, frozen]), 4)
    assert alarm.kind == "frozen"
    assert alarm.line == 6
    assert "line 4" in alarm.sentence
    assert alarm.repeat
    again = Measurements(q=rows.q[2:3], position=rows.position[2:3], line=(6,))
    (alarm,) = stale_reading_alarms(join([rows, again]), 4)
    assert (alarm.kind, alarm.repeat, alarm.row_is_used) == ("duplicate", False, False)
    balls = Measurements(q=rows.q[[0, 1, 0]], socket=("a", "a", "a"), line=(2, 3, 4))
    (alarm,) = stale_reading_alarms(balls, 1)
    assert (alarm.kind, alarm.line) == ("duplicate", 4)


def test_joint_values_off_the_plan_are_a_remark():
    q = PLAN.stored.q[:3].clone()
    q[1, 2] += torch.deg2rad(torch.tensor(1.2))
    q[2, 0] += 1.0
    near, far = unplanned_joint_alarms(ROBOT, PLAN.measure(q), 0, PLAN.stored.q, NAMES)
    assert "1.20 deg" in near.sentence
    assert "pose 2 of the plan" in near.sentence
    assert not any(name in far.sentence for name in NAMES)
    assert near.row_is_used
    assert not near.repeat
    (alarm,) = unplanned_joint_alarms(ROBOT, PLAN.measure(q[:1].deg2rad()), 0, PLAN.stored.q, NAMES)
    assert "pose 1 of the plan" in alarm.sentence
    assert "radians" in alarm.sentence


def test_a_contradicted_row_and_a_swapped_point():
    rows = PLAN.rows(15)
    wrong = with_offset(rows, 14, (0.003, -0.004, 0.0))
    trusted = torch.arange(15) < 14
    alarm = contradiction_alarm(wrong, judge_rows(ROBOT, wrong, NOISE, trusted), 14, PLAN.stored.q, NAMES)
    assert alarm.kind == "off"
    assert alarm.line == 16
    other = PLAN.measure(PLAN.stored.q[20:21]).position
    swapped = Measurements(q=rows.q, position=torch.cat([rows.position[:14], other]), line=rows.line)
    alarm = contradiction_alarm(swapped, judge_rows(ROBOT, swapped, NOISE, trusted), 14, PLAN.stored.q, NAMES)
    assert alarm.kind == "swapped"
    assert "pose 21 of the plan" in alarm.sentence
