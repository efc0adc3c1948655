"""Evaluation in Python: limits of an acceptance test, and models given as objects."""

from dataclasses import replace

import pytest
import torch
from testing.calibrated_ur5 import calibrated_ur5, measured

import pisigma
from pisigma.files.errors import MeasurementError
from pisigma.robot.se3 import transform_from_xyzrpy
from pisigma.validation.held_out.model_comparison import ModelFigures, QuantityErrors
from pisigma.validation.resampling import Bootstrap
from pisigma.workflow.settings.evaluation import EvaluationSettings, Limits


def errors(unit: str, **statistics: float) -> QuantityErrors:
    return QuantityErrors(unit, statistics, {}, {}, {}, {}, None)


MODEL = ModelFigures(
    name="arm",
    rows_not_predicted=0,
    position=errors("mm", mean=0.5, p95=1.0, max=2.0),
    orientation=errors("deg", mean=0.1),
    rows_inside=None,
    rows_outside=None,
)


def test_a_model_that_meets_its_limits_misses_none():
    assert Limits().missed_by(MODEL) == []
    assert Limits(0.5, 1.0, 2.0, 0.1).missed_by(MODEL) == []


@pytest.mark.parametrize(
    ("name", "limit", "sentence"),
    [
        ("mean_mm", 0.4, "the mean position error of arm is 0.5000 mm, --max-mean-mm allows 0.4 mm"),
        (
            "p95_mm",
            0.99,
            "the 95 % quantile of the position error of arm is 1.0000 mm, --max-p95-mm allows 0.99 mm",
        ),
        ("max_mm", 1.5, "the largest position error of arm is 2.0000 mm, --max-mm allows 1.5 mm"),
        ("mean_deg", 0.05, "the mean orientation error of arm is 0.1000 deg, --max-mean-deg allows 0.05 deg"),
    ],
)
def test_what_is_missed_is_said_with_figures(name: str, limit: float, sentence: str):
    assert Limits(**{name: limit}).missed_by(MODEL) == [sentence]


def test_figures_that_look_alike_are_given_in_full():
    close = replace(MODEL, position=errors("mm", mean=0.50000001))
    assert Limits(mean_mm=0.5).missed_by(close) == [
        "the mean position error of arm is 0.50000001 mm, --max-mean-mm allows 0.5 mm"
    ]


def test_rows_that_are_not_predicted_meet_no_limit():
    lost = replace(MODEL, rows_not_predicted=3)
    assert Limits().missed_by(lost) == []
    assert Limits(max_mm=10.0).missed_by(lost) == ["arm predicts nothing for 3 of the rows"]


@pytest.mark.parametrize("limit", [0.0, -1.0, float("nan"), float("inf")])
def test_no_limit_at_all_is_refused(limit: float):
    with pytest.raises(MeasurementError, match=r"--max-mm .*: a limit above 0 was wanted"):
        Limits(max_mm=limit)


def test_a_limit_on_what_was_not_measured_is_refused():
    with pytest.raises(MeasurementError, match="--max-mean-deg 1: no orientations were measured"):
        Limits(mean_deg=1.0).missed_by(replace(MODEL, orientation=None))


@pytest.mark.usefixtures("without_type_checker")
def test_models_and_rows_in_memory():
    """The typed result holds what the command prints, and states what was missed."""
    model, q, T = calibrated_ur5(40)
    rows = measured(q, T, False)
    settings = EvaluationSettings(Limits(max_mm=1e-6), bootstrap=Bootstrap(20))
    found = pisigma.evaluate(["nominal", model], rows, settings)
    assert [one.name for one in found.models] == ["nominal", "ur5"]
    assert not found.accepted
    assert len(found.missed) == 1
    printed = found.to_json()
    assert (printed["accepted"], printed["rows"], printed["model"]) == (False, 40, "ur5")
    assert printed["models"][1]["rms_mm"] == found.models[1].position.statistics["rms"]
    assert pisigma.evaluate(model, rows, EvaluationSettings(bootstrap=Bootstrap(20))).accepted
    assert pisigma.verify(model, rows).accepted


@pytest.mark.usefixtures("without_type_checker")
def test_a_base_or_a_tool_that_has_moved_is_named():
    """Without a limit, and where errors are plausible; fitted, it is fine."""
    model, q, T = calibrated_ur5(40)
    X = transform_from_xyzrpy(torch.tensor([5e-3, 0.0, 0.0, 1e-3, 0.0, 0.0]).double())
    for poses, what, fitted in (
        (X @ T, "base", EvaluationSettings(fit_frame=True, bootstrap=Bootstrap(20))),
        (T @ X, "tool", EvaluationSettings(fit_tool=True, bootstrap=Bootstrap(20))),
    ):
        found = pisigma.evaluate(
            model, measured(q, poses, False), EvaluationSettings(bootstrap=Bootstrap(20))
        )
        assert not found.accepted
        (diagnostic,) = found.diagnostics
        assert f"ur5: The {what} has moved by about" in diagnostic.sentence
        assert f"recalibrate with --moved {what}" in diagnostic.sentence
        assert pisigma.evaluate(model, measured(q, poses, False), fitted).accepted
