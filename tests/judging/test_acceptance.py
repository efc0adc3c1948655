"""Limits of an acceptance test."""

import pytest
from pisigma.judging.acceptance import Limits

from pisigma.errors import MeasurementError

MODEL = {
    "name": "arm",
    "rows_not_predicted": 0,
    "mean_mm": 0.5,
    "p95_mm": 1.0,
    "max_mm": 2.0,
    "mean_deg": 0.1,
}


def test_a_model_that_meets_its_limits_misses_none():
    assert Limits().missed(MODEL) == []
    assert Limits(0.5, 1.0, 2.0, 0.1).missed(MODEL) == []


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
    assert Limits(**{name: limit}).missed(MODEL) == [sentence]


def test_figures_that_look_alike_are_given_in_full():
    close = {**MODEL, "mean_mm": 0.50000001}
    assert Limits(mean_mm=0.5).missed(close) == [
        "the mean position error of arm is 0.50000001 mm, --max-mean-mm allows 0.5 mm"
    ]


def test_rows_that_are_not_predicted_meet_no_limit():
    lost = {**MODEL, "rows_not_predicted": 3}
    assert Limits().missed(lost) == []
    assert Limits(max_mm=10.0).missed(lost) == ["arm predicts nothing for 3 of the rows"]


@pytest.mark.parametrize("limit", [0.0, -1.0, float("nan"), float("inf")])
def test_no_limit_at_all_is_refused(limit: float):
    with pytest.raises(MeasurementError, match=r"--max-mm .*: a limit above 0 was wanted"):
        Limits(max_mm=limit)


def test_a_limit_on_what_was_not_measured_is_refused():
    with pytest.raises(MeasurementError, match="--max-mean-deg 1: no orientations were measured"):
        Limits(mean_deg=1.0).missed({name: value for name, value in MODEL.items() if name != "mean_deg"})
