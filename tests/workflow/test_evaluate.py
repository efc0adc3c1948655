"""Evaluation in Python: limits of an acceptance test, and models given as objects."""

from dataclasses import replace

import pytest
import torch
from testing.calibrated_ur5 import calibrated_ur5, measured
from testing.refusals import refused

import pisigma
from pisigma.files.errors import MeasurementError
from pisigma.robot.se3 import transform_from_xyz_zyx
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
    rows_inside_domain=None,
    rows_outside_domain=None,
)


def test_a_model_within_its_limits_misses_no_limit():
    assert Limits().missed_by(MODEL) == []
    assert Limits(0.5, 1.0, 2.0, 0.1).missed_by(MODEL) == []


@pytest.mark.parametrize(
    ("name", "limit", "error", "option"),
    [
        ("mean_mm", 0.4, "0.5000 mm", "--max-mean-mm"),
        ("p95_mm", 0.99, "1.0000 mm", "--max-p95-mm"),
        ("max_mm", 1.5, "2.0000 mm", "--max-mm"),
        ("mean_deg", 0.05, "0.1000 deg", "--max-mean-deg"),
    ],
)
def test_missed_limits_are_named_with_figures(name: str, limit: float, error: str, option: str):
    (missed,) = Limits(**{name: limit}).missed_by(MODEL)
    assert all(one in missed for one in ("arm", error, option, f"{limit:g} {error.split()[1]}"))


def test_almost_equal_figures_are_given_in_full():
    close = replace(MODEL, position=errors("mm", mean=0.50000001))
    (missed,) = Limits(mean_mm=0.5).missed_by(close)
    assert "0.50000001 mm" in missed


def test_a_model_that_cannot_predict_some_rows_misses_its_limits():
    lost = replace(MODEL, rows_not_predicted=3)
    assert Limits().missed_by(lost) == []
    assert len(Limits(max_mm=10.0).missed_by(lost)) == 1


@pytest.mark.parametrize("limit", [0.0, -1.0, float("inf")])
def test_limits_out_of_range_are_refused(limit: float):
    with refused(MeasurementError, option="--max-mm", value=limit):
        Limits(max_mm=limit)


def test_a_limit_that_is_not_a_number_is_refused():
    with refused(MeasurementError, option="--max-mm"):
        Limits(max_mm=float("nan"))


def test_a_limit_of_the_orientation_error_needs_orientations():
    with refused(MeasurementError, option="--max-mean-deg", value=1.0):
        Limits(mean_deg=1.0).missed_by(replace(MODEL, orientation=None))


@pytest.mark.usefixtures("without_type_checker")
def test_models_and_rows_in_memory():
    """The result contains what the command prints, and the missed limits."""
    model, q, T = calibrated_ur5(40)
    rows = measured(q, T, False)
    settings = EvaluationSettings(Limits(max_mm=1e-6), bootstrap=Bootstrap(20))
    found = pisigma.evaluate(["nominal", model], rows, settings)
    assert [one.name for one in found.models] == ["nominal", "ur5"]
    assert not found.accepted
    assert len(found.missed_limits) == 1
    printed = found.to_json()
    assert (printed["accepted"], printed["rows"], printed["model"]) == (False, 40, "ur5")
    assert printed["models"][1]["rms_mm"] == found.models[1].position.statistics["rms"]
    assert pisigma.evaluate(model, rows, EvaluationSettings(bootstrap=Bootstrap(20))).accepted
    assert pisigma.verify(model, rows).accepted


@pytest.mark.usefixtures("without_type_checker")
def test_a_base_or_a_tool_that_has_moved_is_named():
    """Without a limit, and where errors are plausible; fitted, it is fine."""
    model, q, T = calibrated_ur5(40)
    X = transform_from_xyz_zyx(torch.tensor([5e-3, 0.0, 0.0, 1e-3, 0.0, 0.0]).double())
    for poses, what, fitted in (
        (X @ T, "base", EvaluationSettings(fit_frame=True, bootstrap=Bootstrap(20))),
        (T @ X, "tool", EvaluationSettings(fit_tool=True, bootstrap=Bootstrap(20))),
    ):
        found = pisigma.evaluate(
            model, measured(q, poses, False), EvaluationSettings(bootstrap=Bootstrap(20))
        )
        assert not found.accepted
        (diagnostic,) = found.diagnostics
        assert (diagnostic.kind, diagnostic.cause) == ("setup_fault", {"base": "frame"}.get(what, what))
        assert f"--moved {what}" in diagnostic.sentence
        assert pisigma.evaluate(model, measured(q, poses, False), fitted).accepted
