"""Random views of a board show it completely, sharply and not too obliquely, by an independent check."""

from pathlib import Path

import numpy as np
import pytest
import torch
from testing.board_views import CELL, OBLIQUE, arm_before_board, camera_settings, sees_board
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import PlanningError
from pisigma.measurement.camera.board import Board
from pisigma.measurement.camera.camera import Camera
from pisigma.model.stored_starts import nearest_branch
from pisigma.planning.candidates import Candidates
from pisigma.planning.plan_inputs import find_candidates, views_of
from pisigma.planning.plan_settings import PlanSettings
from pisigma.planning.surroundings.arm_in_surroundings import ArmInSurroundings
from pisigma.planning.surroundings.surroundings import LensSection, Surroundings, ViewSection
from pisigma.robot import Robot
from pisigma.robot.kinematics.closed_form.registry import closed_form_solver


@pytest.fixture(scope="module")
def settings(tmp_path_factory: pytest.TempPathFactory) -> PlanSettings:
    camera = camera_settings(tmp_path_factory.mktemp("camera"))
    return PlanSettings(sensor="camera", camera=camera, candidates=40)


@pytest.fixture(scope="module")
def drawn(settings: PlanSettings) -> Candidates:
    return find_candidates(settings, arm_before_board())


def test_every_candidate_sees_the_board(settings: PlanSettings, drawn: Candidates):
    arm = arm_before_board()
    assert settings.camera is not None
    radius = arm.capsules.radius.numpy()
    assert len(drawn.q) == 40
    assert all(sees_board(arm, settings.camera, q, radius) for q in drawn.q.numpy())
    assert bool(arm.faults(drawn.q).allowed.all())


def test_views_cover_all_angles_distances_and_branches(settings: PlanSettings, drawn: Candidates):
    arm = arm_before_board()
    views = views_of(settings, arm)
    assert views is not None
    oblique = views.incidence_angles(arm, drawn.q).rad2deg()
    assert float(oblique.min()) < 10
    assert float(oblique.max()) > 0.8 * OBLIQUE
    solver = closed_form_solver(arm.robot)
    assert solver is not None
    assert len(nearest_branch(solver, drawn.q).unique()) >= 6
    assert 0 < float(views.board_shift_margin(arm, drawn.q).min()) < 0.05


def test_the_workspace_is_not_that_of_the_views(drawn: Candidates):
    assert len(drawn.workspace_q) == 1000
    assert float(drawn.workspace_q[:, 0].max() - drawn.workspace_q[:, 0].min()) > 5


def test_a_board_from_behind_is_refused(settings: PlanSettings, drawn: Candidates):
    assert CELL.view is not None
    over = CELL.view.model_copy(update={"frame": CELL.view.frame.model_copy(update={"yaw_deg": 0.0})})
    arm = ArmInSurroundings.from_robot(Robot.load("ur5"), CELL.model_copy(update={"view": over}))
    views = views_of(settings, arm)
    assert views is not None
    faults = views.faults(arm, drawn.q[:3])
    assert bool(faults["the camera is behind the board"].all())


def test_an_arm_without_closed_form_sees_the_board_too(settings: PlanSettings):
    robot = Robot.load("panda")
    arm = ArmInSurroundings.from_robot(robot, CELL)
    assert settings.camera is not None
    candidates = find_candidates(PlanSettings(sensor="camera", camera=settings.camera, candidates=2), arm)
    assert len(candidates.q) == 2
    assert all(sees_board(arm, settings.camera, q, arm.capsules.radius.numpy()) for q in candidates.q.numpy())


def test_a_fixed_camera_sees_the_board_on_the_flange(tmp_path: Path):
    view = {"frame": {"x_mm": 450, "y_mm": -100, "z_mm": 900, "yaw_deg": 180}, "near_mm": 300, "far_mm": 700}
    cell = Surroundings.model_validate({"floor_mm": -20, "tool": {"z_mm": 30, "yaw_deg": 180}, "view": view})
    arm, camera = (
        ArmInSurroundings.from_robot(Robot.load("ur5"), cell),
        camera_settings(tmp_path, is_fixed=True),
    )
    candidates = find_candidates(PlanSettings(sensor="camera", camera=camera, candidates=8), arm)
    assert all(sees_board(arm, camera, q, arm.capsules.radius.numpy()) for q in candidates.q.numpy())


def test_sharp_depths_follow_from_the_lens():
    """A point at the nearest and at the farthest depth is blurred to one pixel by a thin lens."""
    lens, f = LensSection(aperture=4.0, focus_mm=500.0, pixel_um=5.0), 1400.0
    v, s = f * 5e-6, 0.5
    focal = v * s / (v + s)
    for depth in lens.sharp_depths(f):
        behind = 1 / (1 / focal - 1 / depth)
        assert_close(abs(v - behind) / behind * focal / 4.0, 5e-6, rtol=1e-9)
    assert LensSection(aperture=16.0, focus_mm=900.0, pixel_um=5.0).sharp_depths(f)[1] == np.inf


def test_depths_are_stated_once():
    lens = {"aperture": 4, "focus_mm": 500, "pixel_um": 5}
    for wrong in ({}, {"near_mm": 300}, {"near_mm": 300, "far_mm": 700, "lens": lens}):
        with pytest.raises(ValueError, match="near_mm"):
            ViewSection.model_validate(wrong)
    with pytest.raises(ValueError, match="near_mm < far_mm"):
        ViewSection.model_validate({"near_mm": 700, "far_mm": 300})


def test_a_plan_with_a_camera_needs_the_position_of_the_board(settings: PlanSettings):
    with refused(PlanningError, option="--surroundings"):
        views_of(settings, ArmInSurroundings.from_robot(Robot.load("ur5")))
    with refused(PlanningError, option="sensor", value="camera"):
        PlanSettings(sensor="camera")


def test_points_far_outside_are_not_visible(tmp_path: Path, settings: PlanSettings):
    """A strong distortion folds back outside the image, so that points outside project into it."""
    assert settings.camera is not None
    arm = arm_before_board()
    views = views_of(settings, arm)
    assert views is not None
    wide = Camera("wide", 1920, 1200, 700.0, 700.0, 960.0, 600.0, k1=-0.3)
    T = torch.eye(4, dtype=torch.float64)[None].clone()
    T[0, :3, 3] = torch.tensor([0.7, 0.0, 0.3])
    sight = type(views.sight)(wide, Board.load(settings.camera.board), False, 0.3, views.sight.repeatability)
    _, pixels, is_regular = type(views)(sight, views.T_cell_frame, 0.3, 0.7, 0.7, 20.0)._shown(T)
    assert bool((pixels[..., 0] < 1900).any())
    assert not bool(is_regular.all())
