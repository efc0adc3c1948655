"""A model folder and the model in memory are equivalent: every step gives bitwise equal results with both."""

from dataclasses import replace

import pytest
from testing.aged import original_model, rows_after_change
from testing.same_model import differences

from pisigma.model.inverse.written_model import write_model
from pisigma.planning.plan_settings import PlanSettings
from pisigma.workflow.compare import compare
from pisigma.workflow.monitor import monitor
from pisigma.workflow.plan import plan
from pisigma.workflow.recalibrate import recalibrate

COLLISION = (0.0, 0.0, 0.00436, 0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("models") / "rb5"
    path.mkdir()
    write_model(original_model(), path)
    return path


def test_plans_are_the_same(folder):
    settings = PlanSettings(count=4, check=1, candidates=100)
    one, other = (plan(source, settings) for source in (original_model(), folder))
    assert differences(one.stored_plan.q, other.stored_plan.q) == []
    assert differences(one.accuracy_curve, other.accuracy_curve) == []


def test_recalibrations_are_the_same(folder):
    one, other = (
        recalibrate(source, rows_after_change(10, 2, COLLISION)) for source in (original_model(), folder)
    )
    assert differences(replace(one.model, metrics={}), replace(other.model, metrics={})) == []
    assert differences(one.movements, other.movements) == []


def test_sessions_and_their_history_are_the_same(folder):
    sessions = [rows_after_change(10, 2, COLLISION)]
    one, other = (monitor(source, sessions) for source in (original_model(), folder))
    assert differences(one.all_sessions, other.all_sessions) == []
    assert differences(one.charts, other.charts) == []


def test_comparisons_are_the_same(folder):
    one, other = (compare("nominal", source).to_json() for source in (original_model(), folder))
    assert differences({**one, "seconds": 0, "models": []}, {**other, "seconds": 0, "models": []}) == []
