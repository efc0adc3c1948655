"""Plans for a camera, from a robot to its files: every pose sees the board, and the plan is read back unchanged."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from testing.board_views import CELL, camera_settings, sees_board
from testing.closeness import assert_close
from testing.models import no_type_checker

from pisigma.planning.plan_file import read_plan
from pisigma.planning.plan_settings import PlanSettings
from pisigma.workflow.plan import Plan, plan


@pytest.fixture(scope="module")
def settings(tmp_path_factory: pytest.TempPathFactory) -> PlanSettings:
    camera = camera_settings(tmp_path_factory.mktemp("camera"))
    return PlanSettings(count=12, check=3, sensor="camera", camera=camera, candidates=60)


@pytest.fixture(scope="module")
def planned(settings: PlanSettings) -> Plan:
    with no_type_checker():
        return plan("ur5", settings, CELL)


def test_every_planned_pose_sees_the_board(planned: Plan, settings: PlanSettings):
    arm, camera = planned.stored_plan.arm, settings.camera
    assert camera is not None
    assert planned.calibration_pose_count + planned.test_pose_count == len(planned.stored_plan.q) >= 14
    radius = arm.capsules.radius.numpy()
    assert all(sees_board(arm, camera, q, radius) for q in planned.stored_plan.q.numpy())
    assert bool(arm.faults(planned.stored_plan.q).allowed.all())


def test_more_images_are_expected_to_err_less_than_random_ones(planned: Plan):
    first, last = planned.accuracy_curve
    assert first.poses == 10
    assert first.rms > last.rms > 0
    assert last.random_rms > last.rms


def test_a_plan_is_read_with_its_camera(planned: Plan, settings: PlanSettings, tmp_path: Path):
    planned.save(tmp_path / "poses.csv", [tmp_path / "poses.script"])
    stored = read_plan(tmp_path / "poses.csv")
    assert settings.camera is not None
    assert stored.settings.camera is not None
    assert Path(stored.settings.camera.camera).samefile(settings.camera.camera)
    assert replace(stored.settings, camera=None, sensor="pose") == replace(
        settings, camera=None, sensor="pose"
    )
    assert stored.arm.surroundings == CELL
    assert_close(stored.q, planned.stored_plan.q, atol=1e-7)
    assert (tmp_path / "poses.script").read_text().count("sleep(3.0)") == len(stored.q)
    assert not np.isnan(stored.q.numpy()).any()


def test_limiting_factors_and_unidentifiable_parameters_are_reported(planned: Plan):
    camera = planned.camera
    assert camera is not None
    assert_close(camera.rms, planned.accuracy_curve[-1].rms, rtol=1e-9)
    for better in (camera.rms_with_more_images, camera.rms_with_exact_corners, camera.rms_with_exact_robot):
        assert 0 < better < camera.rms
    assert 0 < camera.allowed_board_displacement < 0.1
    text = " ".join(camera.unidentifiable)
    assert "theta_6, d_6, a_6 and alpha_6" in text
    assert "theta_1 and d_1" in text
    figures = planned.to_json()["camera"]
    assert isinstance(figures, dict)
    assert_close(figures["exact_robot_rms_mm"], camera.rms_with_exact_robot * 1e3)


def test_frontal_views_are_warned_of(settings: PlanSettings):
    assert CELL.view is not None
    cell = CELL.model_copy(update={"view": CELL.view.model_copy(update={"oblique_deg": 8.0})})
    with no_type_checker():
        frontal = plan("ur5", replace(settings, count=5, check=0, candidates=20), cell)
    text = " ".join(frontal.warnings)
    assert "tilted by less than 8 deg" in text
