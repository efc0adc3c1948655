"""Faults that all rows of a session have in common."""

from dataclasses import replace

import pytest
import torch
from testing.measured_plans import measured_plan

from pisigma.measuring.setup_sentence import setup_sentence
from pisigma.workflow.measure import MeasuringSession

PLAN = measured_plan("kiro3")
ROBOT = PLAN.stored.arm.robot


def sentence(rows):
    return setup_sentence(ROBOT, rows, torch.ones(rows.rows, dtype=torch.bool))


def test_right_rows_and_very_few_have_no_fault():
    assert sentence(PLAN.rows(5)) == sentence(PLAN.rows(24)) == ""
    few = PLAN.rows(3)
    assert sentence(replace(few, position=few.position * 1000)) == ""


@pytest.mark.parametrize("rows", [5, 24])
@pytest.mark.parametrize(
    ("factor", "unit"),
    [(1000.0, "millimetres that are named metres"), (0.001, "metres that are named millimetres")],
)
def test_a_wrong_unit_is_named(rows, factor, unit):
    some = PLAN.rows(rows)
    assert unit in sentence(replace(some, position=some.position * factor))


def test_a_session_says_so_once_and_does_not_advise_to_go_on():
    session, rows = MeasuringSession(PLAN.stored), PLAN.rows(5)
    rows = replace(rows, position=rows.position * 1000)
    alarms = session.add(rows.select(torch.arange(4)))
    assert [alarm.line for alarm in alarms if alarm.kind == "setup"] == [1]
    assert "setup" not in [alarm.kind for alarm in session.add(rows.select(torch.tensor([4])))]
    session.work_out()
    assert session.state.accuracy is None
    assert session.state.advice.action == "repeat"
    assert "named metres" in session.state.advice.sentence
