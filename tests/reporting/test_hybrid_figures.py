"""Figures and texts of a hybrid calibration."""

import numpy as np
import pytest
import torch
from PIL import Image
from pisigma.reporting.hybrid_card import compared, curve_rows, hybrid_parts
from pisigma.reporting.hybrid_figures import (
    _over_own_value,
    draw_corrections,
    draw_learning_curve,
    draw_spread,
)
from pisigma.reporting.hybrid_report import TRIAL_COLUMNS, coverage_line, report_hybrid, trial_rows
from testing.closeness import assert_close
from testing.hybrid import hybrid_of

from pisigma.judging.predicted_spread import PredictedSpread


def ink(path) -> float:
    """Share of the pixels that are not white."""
    with Image.open(path) as image:
        return float((np.asarray(image.convert("L")) < 250).mean())


@pytest.fixture(scope="module")
def arm():
    return hybrid_of("rb5", 240)


def test_the_line_is_the_correction_with_the_other_joints_at_their_middle(arm):
    correction, q = arm.result.learned.correction, arm.measurements.q
    own, line = _over_own_value(correction, q, 2)
    assert_close(own[[0, -1]], [float(q[:, 2].min()), float(q[:, 2].max())], atol=1e-12)
    at = q.median(0).values.clone()
    at[2] = own[700]
    assert_close(line[700], float(correction(at)[2]), atol=1e-15)
    assert float(np.ptp(line)) > 1e-5


def test_a_panel_for_every_joint(arm, tmp_path):
    path = tmp_path / "joints.png"
    draw_corrections(arm.result.learned.correction, arm.measurements, path)
    with Image.open(path) as image:
        width, height = image.size
    assert width > height > 700
    assert ink(path) > 0.02


@pytest.mark.parametrize("far", [0.1, 30.0])
def test_predicted_deviations_near_and_far_apart(tmp_path, generator, far):
    sigma = 1e-5 * (1 + far * torch.rand(200, 3, generator=generator, dtype=torch.float64))
    error = sigma * torch.randn(200, 3, generator=generator, dtype=torch.float64)
    error[3] = torch.nan
    draw_spread(PredictedSpread(error, sigma), tmp_path / "spread.png")
    assert ink(tmp_path / "spread.png") > 0.02


def test_one_value_can_be_drawn(tmp_path):
    one = PredictedSpread.none(1)
    one.error[0, 0], one.sigma[0, 0] = 1e-5, 2e-5
    draw_spread(one, tmp_path / "spread.png")
    assert one.coverage == 1.0


@pytest.mark.parametrize("rows", [[30], [30, 50, 100, 1500]])
def test_a_curve_for_every_model(tmp_path, rows):
    models = {
        name: [scale / count for count in rows] for name, scale in (("geometric", 9.0), ("hybrid", 3.0))
    }
    draw_learning_curve(rows, models, tmp_path / "curve.png")
    assert ink(tmp_path / "curve.png") > 0.01


def test_what_was_tried_is_told_in_order(arm):
    report = report_hybrid(arm.result)
    rows = trial_rows(report)
    assert all(len(row) == len(TRIAL_COLUMNS) for row in rows)
    assert [row[0] for row in rows] == [trial.name for trial in arm.result.trials]
    assert rows[0][3] == "1.000"
    assert rows[0][2] == f"{arm.result.trials[0].log_evidence:.1f}"
    learned = report["learned"]
    assert [chosen["name"] for chosen in learned["features"]] == ["gravity", "series"]
    assert_close(learned["noise"][0]["sigma_mm"], 1e3 * arm.result.learned.noise["position"], rtol=1e-12)
    text = "\n\n".join(hybrid_parts({"hybrid": report}))
    assert arm.result.verdict in text
    assert "joint_corrections.png" in text
    assert "learning_curve.png" not in text
    assert "predicted_spread.png" not in text


def test_trials_without_evidence_have_an_empty_cell():
    trial = {"name": "x", "unknowns": 3, "log_evidence": None, "left_out": 0.5, "seconds": 1.0, "kept": False}
    assert trial_rows({"trials": [trial]}) == [("x", "3", "", "0.500", "1.0", "no")]


def test_models_are_compared_in_one_order():
    figures = {"hybrid": {"rms_mm": 1.0}, "rows": 3, "nominal": {"rms_mm": 3.0}, "geometric": {"rms_mm": 2.0}}
    assert list(compared(figures)) == ["nominal", "geometric", "hybrid"]
    head, rows = curve_rows([{**figures, "rows": 30, "coverage": 0.934}])
    assert head[0] == "training rows"
    assert rows == [("30", "3.0000", "2.0000", "1.0000", "93.4")]
    assert coverage_line({"coverage": 0.934, "predicted_rms_mm": 0.1}).startswith("93.4 % of")
    assert hybrid_parts({}) == []
