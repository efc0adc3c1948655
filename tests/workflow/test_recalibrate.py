"""`pisigma.recalibrate`: the result, its folder, and refusals."""

import math
from dataclasses import replace

import pytest
import torch
from testing.aged import original_model, rows_after_change
from testing.closeness import assert_close
from testing.hybrid import hybrid_of
from testing.refusals import refused

import pisigma
from pisigma.files.errors import AcceptanceError, IdentificationError, MeasurementError, ModelError
from pisigma.lifetime.recalibration.summary import RecalibrationSummary
from pisigma.measurement.dataset import Measurements, join
from pisigma.model.calibrated_model import poses_of_rows
from pisigma.model.folder.model_folder import load_model, save_model
from pisigma.model.inverse.corrected_ik import CorrectedIK
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import transform_from_xyz_zyx
from pisigma.workflow.recalibrate import NOT_TRUSTED, Recalibration, recalibrate
from pisigma.workflow.settings.recalibration import RecalibrationSettings

COLLISION = (0.0, 0.0, math.radians(0.25), 0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def after_collision() -> Recalibration:
    return recalibrate(CorrectedIK(original_model()), rows_after_change(10, 2, COLLISION))


def test_the_moved_joint_and_the_kept_candidate_are_reported(after_collision):
    report = after_collision.to_json()
    assert report["kept"] == "recalibrated"
    assert list(report["cross_validation"]) == ["recalibrated", "old", "scratch"]
    assert report["cross_validation"]["old"]["rms_mm"] > report["cross_validation"]["recalibrated"]["rms_mm"]
    (moved,) = report["moved"]
    assert moved["what"] == "joint 3"
    assert_close(moved["shift_deg"], 0.25, atol=0.02)
    low, high = moved["interval"]
    assert low < 0.25 < high
    assert not report["elsewhere"]


def test_its_folder_is_a_model_that_can_be_recalibrated_again(after_collision, tmp_path):
    after_collision.save(tmp_path / "again")
    card = (tmp_path / "again" / "README.md").read_text()
    for sentence in (after_collision.summary.change_sentence, after_collision.summary.verdict):
        assert sentence in card
    model = load_model(tmp_path / "again")
    figures = RecalibrationSummary.read(model)
    assert figures is not None
    assert (figures.parent.name, figures.parent.sha256) == ("rb5", "")
    assert_close(pisigma.load(tmp_path / "again").model.calibrated.dh, model.calibrated.dh)
    second = recalibrate(tmp_path / "again", rows_after_change(10, 3, COLLISION))
    assert second.summary.parent.kind == "recalibration"
    assert len(second.summary.parent.sha256) == 64
    assert not second.movements


def test_a_base_that_is_stated_to_have_moved_is_identified_again():
    motion = (0.3, -0.2, 0.1, 0.5, 0.2, -0.3)
    result = recalibrate(
        original_model(), rows_after_change(10, 2, base=motion), RecalibrationSettings(moved=("base",))
    )
    assert result.summary.relocated_frames == ("base",)
    T = transform_from_xyz_zyx(torch.tensor(motion).double())
    before, after = (torch.from_numpy(one.bases[""][:3].copy()) for one in (original_model(), result.model))
    assert_close(after, T[:3, :3] @ before + T[:3, 3], atol=1e-3)


def test_a_wrong_row_at_the_time_of_a_collision_is_excluded_and_named(after_collision):
    assert not after_collision.summary.outliers
    rows = rows_after_change(10, 2, COLLISION)
    wrong = rows.position.clone()
    wrong[3, 0] += 0.005
    result = recalibrate(original_model(), replace(rows, position=wrong))
    (outlier,) = result.summary.outliers
    assert (outlier.row, result.summary.rows, result.warnings) == (3, 9, ())
    assert_close(outlier.residual_mm, 5.0, atol=0.5)
    assert [one.what for one in result.movements] == ["joint 3"]
    test = rows_after_change(100, 50, COLLISION, noise=0.0)
    errors = [
        (test.position - poses_of_rows(one.model, test)[:, :3, 3]).square().mean() ** 0.5
        for one in (result, after_collision)
    ]
    assert errors[0] < 1.15 * errors[1]


def test_a_row_that_no_error_explains_is_left_out_and_named():
    rows = rows_after_change(14, 2)
    wrong = rows.position.clone()
    wrong[4] += torch.tensor([0.3, -0.1, 0.2])
    wrong[9, 0] += 0.005
    result = recalibrate(original_model(), replace(rows, position=wrong))
    assert [(one.row, one.place) for one in result.summary.outliers] == [
        (4, rows.place(4)),
        (9, rows.place(9)),
    ]
    assert result.summary.rows == 12
    assert not result.movements


def test_rows_of_another_arm_are_not_trusted(tmp_path):
    rows = rows_after_change(10, 2)
    result = recalibrate(original_model(), replace(rows, q=rows.q.flip(0)))
    assert [one.severity for one in result.diagnostics] == ["implausible"]
    assert not result.movements
    assert result.summary.change_sentence == NOT_TRUSTED
    with refused(AcceptanceError, file=tmp_path / "no"):
        result.save(tmp_path / "no")
    assert not (tmp_path / "no").exists()


def test_rows_of_another_robot_of_the_catalogue_are_named(tmp_path):
    """There are enough rows for a calibration from scratch to predict held-out ones, with other link lengths."""
    q = rows_after_change(30, 4).q
    later = Measurements(q, forward_kinematics(Robot.load("ur5"), q)[:, :3, 3])
    result = recalibrate(original_model(), later)
    assert [(one.kind, one.cause) for one in result.summary.diagnostics[:1]] == [("other_robot", "ur5")]
    with refused(AcceptanceError, file=tmp_path / "another"):
        result.save(tmp_path / "another")


def test_unknown_frames_and_models_without_a_posterior_are_refused(tmp_path):
    with refused(IdentificationError, option="moved", value="arm"):
        RecalibrationSettings(moved=("arm",))
    geometric = tmp_path / "geometric"
    geometric.mkdir()
    save_model(
        replace(original_model(), hybrid=None, uncertainty=None, hybrid_bases={}, hybrid_tools={}), geometric
    )
    with pytest.raises(ModelError):
        recalibrate(geometric, rows_after_change(10, 2))


def test_rows_that_the_model_was_made_from_are_used_once():
    own = hybrid_of("rb5").measurements
    with pytest.raises(MeasurementError):
        recalibrate(original_model(), own)
    new = rows_after_change(10, 3)
    mixed = recalibrate(original_model(), join([own.select(torch.arange(5)), new]))
    assert mixed.summary.rows == new.rows
    assert len(mixed.warnings) == 1
    with pytest.raises(MeasurementError):
        recalibrate(mixed.model, new)
