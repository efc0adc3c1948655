"""Corners in a growing file, and the session that reads them."""

from pathlib import Path

import numpy as np
import pytest
import torch
from testing.board_views import CELL, camera_settings
from testing.camera_cell import corner_lines
from testing.closeness import assert_close
from testing.models import no_type_checker

from pisigma.measurement.camera.board import Board
from pisigma.measurement.camera.camera import Camera
from pisigma.planning.plan_file import StoredPlan
from pisigma.planning.plan_inputs import find_candidates
from pisigma.planning.plan_settings import PlanSettings
from pisigma.planning.session.growing_images import growing_file
from pisigma.planning.surroundings.arm_in_surroundings import ArmInSurroundings
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import invert, xyz_zyx_from_transform
from pisigma.simulation.camera.simulated_images import ImageNoise, simulate_images
from pisigma.workflow.measure import MeasuringSession
from pisigma.workflow.settings.measuring import MeasureSettings

IMAGES, SWAPPED = 9, 7
CORNERS = 54


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> StoredPlan:
    camera = camera_settings(tmp_path_factory.mktemp("camera"))
    settings = PlanSettings(count=IMAGES, check=0, sensor="camera", camera=camera, candidates=40)
    arm = ArmInSurroundings.from_robot(Robot.load("ur5"), CELL)
    drawn = find_candidates(settings, arm)
    q = drawn.q[:IMAGES]
    none = (q[:0],) * IMAGES
    return StoredPlan(
        arm, settings, None, q, torch.zeros(IMAGES, dtype=torch.bool), drawn.number[:IMAGES], none
    )


@pytest.fixture(scope="module")
def lines(plan: StoredPlan) -> list[str]:
    """The file's lines: one image has the joint values of the next one."""
    robot, settings, view = plan.arm.robot, plan.settings.camera, CELL.view
    assert settings is not None
    assert view is not None
    assert view.T_cell_frame is not None
    base = xyz_zyx_from_transform(invert(view.T_cell_frame)).numpy()
    errors = np.random.default_rng(0).standard_normal(robot.dh.shape) * [9e-4, 4e-4, 4e-4, 1e-3, 1e-3]
    true = robot.with_geometry(robot.dh + errors, base=base, tool=robot.tool + 2e-3)
    camera, board = Camera.load(settings.camera), Board.load(settings.board)
    images = simulate_images(true, plan.q, camera, board, ImageNoise(), torch.Generator().manual_seed(0))
    assert all(len(corners) == CORNERS for corners in images.corner_numbers)
    text = corner_lines(images)
    first = 1 + CORNERS * SWAPPED
    joints = text[first + CORNERS].split(",")[4:]
    for row in range(first, first + CORNERS):
        text[row] = ",".join([*text[row].split(",")[:4], *joints])
    return text


def test_an_image_is_complete_when_the_next_one_starts(plan: StoredPlan, lines: list[str], tmp_path: Path):
    file = growing_file(tmp_path / "corners.csv", plan.arm.robot, plan.settings)
    assert "does not exist" in file.read().missing_part
    (tmp_path / "corners.csv").write_text("\n".join(lines[: 1 + CORNERS]) + "\n")
    assert file.read().rows is None
    faulty = [line.replace(",", ",5", 1) for line in lines[1 + CORNERS : 1 + 2 * CORNERS]]
    text = [*lines[: 1 + CORNERS], *faulty, *lines[1 + 2 * CORNERS : 1 + 3 * CORNERS]]
    (tmp_path / "corners.csv").write_text("\n".join(text) + "\n")
    growth = file.read()
    assert growth.rows is not None
    assert growth.rows.line == (2,)
    (left_out,) = growth.left_out
    assert left_out.line == 2 + CORNERS + 4
    assert "column 'corner'" in left_out.reason
    last = file.read(is_complete=True)
    assert last.rows is not None
    assert last.rows.line == (2 + 2 * CORNERS,)
    assert not last.left_out


def test_a_session_finds_swapped_joints_and_the_accuracy(plan: StoredPlan, lines: list[str], tmp_path: Path):
    session = MeasuringSession(plan, MeasureSettings(replan=False))
    (tmp_path / "corners.csv").write_text("\n".join(lines) + "\n")
    growth = growing_file(tmp_path / "corners.csv", plan.arm.robot, plan.settings).read(is_complete=True)
    with no_type_checker():
        session.add(growth.rows, growth.left_out)
        session.update()
    state = session.state
    wrong = [alarm for alarm in state.alarms if not alarm.row_is_used]
    assert [alarm.line for alarm in wrong] == [2 + CORNERS * SWAPPED]
    assert wrong[0].kind == "swapped"
    assert state.accuracy is not None
    assert state.accuracy.poses == IMAGES - 1
    assert 1e-5 < state.accuracy.predicted_rms < 3e-3
    right = np.delete(np.arange(IMAGES), SWAPPED)
    assert float(np.linalg.norm(state.rows.error[right], axis=1).max()) < 5e-3
    nominal = forward_kinematics(plan.arm.robot, plan.q)[:, :3, 3].numpy()
    assert_close(state.rows.position[right], nominal[right], atol=0.02)
    assert session.rows is not None
    assert session.rows.rows == IMAGES - 1
