"""Recalibrated models: writing and reading, and a smaller uncertainty than before."""

import math

import pytest
import torch
from testing.aged import original_model, rows_after_change
from testing.closeness import assert_close

from pisigma.lifetime.recalibration.adaptation import adapt
from pisigma.lifetime.recalibration.candidates import recalibrated_model
from pisigma.lifetime.recalibration.recalibration_problem import recalibration_problem
from pisigma.model.calibrated_model import poses_of_rows
from pisigma.model.folder.model_folder import load_model, save_model
from pisigma.model.model_posterior import ModelPosterior
from pisigma.robot.se3 import invert, transform_from_xyz_zyx

ELSEWHERE = (0.3, -0.2, 0.1, 0.5, 0.2, -0.3)


def recalibrated(rows, relocated=frozenset(), arm=True):
    model = original_model()
    posterior = ModelPosterior.from_model(model)
    problem = recalibration_problem(model, posterior, rows, relocated)
    adaptation = adapt(problem if arm else problem.with_fixed_arm())
    return recalibrated_model(model, adaptation, rows), adaptation


def frame(values) -> torch.Tensor:
    return transform_from_xyz_zyx(torch.tensor(list(values)).double())


def test_the_model_is_the_same_after_writing_and_reading(tmp_path):
    rows, test = (
        rows_after_change(10, 2, (0.0, 0.0, math.radians(0.25), 0.0, 0.0, 0.0)),
        rows_after_change(20, 50),
    )
    model, adaptation = recalibrated(rows)
    save_model(model, tmp_path)
    loaded = load_model(tmp_path)
    assert_close(poses_of_rows(loaded, test), poses_of_rows(model, test))
    errors = adaptation.errors_of(test)["position"]
    assert_close(test.position - poses_of_rows(model, test)[:, :3, 3], errors, atol=1e-12)
    assert_close(loaded.uncertainty.dense_root, model.uncertainty.dense_root)
    assert loaded.uncertainty.noise == model.uncertainty.noise
    again = ModelPosterior.from_model(loaded)
    assert_close(again.weights, ModelPosterior.from_model(model).weights, atol=1e-12)
    at = adaptation.arm.geometry.robot.dh - original_model().hybrid.robot.dh
    assert_close(loaded.calibrated.dh - original_model().calibrated.dh, at, atol=1e-12)


def test_moved_frames_move_the_geometric_calibration_as_well():
    rows = rows_after_change(12, 2, base=ELSEWHERE)
    model, _ = recalibrated(rows, {("base", "")}, arm=False)
    before = original_model()
    moved = [
        frame(new[""]) @ invert(frame(old[""]))
        for new, old in ((model.bases, before.bases), (model.hybrid_bases, before.hybrid_bases))
    ]
    assert_close(moved[0], moved[1], atol=1e-12)
    assert_close(moved[0], frame(ELSEWHERE), atol=1e-3)
    assert_close(model.hybrid.robot.dh, before.hybrid.robot.dh)
    assert_close(model.robot.base, model.bases[""])
    known = len(before.uncertainty.space.parameters)
    assert_close(
        (model.uncertainty.dense_root[known:] @ model.uncertainty.dense_root[known:].t()).diagonal(),
        (before.uncertainty.dense_root[known:] @ before.uncertainty.dense_root[known:].t()).diagonal(),
        rtol=1e-5,
    )


@pytest.mark.parametrize("name", ["hall", ""])
def test_a_new_frame_is_added_to_the_old_ones(name):
    rows = rows_after_change(12, 2)
    two = type(rows)(q=rows.q, position=rows.position, frame=(name,) * 6 + ("wall",) * 6)
    model, _ = recalibrated(two)
    assert list(model.bases) == list(dict.fromkeys(["", name, "wall"]))
    again = ModelPosterior.from_model(model)
    assert again.space.frames == tuple(model.bases)
