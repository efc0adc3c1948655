"""Figures and texts of a hybrid calibration."""

import numpy as np
import pytest
import torch
from PIL import Image
from testing.closeness import assert_close
from testing.hybrid import hybrid_of

from pisigma.reporting.calibration_figures import (
    _over_own_value,
    draw_corrections,
    draw_learning_curve,
    draw_spread,
)
from pisigma.reporting.calibration_tables import (
    TRIAL_COLUMNS,
    coverage_line,
    curve_table,
    learned_lines,
    trial_table,
)
from pisigma.validation.held_out.calibration_summary import TrialFigures, summarise
from pisigma.validation.held_out.pose_statistics import ErrorsWithPredictedSigma
from pisigma.validation.held_out.validation_figures import ErrorFigures, LearningPoint


def ink(path) -> float:
    """Share of the pixels that are not white."""
    with Image.open(path) as image:
        return float((np.asarray(image.convert("L")) < 250).mean())


@pytest.fixture(scope="module")
def arm():
    return hybrid_of("rb5", 240)


def test_the_line_has_the_other_joints_at_their_medians(arm):
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
    draw_spread(ErrorsWithPredictedSigma(error, sigma), tmp_path / "spread.png")
    assert ink(tmp_path / "spread.png") > 0.02


def test_one_value_can_be_drawn(tmp_path):
    one = ErrorsWithPredictedSigma.all_nan(1)
    one.error[0, 0], one.sigma[0, 0] = 1e-5, 2e-5
    draw_spread(one, tmp_path / "spread.png")
    assert one.coverage == 1.0


def point(rows: int, scale: float = 1.0, **figures: float) -> LearningPoint:
    """Errors of all three models; of the nominal one three times those of the hybrid."""
    errors = {
        name: ErrorFigures(rms_mm=factor * scale)
        for name, factor in (("hybrid", 1.0), ("nominal", 3.0), ("geometric", 2.0))
    }
    return LearningPoint(rows=rows, held_out=5, **errors, **figures)


@pytest.mark.parametrize("rows", [[30], [30, 50, 100, 1500]])
def test_a_curve_for_every_model(tmp_path, rows):
    draw_learning_curve([point(count, 3.0 / count) for count in rows], tmp_path / "curve.png")
    assert ink(tmp_path / "curve.png") > 0.01


def test_trials_are_listed_in_order(arm):
    hybrid = summarise(arm.result).hybrid
    columns, rows = trial_table(hybrid)
    assert columns == TRIAL_COLUMNS
    assert all(len(row) == len(columns) for row in rows)
    assert [row[0] for row in rows] == [trial.name for trial in arm.result.trials]
    assert rows[0][3] == "1.000"
    assert rows[0][2] == f"{arm.result.trials[0].log_evidence:.1f}"
    assert [features["name"] for features in hybrid.learned.features] == ["gravity", "series"]
    assert_close(hybrid.learned.noise[0].sigma_mm, 1e3 * arm.result.learned.noise["position"], rtol=1e-12)
    assert learned_lines(hybrid)[0] == arm.result.verdict


def test_trials_without_evidence_have_an_empty_cell(arm):
    trial = TrialFigures(name="x", unknowns=3, log_evidence=None, held_out_ratio=0.5, seconds=1.0, kept=False)
    hybrid = summarise(arm.result).hybrid.model_copy(update={"trials": (trial,)})
    assert trial_table(hybrid).rows == (("x", "3", "", "0.500", "1.0", "no"),)


def test_models_are_compared_in_one_order():
    judged = point(30, coverage=0.934, predicted_rms_mm=0.1)
    assert list(judged.models) == ["nominal", "geometric", "hybrid"]
    columns, rows = curve_table([judged])
    assert columns[0] == "training rows"
    assert rows == (("30", "3.0000", "2.0000", "1.0000", "93.4"),)
    assert coverage_line(judged).startswith("93.4 % of")
    assert coverage_line(point(30)) == ""
