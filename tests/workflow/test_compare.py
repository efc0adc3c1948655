"""`pisigma.compare`: differences and distances between two models, and which one predicts rows better."""

from dataclasses import replace

import pytest
import torch
from testing.aged import rows_after_change
from testing.closeness import assert_close
from testing.compared import COLLISION, joints_of, model_of
from testing.models import no_type_checker
from testing.refusals import refused

from pisigma.files.errors import IdentificationError
from pisigma.measurement.dataset import Measurements
from pisigma.workflow.compare import compare
from pisigma.workflow.settings.comparison import ComparisonSettings


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """Models before and after a collision, with rows from after it and a program."""
    program = tmp_path_factory.mktemp("compare") / "program.csv"
    model = model_of(50)
    Measurements(q=joints_of(model, 5), position=model.forward(joints_of(model, 5))[:, :3, 3]).write_csv(
        program, model.robot
    )
    return compare(model, model_of(61, COLLISION), rows_after_change(20, 70, COLLISION), program)


def test_the_model_of_the_robot_as_it_is_predicts_its_rows_better(compared):
    assert compared.better_model == "rows_61"


def test_a_program_misses_about_what_the_joint_moved_by(compared):
    report = compared.to_json()
    assert report["program"]["poses"] == 5
    assert 0.1 < report["program"]["rms_mm"] < 3.0  # 0.1 deg at less than 1 m, base and tool fitted
    assert report["workspace"]["rms_mm"] == pytest.approx(report["program"]["rms_mm"], rel=0.8)
    assert report["program"]["largest_at_pose"] in range(1, 6)


def test_the_report_is_whole(compared):
    report = compared.to_json()
    assert [one["what"] for one in report["differs"]] == ["joint 3"]
    theta = next(one for one in report["parameters"] if one["name"] == "theta_3")
    assert_close(theta["shift_deg"], 0.1, atol=0.005)
    assert theta["p"] < 1e-6
    assert "joint 3" in report["summary"][0]
    assert report["rows"]["better"] == "rows_61"


def test_models_of_the_same_name_and_rows_get_different_names_and_a_warning():
    model = model_of(50)
    result = compare(model, replace(model))
    assert list(result.models) == ["rows_50", "rows_50-2"]
    assert result.parameters.significant_differences == ()
    assert_close(result.to_json()["workspace"]["max_mm"], 0.0, atol=1e-6)
    assert len(result.warnings) == 1


def test_rows_that_one_of_the_models_was_made_from_are_warned_of(compared):
    assert compared.warnings == ()
    models = [model_of(50), model_of(61, COLLISION)]
    some = rows_after_change(80, 61, COLLISION).select(torch.arange(8))
    (warning,) = compare(*models, some).warnings
    assert warning.startswith("rows_61 ")


@pytest.mark.parametrize(("option", "value"), [("level", 0.0), ("frames", "fixd")])
def test_settings_out_of_range_are_refused(option, value):
    with no_type_checker(), refused(IdentificationError, option=option, value=value):
        ComparisonSettings(**{option: value})
