"""Images of a recipe: views of the complete board, and effects of errors of camera, board and time."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import RecipeError
from pisigma.robot import Robot
from pisigma.simulation.camera.simulated_images import SimulatedImages
from pisigma.simulation.true_robot import TrueRobot
from pisigma.workflow.recipes.reader import read_recipe
from pisigma.workflow.recipes.recipe import GeometricRecipe


@pytest.fixture(scope="module")
def recipe(repository: Path) -> GeometricRecipe:
    read = read_recipe(repository / "training" / "ur5_camera.yaml")
    assert isinstance(read, GeometricRecipe)
    return read


@pytest.fixture(scope="module")
def robot(recipe: GeometricRecipe) -> TrueRobot:
    """The frames of the recipe, with the nominal arm."""
    return TrueRobot(Robot.load(recipe.robot), recipe.errors[1:])


def images(recipe: GeometricRecipe, **changed: Any) -> SimulatedImages:
    """Return eight images without noise and other errors, except for the given changes."""
    exact = {"corner_px": 0.0, "repeatability_mm": 0.0, "repeatability_deg": 0.0, "seed": 0}
    stated = recipe.measurements.model_dump(exclude={"camera_errors", "late_joints"})
    stated |= {"poses": {**stated["poses"], "count": 8}, "noise": exact} | changed
    return SimulatedImages.model_validate(stated)


def test_images_without_errors_give_the_poses_of_the_camera(recipe: GeometricRecipe, robot: TrueRobot):
    rows = images(recipe).measure(robot)
    T = robot.forward(rows.q)
    assert rows.position is not None
    assert_close(rows.position, T[:, :3, 3], atol=1e-8)
    assert (rows.frame[0], rows.target[0]) == ("board", "wrist")


def test_views_are_near_oblique_and_from_the_printed_side(recipe: GeometricRecipe, robot: TrueRobot):
    section = images(recipe)
    T = robot.forward(section.joint_readings(robot))
    off = torch.from_numpy(section.board.board().corners.mean(0)) - T[:, :3, 3]
    assert (off[:, 2] > 0).all()
    assert ((off.norm(dim=1) > 0.3) & (off.norm(dim=1) < 0.7)).all()
    assert (torch.rad2deg(torch.arccos(T[:, 2, 2])) <= 40.001).all()
    assert T[:, 2, 2].min() < 0.95 < T[:, 2, 2].max(), "some are frontal, some are oblique"


def test_a_larger_board_brings_the_camera_nearer(recipe: GeometricRecipe, robot: TrueRobot):
    exact, larger = (
        images(recipe, board_errors={"scale_percent": scale}).measure(robot).position for scale in (0.0, 1.0)
    )
    assert exact is not None
    assert larger is not None
    assert_close(larger, exact / 1.01, atol=1e-8)


@pytest.mark.parametrize(
    "changed", [{"board_errors": {"bow_mm": 1.0}}, {"camera_errors": {"fx": 5.0}}], ids=["bow", "focal"]
)
def test_errors_of_board_and_camera_move_the_poses(
    changed: dict[str, Any], recipe: GeometricRecipe, robot: TrueRobot
):
    held = recipe.measurements.camera.model_dump() | {"sigma": {}}
    exact, wrong = (images(recipe, camera=held, **errors).measure(robot).position for errors in ({}, changed))
    assert exact is not None
    assert wrong is not None
    assert 1e-4 < (wrong - exact).norm(dim=1).max() < 1e-2


def test_joints_are_read_late(recipe: GeometricRecipe, robot: TrueRobot):
    late = images(recipe, late_joints={"delay_ms": 10.0, "speed_deg_per_s": 20.0})
    off = np.rad2deg((late.joint_readings(robot) - images(recipe).joint_readings(robot)).numpy())
    assert_close(off.std(), 0.2, atol=0.06)
    assert_close(late.measure(robot).q, late.joint_readings(robot))


def test_rendered_images_are_those_of_the_poses(recipe: GeometricRecipe, robot: TrueRobot):
    pytest.importorskip("cv2", reason="opencv-python-headless is not installed")
    from pisigma.measurement.camera.detection.detected_board import DetectedBoard
    from pisigma.measurement.camera.detection.detector import detect_checkerboard

    half = {"width": 960, "height": 600, "fx": 700.0, "fy": 700.0, "cx": 480.0, "cy": 300.0}
    section = images(recipe, camera=half)
    found = detect_checkerboard(next(section.render(robot)), section.board.board())
    assert isinstance(found, DetectedBoard)
    T_board_camera = robot.forward(section.joint_readings(robot))[0].numpy()
    seen = (section.board.board().corners - T_board_camera[:3, 3]) @ T_board_camera[:3, :3]
    assert_close(found.pixels, section.camera.camera().project(seen)[0], atol=0.1)


@pytest.mark.parametrize(
    ("old", "new", "column", "value"),
    [
        ("kind: images", "kind: image", "measurements.kind", "image"),
        ("fx: 1400,", "fx: -1400,", "measurements.camera.fx", -1400),
        ("square_mm: 30", "marker_mm: 30", "measurements.board", None),
        ("frame: board", "frame: table", "held_out.frame", "table"),
    ],
)
def test_mistakes_are_refused(
    old: str, new: str, column: str, value: object, tmp_path: Path, repository: Path
):
    text = (repository / "training" / "ur5_camera.yaml").read_text()
    assert old in text
    (tmp_path / "wrong.yaml").write_text(text.replace(old, new, 1))
    with refused(RecipeError, file="wrong.yaml", column=column, value=value):
        read_recipe(tmp_path / "wrong.yaml")


def test_a_robot_without_a_closed_form_is_refused(tmp_path: Path, repository: Path):
    text = (repository / "training" / "ur5_camera.yaml").read_text().replace("robot: ur5\n", "robot: panda\n")
    (tmp_path / "wrong.yaml").write_text(text)
    with refused(RecipeError, column="measurements.poses", value="panda"):
        read_recipe(tmp_path / "wrong.yaml")
