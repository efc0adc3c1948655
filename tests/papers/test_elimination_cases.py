"""Elimination of other members of redundant sets gives the same predictions with other values."""

import json

import pytest
from testing.closeness import assert_close
from testing.models import shipped_training
from testing.refusals import refused

from elimination_cases import report_correlations, report_eliminations
from pisigma.files.errors import RecipeError
from pisigma.workflow.recipes.data import simulate
from pisigma.workflow.recipes.reader import read_recipe
from published import read_published


@pytest.fixture(scope="module")
def recipe(repository):
    return read_recipe(repository / "training" / "rb5_redundancy.yaml")


@pytest.fixture(scope="module")
def calibrated():
    calibration = shipped_training("rb5_redundancy")
    return calibration.result, calibration.rows


def test_every_case_predicts_the_same_and_keeps_the_sums(repository, recipe, calibrated):
    result, rows = calibrated
    two = read_published(repository / "training").redundant_sums["rb5"].cases[:2]
    report = report_eliminations(recipe, two, result, rows, simulate(recipe).held_out)
    json.dumps(report, allow_nan=False)
    first, second, none = report["elimination_cases"]
    assert [case["parameters"] for case in (first, second, none)] == [28, 28, 35]
    assert [case["removed"] for case in (first, second, none)] == [*map(list, two), []]
    for case in (first, second, none):
        assert case["held_out_rms_mm"] < 1e-9
        assert_close(case["rmse_mm"][0], result.rms_path[0] * 1e3, rtol=1e-12)
        total = sum(case["values"][name] for name in ("d_2", "d_3", "d_4"))
        assert_close(total, sum(report["true_values"][name] for name in ("d_2", "d_3", "d_4")), atol=0.01)
    assert first["values"]["d_3"] == 0
    assert second["values"]["d_4"] == pytest.approx(110.7)
    assert_close(report["true_values"]["d_6"] - 94.7, 0.0, atol=1.0)


def test_correlations_are_json_with_none_where_there_is_no_effect(recipe, calibrated):
    angles = report_correlations(calibrated[0])["correlations"]["angles"]
    json.dumps(angles, allow_nan=False)
    place = {name: index for index, name in enumerate(angles["names"])}
    assert angles["values"][place["theta_4"]][place["beta_4"]] == -1
    assert angles["values"][place["theta_1"]][place["beta_1"]] == 1
    for name in recipe.paper["no_effect"]:
        assert set(angles["values"][place[name]]) == {None}


def test_a_case_that_names_no_parameter_is_refused(recipe, calibrated):
    with refused(RecipeError, value="d_33"):
        report_eliminations(recipe, [["d_33"]], *calibrated, calibrated[1])
