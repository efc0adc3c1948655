"""Content of reports: figures against numpy, and the rows that they are attributed to."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.models import hand_made_model, joints_around
from testing.refusals import refused
from testing.report import folder_with_held_out, geometric_under_test, hybrid_under_test, measured

from pisigma.files.errors import MeasurementError
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import poses_of_rows
from pisigma.reporting.page.content import causes_of, report_content
from pisigma.validation.held_out.calibration_summary import CalibrationSummary
from pisigma.validation.held_out.diagnostic import Diagnostic
from pisigma.validation.held_out.judged_rows import MAX_PREDICTED, predicted_position_sigma
from pisigma.validation.held_out.validation_figures import ErrorFigures
from pisigma.validation.report.accuracy import scatter_contribution
from pisigma.validation.report.corrections import (
    correction_curves,
    measured_intervals,
    partly_measured_joints,
)

pytestmark = pytest.mark.usefixtures("without_type_checker")


@pytest.fixture(scope="module")
def hybrid():
    return hybrid_under_test()


def test_figures_of_other_rows_agree_with_numpy(hybrid, tmp_path):
    arm, model = hybrid
    rows = measured(arm, 150, seed=9)
    content = report_content(model, tmp_path, rows)
    assert content.rows.row_role == "other"
    first = content.accuracies[0]
    assert (first.origin, first.is_held_out, first.rows) == ("file", True, 150)
    assert list(first.models) == ["nominal", "geometric", "hybrid"]
    error = np.linalg.norm((rows.position - poses_of_rows(model, rows)[:, :3, 3]).numpy(), axis=1) * 1e3
    for name, value in (
        ("mean_mm", error.mean()),
        ("rms_mm", np.sqrt((error**2).mean())),
        ("p95_mm", np.quantile(error, 0.95)),
        ("max_mm", error.max()),
    ):
        assert_close(getattr(first.models["hybrid"], name), value, rtol=1e-12)
    after = next(layer for layer in content.map.layers if layer.key == "after")
    assert_close(after.values, error, rtol=1e-12)
    assert_close(
        first.improvement_factor,
        first.models["nominal"].rms_mm / first.models["hybrid"].rms_mm,
        rtol=0,
        atol=0,
    )
    assert content.verdict.is_held_out
    assert first.models["nominal"].rms_mm > 2 * first.models["hybrid"].rms_mm


def test_rows_of_the_calibration_are_recognised_by_their_hash(hybrid, tmp_path):
    arm, model = hybrid
    content = report_content(model, tmp_path, arm.measurements)
    assert content.rows.row_role == "training"
    own = content.accuracies[-1]
    assert own.origin == "training"
    assert not own.is_held_out
    assert content.accuracies[0].origin == "cross_validation"  # the held-out figures of the model come first
    assert content.accuracies[0].models == CalibrationSummary.read(model).cross_validation.models


def test_training_rows_are_not_held_out_rows(hybrid, tmp_path):
    arm, model = hybrid
    bare = replace(model, metrics={})
    content = report_content(bare, tmp_path, arm.measurements)
    assert not content.verdict.is_held_out
    assert [(one.origin, one.rows) for one in content.accuracies] == [("training", 200)]


def test_joint_values_measured_again_are_reported(hybrid, tmp_path):
    arm, model = hybrid
    again = replace(arm.measurements, position=arm.measurements.position + 1e-5)
    content = report_content(model, tmp_path, again)
    assert content.rows.row_role == "other"
    assert any("200 of 200" in line for line in content.rows.repeated_row_warnings)
    assert set(content.rows.repeated_row_warnings) < set(content.remarks)


def test_a_folder_that_keeps_held_out_rows_shows_them(hybrid, tmp_path):
    arm, model = hybrid
    kept = folder_with_held_out(arm, model, tmp_path / "arm")
    training = report_content(model, tmp_path, arm.measurements).rows
    for rows in (arm.measurements, None):
        content = report_content(kept, tmp_path / "arm", rows)
        assert content.rows.row_role == "held_out"
        assert_close(content.rows.model_errors.position, 1.1 * training.model_errors.position, rtol=6e-5)
        assert content.correlations.tables
    other = report_content(kept, tmp_path / "arm", measured(arm, 40, seed=9))
    assert other.rows.row_role == "other"


def test_a_model_in_another_frame_is_worse_than_nominal(hybrid, tmp_path):
    rows = measured(hybrid[0], 60, seed=9)
    moved = replace(rows, position=rows.position + 0.05)
    content = report_content(hybrid[1], tmp_path, moved)
    factor = content.accuracies[0].improvement_factor
    assert factor < 1
    assert f"{1 / factor:.1f} times" in content.verdict.sentence


def test_rows_marked_as_train_are_left_out(hybrid, tmp_path):
    arm, model = hybrid
    rows = replace(measured(arm, 40, seed=9), split=("train",) * 10 + ("test",) * 30)
    content = report_content(model, tmp_path, rows)
    assert (content.rows.measurements.rows, content.rows.left_out) == (30, 10)
    assert any("10 rows" in line for line in content.remarks)


def test_errors_per_frame_and_target(tmp_path):
    arm, model = hybrid_under_test(frames=True)
    content = report_content(model, tmp_path, arm.measurements)
    names = content.frames.name_errors
    assert [one.name for one in names] == ["wall", "floor"]
    assert sum(one.rows for one in names) == 200
    error = content.rows.residual.norm(dim=-1).numpy() * 1e3
    wall = np.array([name == "wall" for name in arm.measurements.frame])
    assert_close(names[0].model_rms, np.sqrt((error[wall] ** 2).mean()), rtol=1e-12)
    assert_close(names[0].bias_mm, content.rows.residual.numpy()[wall].mean(0) * 1e3, rtol=1e-9, atol=1e-12)
    assert 0 < content.frames.p_value <= 1
    assert content.frames.largest.model_rms == max(one.model_rms for one in names)
    assert len(content.targets.name_errors) == 2


def test_rows_in_sockets_are_compared_with_the_mean_of_the_socket(hybrid, tmp_path):
    arm, model = hybrid
    q = arm.measurements.q[:9]
    rows = Measurements(q=q, socket=("A",) * 4 + ("B",) * 4 + ("alone",))
    content = report_content(model, tmp_path, rows)
    ball = poses_of_rows(model, rows)[:, :3, 3]
    expected = torch.cat([ball[:4].mean(0) - ball[:4], ball[4:8].mean(0) - ball[4:8]])
    assert_close(content.rows.residual[:8], expected, atol=1e-12)
    assert bool(torch.isnan(content.rows.residual[8]).all())
    assert content.rows.rows_without_position_error == 1
    assert any("1 of 9 rows" in line for line in content.remarks)


def test_rows_that_cannot_be_judged_are_refused(hybrid, tmp_path):
    q = hybrid[0].measurements.q[:5]
    rows = Measurements(q=q, frame=("jig",) * 5, touch_axis=("x",) * 5, touch=torch.zeros(5).double())
    with refused(MeasurementError):
        report_content(hybrid[1], tmp_path, rows)


def test_the_workspace_is_shown_without_rows(hybrid, tmp_path):
    content = report_content(hybrid[1], tmp_path)
    assert content.rows is None
    assert [layer.key for layer in content.map.layers] == ["correction", "predicted"]
    assert len(content.map.position_mm) == 3000
    assert (content.map.rows, content.map.random_points) == (0, 3000 - len(hybrid[1].starts))
    assert content.missing_figures
    assert content.dependences == ()


def test_a_geometric_model_has_no_curves_and_no_noise(tmp_path):
    arm, model = geometric_under_test()
    content = report_content(model, tmp_path, measured(arm, 80, seed=9))
    assert list(content.accuracies[0].models) == ["nominal", "geometric"]
    assert content.curves == ()
    assert len(content.missing_figures) == 1  # no predicted accuracy
    assert (content.limit.scatter_mm, content.limit.scatter_share) == (None, None)
    assert content.summary == CalibrationSummary.read(model)


@pytest.mark.parametrize("name", ["kiro3", "ur10"])
def test_a_model_of_a_network_only_is_reported(name, tmp_path):
    model = hand_made_model(name)
    alone = report_content(model, tmp_path)
    assert alone.accuracies == ()
    assert not alone.verdict.is_held_out
    assert alone.summary is None
    q = joints_around(name, 50, seed=4)
    T = model.forward(q)
    rows = Measurements(q=q, position=T[:, :3, 3], rotation=T[:, :3, :3])
    content = report_content(model, tmp_path, rows)
    assert list(content.accuracies[0].models) == ["nominal", "corrected"]
    assert content.accuracies[0].model_figures.max_mm < 1e-6 < content.accuracies[0].models["nominal"].rms_mm
    assert {layer.key for layer in content.map.layers} >= {"before", "after", "before_deg", "after_deg"}


def test_orientations_alone_are_reported(hybrid, tmp_path):
    model = hybrid[1]
    q = hybrid[0].measurements.q[:40]
    rows = Measurements(q=q, rotation=poses_of_rows(model, Measurements(q=q))[:, :3, :3])
    content = report_content(model, tmp_path, rows)
    assert content.accuracies[0].unit == "deg"
    assert content.accuracies[0].model_figures.max_deg < 1e-6


def test_repeated_rows_show_the_scatter(hybrid, tmp_path):
    arm, model = hybrid
    q = arm.measurements.q[:60].repeat(4, 1)
    rng = np.random.default_rng(0)
    position = arm.true.forward(q)[:, :3, 3] + torch.from_numpy(rng.normal(0, 1e-4, (240, 3)))
    content = report_content(model, tmp_path, Measurements(q=q, position=position))
    limit = content.limit
    assert limit.scatter_source == "repeats"
    values = content.rows.residual.numpy().reshape(4, 60, 3)
    pooled = ((values - values.mean(0)) ** 2).sum() / (240 - 60)
    assert_close(limit.scatter_mm, math.sqrt(pooled) * 1e3, rtol=1e-12)
    assert_close(limit.scatter_mm, math.sqrt(3) * 0.1, rtol=0.1)


def test_the_noise_that_a_hybrid_identified_is_the_limit(hybrid, tmp_path):
    model = hybrid[1]
    sigma = model.metrics["hybrid"]["learned"]["noise"][0]["sigma_mm"]
    accuracy = report_content(model, tmp_path).accuracies[0]
    limit = scatter_contribution(model, CalibrationSummary.read(model), accuracy, None)
    assert_close(limit.scatter_mm, math.sqrt(3) * sigma, rtol=1e-12)
    larger = replace(accuracy, models={"hybrid": ErrorFigures(rms_mm=2 * limit.scatter_mm)})
    limit = scatter_contribution(model, CalibrationSummary.read(model), larger, None)
    assert_close(limit.scatter_share, 0.25, rtol=1e-12)
    assert (limit.scatter_source, limit.is_mostly_scatter) == ("hybrid", False)


def test_scatter_above_the_error_has_no_share(hybrid, tmp_path):
    model = hybrid[1]
    accuracy = report_content(model, tmp_path).accuracies[0]
    smaller = replace(accuracy, models={"hybrid": ErrorFigures(rms_mm=1e-3)})
    limit = scatter_contribution(model, CalibrationSummary.read(model), smaller, None)
    assert limit.scatter_mm > 1e-3
    assert limit.scatter_share is None
    assert limit.rms_error_mm == 1e-3


def test_accuracy_is_predicted_at_many_rows_at_most(hybrid, monkeypatch):
    arm, model = hybrid
    monkeypatch.setattr("pisigma.validation.held_out.judged_rows.MAX_PREDICTED", 20)
    found = predicted_position_sigma(model, arm.measurements)
    assert int(torch.isfinite(found).sum()) == 20
    assert MAX_PREDICTED > 20
    assert bool(torch.isfinite(found[[0, -1]]).all())


def test_curves_are_the_correction_at_the_middle_row(hybrid):
    model = hybrid[1]
    curves = correction_curves(model)
    assert [curve.joint for curve in curves] == [joint.name for joint in model.robot.joints]
    q, curve = model.starts, curves[2]
    with torch.no_grad():
        seen = model.hybrid.correction(q)[:, 2].numpy() * math.degrees(1e3)
    assert_close(curve.row_corrections, seen, rtol=1e-12)
    assert curve.measured.any()


def test_measured_values_are_in_the_stretches_up_to_turns(hybrid):
    model = hybrid[1]
    for j, (stretches, (low, high)) in enumerate(measured_intervals(model, model.starts)):
        assert all(low - math.pi - 1e-9 <= a < b <= high + math.pi + 1e-9 for a, b in stretches)
        turns = model.starts[:, j].numpy()[:, None] + 2 * math.pi * np.arange(-2, 3)
        inside = [(turns >= a - 1e-9) & (turns <= b + 1e-9) for a, b in stretches]
        assert np.any(inside, axis=(0, 2)).all()


@pytest.mark.parametrize("name", ["kiro3", "ur10"])
def test_gaps_of_joints_that_were_measured_in_part(name, tmp_path):
    model = hand_made_model(name)
    gap = partly_measured_joints(model, None)[0]
    own = np.degrees(model.starts[:, 0].numpy())
    assert gap.joint == "theta_1"
    assert gap.measured_share < 1
    assert_close(gap.measured[0], [own.min(), own.max()], atol=0.51)
    assert any("theta_1" in line for line in report_content(model, tmp_path).advice)


@pytest.mark.parametrize("quantity", ["payload", "temperature"])
@pytest.mark.parametrize(
    "mean", [0.0, 0.5]
)  # from the first row on, and as an uncorrected effect: least at the mean
def test_a_dependence_on_a_condition_is_found(hybrid, tmp_path, quantity, mean):
    arm, model = hybrid
    rows = measured(arm, 300, seed=9)
    share = torch.linspace(0, 1, 300, dtype=torch.float64)
    off = 4e-3 * (share - mean)[:, None] * torch.tensor([0.0, 1.0, 0.0])
    stated = {quantity: 18 + 12 * share}
    content = report_content(model, tmp_path, replace(rows, position=rows.position + off, **stated))
    tests = {found.key: found.test for found in content.dependences}
    assert tests[quantity].significant
    assert tests[quantity].is_notable
    assert (tests["order"].component, tests["order"].significant) == ("y", True)
    calm = report_content(model, tmp_path, replace(rows, **stated))
    assert not {found.key: found.test for found in calm.dependences}[quantity].significant


def test_the_summary_is_json(hybrid, tmp_path):
    content = report_content(hybrid[1], tmp_path, measured(hybrid[0], 40, seed=9))
    text = json.dumps(content.to_json(), allow_nan=False)
    assert (
        json.loads(text)["accuracy"][0]["models"]["hybrid"]["rms_mm"]
        == content.accuracies[0].model_figures.rms_mm
    )


def test_a_distilled_model_is_compared_with_its_parent(tmp_path):
    figures = [
        {f"{name}_mm": size * k for k, name in enumerate(("mean", "rms", "p95", "max"), 1)}
        for size in (1, 0.01)
    ]
    metrics = {
        "parent": {"name": "whole", "kind": "hybrid_calibration"},
        "poses": {"held_out": 77},
        "held_out": {"nominal": figures[0], "distilled": figures[1], "full": figures[1]},
        "joints": [{"name": "theta_1", "unit": "deg", "error_rms_deg": 0.1}],
        "limitations": ["Reach: less."],
    }
    content = report_content(replace(hand_made_model("ur10"), kind="distilled", metrics=metrics), tmp_path)
    assert list(content.accuracies[0].models) == ["nominal", "full", "distilled"]
    first = content.accuracies[0]
    assert (first.origin, first.rows, first.source) == ("poses", 77, "whole")
    assert content.limit.is_approximation
    assert content.verdict.limiting_cause == "Reach: less."
    assert content.joints == ()


def test_a_report_names_one_first_cause(hybrid, tmp_path):
    """A diagnosed fault is what limits the accuracy; scatter and model are then not named as well."""
    rows = measured(hybrid[0], 60, seed=9)
    fault = Diagnostic(kind="setup_fault", severity="implausible", sentence="Joint 2 counts the other way.")
    content = report_content(hybrid[1], tmp_path, rows, diagnostics=(fault,))
    assert content.verdict.limiting_cause == content.advice[0] == content.remarks[0] == fault.sentence
    assert content.to_json()["limit"]["summary"] == fault.sentence
    plain = report_content(hybrid[1], tmp_path, rows)
    assert len(content.verdict.sentence) < len(plain.verdict.sentence)


def test_warnings_about_the_rows_are_not_causes():
    few = Diagnostic(kind="few_rows", severity="warning", sentence="Measure more poses.")
    lag = Diagnostic(kind="lag", severity="warning", sentence="Joint values were logged late.")
    assert causes_of(None, (few, lag)) == (lag.sentence,)
